"""Configs: YAML files, sections derived from constructors, cases, and error messages."""
