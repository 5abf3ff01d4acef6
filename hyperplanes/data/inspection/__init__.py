"""What data sets hold, and whether pictures and poses agree: what `hyperplanes inspect` says."""
