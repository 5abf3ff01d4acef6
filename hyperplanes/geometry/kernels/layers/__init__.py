"""Kernels of fully connected layers, one module for each kind of processor."""
