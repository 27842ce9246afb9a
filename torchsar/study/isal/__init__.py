"""System 002: inverse synthetic aperture ladar, phase errors from pulse to pulse (Ruan et al.

2013), simulated and recorded.
"""
