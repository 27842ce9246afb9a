"""Figures of merit."""

from torchsar.metrics.image import contrast, correlation, entropy, error_db

__all__ = ["contrast", "correlation", "entropy", "error_db"]
