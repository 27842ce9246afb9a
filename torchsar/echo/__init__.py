"""Simulation of recordings and their true values, with noise and errors of the receiver.

================================  ==================================================================
to simulate                       what to use
================================  ==================================================================
strip                             `simulate`; `stripmap_echo` for the echo without noise
rotating target                   `simulate_turntable`; `turntable_echo`, `dechirped_echo`
triangular ladar                  `simulate_ladar` for sweeps, `simulate_ladar_record` for a
                                  continuous record; `ladar_echo`
moving targets, several channels  `simulate_bistatic`; `bistatic_echo`
any path                          `simulate_path`; `path_echo`
first stages of a chain           `Simulate` for any of these worlds, `Impair` for any impairment
impairments of any recording      `apply_impairments`, each an `Impairment`
lost or misnumbered lines         `LostLines`, `LostGaps`, `LostPulses`, `RepeatedLines`,
                                  `CorruptedNumbers`
interference, converter           `Tone`, `WideInterferer`, `Quantiser`, `PeriodicJitter`
pulses of another radar           `PulsedInterference`
constant, drift, spur             `Leakage`
I and Q, gain, range gate         `QuadratureError`, `GainSteps`, `GateJumps`
echo that does not move along     `GroundAtRest`
receiver of one channel           `ChannelResponse`, made by `smooth_response`
receiver of several channels      `ChannelImbalance` for lines in turn, `ChannelErrors` for channels
                                  along track
clocks of a bistatic pair         `SynchronisationError`
phase of each pulse               `WhitePhase`, `PhaseWalk`, `PhaseSinusoid`
non-linear sweeps of a ladar      `PolynomialSweepError`, `SinusoidSweepError`
errors of recorded positions      `PathError`
================================  ==================================================================

The functions take the description of the radar and a world: the scene, its motion and the noise. An
impairment is called with a recording and random draws; it returns the impaired recording and the
true values of the impairment. The recording may be simulated or recorded. A parameter annotated
`Tensor | float` is a number, equal in all trials, or a tensor with one value per trial.
"""

from torchsar.core.kinds import check_kinds
from torchsar.echo.bistatic import bistatic_echo, simulate_bistatic
from torchsar.echo.channel_errors import ChannelErrors, SynchronisationError
from torchsar.echo.channels import ChannelImbalance
from torchsar.echo.dechirped import dechirped_echo
from torchsar.echo.ends import Impair, Simulate
from torchsar.echo.interference import Quantiser, Tone, WideInterferer
from torchsar.echo.jitter import PeriodicJitter
from torchsar.echo.ladar import ladar_echo, simulate_ladar
from torchsar.echo.ladar_record import simulate_ladar_record
from torchsar.echo.lines import CorruptedNumbers, LostGaps, LostLines, LostPulses, RepeatedLines
from torchsar.echo.path import PathError, path_echo, simulate_path
from torchsar.echo.pulse_phase import PhaseSinusoid, PhaseWalk, WhitePhase
from torchsar.echo.receiver import GainSteps, GateJumps, GroundAtRest, Leakage, PulsedInterference, QuadratureError
from torchsar.echo.recorded import Impairment, apply_impairments
from torchsar.echo.response import ChannelResponse, smooth_response
from torchsar.echo.strip import simulate, stripmap_echo
from torchsar.echo.sweep_error import PolynomialSweepError, SinusoidSweepError
from torchsar.echo.turntable import simulate_turntable, turntable_echo

__all__ = [
    "ChannelErrors",
    "ChannelImbalance",
    "ChannelResponse",
    "CorruptedNumbers",
    "GainSteps",
    "GateJumps",
    "GroundAtRest",
    "Impair",
    "Impairment",
    "Leakage",
    "LostGaps",
    "LostLines",
    "LostPulses",
    "PathError",
    "PeriodicJitter",
    "PhaseSinusoid",
    "PhaseWalk",
    "PolynomialSweepError",
    "PulsedInterference",
    "QuadratureError",
    "Quantiser",
    "RepeatedLines",
    "Simulate",
    "SinusoidSweepError",
    "SynchronisationError",
    "Tone",
    "WhitePhase",
    "WideInterferer",
    "apply_impairments",
    "bistatic_echo",
    "dechirped_echo",
    "ladar_echo",
    "path_echo",
    "simulate",
    "simulate_bistatic",
    "simulate_ladar",
    "simulate_ladar_record",
    "simulate_path",
    "simulate_turntable",
    "smooth_response",
    "stripmap_echo",
    "turntable_echo",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
