"""Kernels of rays through voxel grids: marching, boxes, and sparse grids."""
