"""Hypernetworks that read images one by one, and the autoencoder."""
