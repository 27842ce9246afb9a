"""Radar and scene to recordings: echoes, noise and receiver damage."""

from torchsar.echo.pairs import SimulatedPairs
from torchsar.echo.stripmap import Damage, apply_damages, simulate, stripmap_echo

__all__ = ["Damage", "SimulatedPairs", "apply_damages", "simulate", "stripmap_echo"]
