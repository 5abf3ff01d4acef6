"""Kernels of lookup and sampling, and their PyTorch operators."""
