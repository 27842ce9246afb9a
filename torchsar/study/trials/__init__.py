"""Experiments: a system, its bench, a batch of trials, and an outcome per method."""
