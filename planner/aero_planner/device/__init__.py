"""What all kernels share: structs of arrays, live parameters, rotations, quintics, and operations that Warp lacks."""
