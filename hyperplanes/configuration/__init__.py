"""Settings: named presets, and files of settings."""
