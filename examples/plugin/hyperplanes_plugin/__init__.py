"""A field of objects whose left side is the mirror image of their right side, and a method that optimises it."""
