"""Audit of verdicts: how often an estimator says `ok` and is wrong, by the kind of its data."""
