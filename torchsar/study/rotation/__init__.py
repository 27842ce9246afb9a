"""Targets that turn unevenly (system 003): `system: isal_rotation`."""
