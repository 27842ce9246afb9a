"""Estimators of motion and phase errors, and their correctors."""
