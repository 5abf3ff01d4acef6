"""Settings of models and of training, named presets, and settings files."""
