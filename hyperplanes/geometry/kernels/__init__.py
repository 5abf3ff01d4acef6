"""Fused kernels of lookup, sampling and carving: numba on the CPU, Triton on CUDA, and their PyTorch operators."""
