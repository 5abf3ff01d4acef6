"""Files: reading, writing, encoding, settings, weights and tables."""
