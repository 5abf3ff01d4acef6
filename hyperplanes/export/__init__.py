"""A field made into files: pictures, turntables, meshes and baked voxels."""
