"""What several benchmarks share, and larger pieces of single ones."""
