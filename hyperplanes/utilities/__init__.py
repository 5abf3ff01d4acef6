"""What needs no tensors: configuration records, entry points, error messages, formatting, tables, charts, a cache."""
