"""The systems: what is physics in an experiment."""
