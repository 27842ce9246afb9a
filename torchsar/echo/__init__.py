"""Radar and scene to recordings: echoes, noise and receiver damage."""

from torchsar.echo.channels import ChannelImbalance
from torchsar.echo.interference import Quantiser, Tone, WideInterferer
from torchsar.echo.jitter import PeriodicJitter
from torchsar.echo.lines import CorruptedNumbers, LostGaps, LostLines, RepeatedLines
from torchsar.echo.pairs import SimulatedPairs
from torchsar.echo.pulse_phase import PhaseSinusoid, PhaseWalk, WhitePhase
from torchsar.echo.response import ChannelResponse
from torchsar.echo.stripmap import Damage, apply_damages, simulate, stripmap_echo, target_energy
from torchsar.echo.turntable import LostPulses, dechirped_echo, simulate_turntable, turntable_echo

__all__ = [
    "ChannelImbalance",
    "ChannelResponse",
    "CorruptedNumbers",
    "Damage",
    "LostGaps",
    "LostLines",
    "LostPulses",
    "PeriodicJitter",
    "PhaseSinusoid",
    "PhaseWalk",
    "Quantiser",
    "RepeatedLines",
    "SimulatedPairs",
    "Tone",
    "WhitePhase",
    "WideInterferer",
    "apply_damages",
    "dechirped_echo",
    "simulate",
    "simulate_turntable",
    "stripmap_echo",
    "target_energy",
    "turntable_echo",
]
