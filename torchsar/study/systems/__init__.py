"""The systems, which contain the physics of the experiments."""
