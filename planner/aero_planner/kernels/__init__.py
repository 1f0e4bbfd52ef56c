"""The stages of the planner as Warp kernels. They are pure: arrays in, arrays out, no state."""
