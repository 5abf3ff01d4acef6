"""The layouts that are read, a module each, and `recognise`, which finds out which one lies at a path."""
