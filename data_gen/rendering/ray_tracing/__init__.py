"""The renderer that casts rays, through Embree."""
