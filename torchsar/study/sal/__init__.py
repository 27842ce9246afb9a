"""System 000: synthetic aperture ladar with a symmetric triangular sweep, radial motion estimated
from every period (Remote Sens. 2024, 16, 793).
"""
