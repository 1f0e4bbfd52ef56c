"""Memory: sweeps beyond the newest ten are kept, thinned."""
