"""Velocity and place of moving points before several channels along track."""
