"""Generators of raw data written from the signal models of the papers alone, in the time domain."""
