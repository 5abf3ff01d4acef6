"""Baselines without learned weights: the nearest view, and colours blended on the visual hull."""
