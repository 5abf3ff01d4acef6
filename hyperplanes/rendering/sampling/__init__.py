"""Samplers, which place samples along rays: marching in voxels, and NeRF's hierarchical sampling."""
