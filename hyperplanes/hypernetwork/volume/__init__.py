"""The hypernetwork that reads a volume of all views."""
