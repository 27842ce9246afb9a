"""Azimuth-multichannel bistatic radar with moving targets (system 001): `system: geo`."""
