"""What capture apps and photogrammetry programs write: cameras in files of their own, beside the photographs."""
