"""One MPPI problem in other libraries, as their users would write it, with one module per library."""
