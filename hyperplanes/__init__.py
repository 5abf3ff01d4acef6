"""HyperPlanes: a hypernetwork reads a few posed images and writes a NeRF."""
