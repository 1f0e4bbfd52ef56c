"""One MPPI problem in other libraries, as their users would write it: the problem itself, and one module for each."""
