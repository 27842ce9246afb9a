"""Azimuth-multichannel data: reconstruction, focusing, velocity of moving points, and what channels are told by clutter and by a direct path."""
