"""Ships on a sea before azimuth-multichannel bistatic radar (system 001): `system: geo_ocean`."""
