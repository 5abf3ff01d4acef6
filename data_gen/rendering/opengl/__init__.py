"""The renderers on OpenGL, through pyrender."""
