"""Experiments from a config: run, judge, store and report. Needs the extra `study`."""
