"""The demonstration: an experiment on procedural objects whose result is an HTML page."""
