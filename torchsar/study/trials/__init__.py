"""Experiments: the physics of a system, the objects that a config builds (its bench), batches of
trials, and the results of the methods.
"""
