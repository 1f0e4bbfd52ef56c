"""Dynamic obstacles: their velocities, from successive sweeps, and the clearance from where they will be."""
