"""Benchmarks: every estimator is in one, records meet their bars, and scores cannot be gamed."""
