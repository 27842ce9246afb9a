"""Generators of data that are independent of the simulators of the package."""
