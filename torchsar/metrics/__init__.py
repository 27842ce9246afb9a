"""Figures of merit."""

from torchsar.metrics.image import contrast, correlation, entropy, error_db

from torchsar.metrics.impulse import impulse_response

__all__ = ["contrast", "correlation", "entropy", "error_db", "impulse_response"]
