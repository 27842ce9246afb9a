"""Configs: YAML, sections read from constructors, cases, and errors in one sentence."""
