"""Gradient descent on support views: losses, optimisers, gradients in threads, and learned steps."""
