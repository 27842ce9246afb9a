"""Experiments: the physics of a system, the bench (the objects that a config builds), batches of
trials, and the results of the methods.
"""
