"""Simulation of recordings and their true values, with noise and errors of the receiver.

The functions take the description of the radar and a world: the scene, its motion and the noise. An
impairment is called with a recording and random draws; it returns the impaired recording and the
true values of the impairment. The recording may be simulated or recorded. A parameter annotated
`Tensor | float` is a number, equal in all trials, or a tensor with one value per trial.
"""

from torchsar.echo.bistatic import bistatic_echo, simulate_bistatic
from torchsar.echo.channel_errors import ChannelErrors, PolynomialDrift, SinusoidDrift, SynchronisationError, WalkDrift
from torchsar.echo.channels import ChannelImbalance
from torchsar.echo.interference import Quantiser, Tone, WideInterferer
from torchsar.echo.jitter import PeriodicJitter
from torchsar.echo.ladar import ladar_echo, range_model_error_db, simulate_ladar
from torchsar.echo.ladar_record import ladar_record, simulate_ladar_record
from torchsar.echo.lines import CorruptedNumbers, LostGaps, LostLines, RepeatedLines
from torchsar.echo.pairs import SimulatedPairs
from torchsar.echo.path import PathError, path_echo, simulate_path
from torchsar.echo.pulse_phase import PhaseSinusoid, PhaseWalk, WhitePhase
from torchsar.echo.response import ChannelResponse, smooth_response
from torchsar.echo.sea import sea_echo
from torchsar.echo.stripmap import Impairment, apply_impairments, simulate, stripmap_echo, target_energy
from torchsar.echo.sweep_error import PolynomialSweepError, SinusoidSweepError, calibration_channel
from torchsar.echo.turntable import LostPulses, dechirped_echo, simulate_turntable, turntable_echo

__all__ = [
    "ChannelErrors",
    "ChannelImbalance",
    "ChannelResponse",
    "CorruptedNumbers",
    "Impairment",
    "LostGaps",
    "LostLines",
    "LostPulses",
    "PathError",
    "PeriodicJitter",
    "PhaseSinusoid",
    "PhaseWalk",
    "PolynomialDrift",
    "PolynomialSweepError",
    "Quantiser",
    "RepeatedLines",
    "SimulatedPairs",
    "SinusoidDrift",
    "SinusoidSweepError",
    "SynchronisationError",
    "Tone",
    "WalkDrift",
    "WhitePhase",
    "WideInterferer",
    "apply_impairments",
    "bistatic_echo",
    "calibration_channel",
    "dechirped_echo",
    "ladar_echo",
    "ladar_record",
    "path_echo",
    "range_model_error_db",
    "sea_echo",
    "simulate",
    "simulate_bistatic",
    "simulate_ladar",
    "simulate_ladar_record",
    "simulate_path",
    "simulate_turntable",
    "smooth_response",
    "stripmap_echo",
    "target_energy",
    "turntable_echo",
]
__dir__ = __all__.copy
