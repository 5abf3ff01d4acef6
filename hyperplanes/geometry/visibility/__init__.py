"""Which views see a point, and where rays meet the visual hull."""
