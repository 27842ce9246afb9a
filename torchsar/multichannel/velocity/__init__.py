"""Velocity and position estimation of moving points with several channels along track."""
