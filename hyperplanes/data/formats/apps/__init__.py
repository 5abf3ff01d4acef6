"""Readers of what capture apps and photogrammetry programs export: photographs, with cameras in files beside them."""
