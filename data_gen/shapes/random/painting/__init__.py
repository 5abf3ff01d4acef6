"""Colours and textures of random compositions."""
