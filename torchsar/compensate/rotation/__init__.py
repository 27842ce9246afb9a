"""The uneven rotation of a target, found from the range-compressed data alone."""
