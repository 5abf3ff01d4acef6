"""Images: their range and colour spaces, metrics and plots."""
