"""Reflections about planes, and the most symmetric plane of a voxel grid."""
