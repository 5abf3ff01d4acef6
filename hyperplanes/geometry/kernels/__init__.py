"""Fused kernels: lookup and sampling, visual hulls, visibility, voxels and layers; numba on the CPU, Triton on CUDA."""
