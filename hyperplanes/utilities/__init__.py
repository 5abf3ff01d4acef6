"""What every room uses: files, settings, entry points, error messages, formatting, metrics, a cache."""
