"""Torch framework for synthetic aperture radar and ladar."""
