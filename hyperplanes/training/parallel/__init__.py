"""Training in several processes: launching them, and averaging their gradients."""
