"""Experiments: a system, its bench, batches of trials, and the outcome of every method."""
