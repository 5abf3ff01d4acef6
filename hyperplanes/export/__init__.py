"""Export of fields to files: images, turntables, meshes, points, splats and baked voxels."""
