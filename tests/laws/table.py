"""Which laws hold for which entry of the table of extremes, and why not where they do not."""

from __future__ import annotations

import importlib
import math
import typing
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tests.extremes.judge import Results, outcome
from tests.table.functions import ENTRIES, Entry, _signal, ramp, samples
from tests.table.stages import RADAR
from torchsar import compensate, core, echo, focus, multichannel, radar, repair, scene
from torchsar.core import Signal
from torchsar.echo.strip import Placed
from torchsar.focus.stored_omega_k import InvertibleOmegaK

DOUBLE, F64 = torch.complex128, torch.float64
ALL = [entry for entry in ENTRIES if not entry.kind.startswith("one ") and not entry.joint]
STAGES_IN = (compensate, focus, multichannel, repair, core)


def axes(entry: Entry) -> tuple[str, ...]:
    """Names of the axes of the samples of an entry, of which Doppler stands for the pulses."""
    return tuple("pulse" if name == "doppler" else name for name in _signal(entry.kind).names)


def draw(entry: Entry, seed: int, trials: int = 1) -> Tensor:
    """Samples of the kind of an entry with noise, (trial, ...)."""
    x = samples(entry.kind, trials, DOUBLE)
    return x + 0.3 * torch.randn(x.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def called(entry: Entry, x: Tensor) -> Results:
    """Results of an entry that accepts the samples."""
    found = outcome(lambda: entry.call(x))
    assert not isinstance(found, str), found
    return found


def _returns(entry: Entry) -> object:
    """Return type of the function, or of the `forward` of the stage."""
    name = entry.name.split(":")[0]
    if "." in name:
        package, _, name = name.rpartition(".")
        function = getattr(importlib.import_module(f"torchsar.{package}"), name)
    else:
        function = next(getattr(module, name) for module in STAGES_IN if hasattr(module, name)).forward
    return typing.get_type_hints(function)["return"]


def gives_samples(entry: Entry) -> bool:
    """Whether the result is samples that grow with the samples given."""
    return _returns(entry) in (Tensor, Signal) and entry.degree.get("data", 1) == 1


TO_SAMPLES = [entry for entry in ALL if gives_samples(entry)]
ESTIMATORS = [entry for entry in ALL if not gives_samples(entry)]

LINEAR = [entry for entry in TO_SAMPLES if not entry.laws.linear]


@dataclass(frozen=True)
class Pair:
    """A linear map and its adjoint.

    Args:
        name: What they are.
        forward: The map, of x (trial, *given).
        adjoint: The other, of y (trial, *made).
        given: Shape of x.
        made: Shape of y, or with `in_range` of what it is made of.
        tolerance: Relative difference of <A x, y> and <x, A' y> that the interpolation allows.
        in_range: y is itself a result of the map, since lines are cut where echoes have faded.
    """

    name: str
    forward: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]
    given: tuple[int, ...]
    made: tuple[int, ...]
    tolerance: float = 1e-11
    in_range: bool = False


POINTS = torch.tensor([-0.41, -0.2, 0.013, 0.31, 0.47], dtype=F64)
SHIFTS = ramp(16, 0.17)
ALONG, RANGES = torch.tensor([3.0, 4.7, 6.0], dtype=F64), torch.tensor([4031.0, 4040.5, 4052.3], dtype=F64)
FREQUENCIES = 9.3e9 + 8e6 * torch.arange(24, dtype=F64)
ANGLES = torch.linspace(0.2, 0.35, 16, dtype=F64)
WAVES = radar.FarField.turntable(FREQUENCIES, ANGLES)


def _strip(amplitude: Tensor) -> Tensor:
    """Raw echo (trial, pulse, range) of points that are always lit, at zero Doppler."""
    world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.AlwaysLit(), doppler_hz=0.0)
    crossing_s = ALONG / RADAR.velocity_m_s
    placed = Placed(crossing_s, crossing_s, RANGES, amplitude)
    return echo.stripmap_echo(placed, world, RADAR, 24, 64, DOUBLE)


def _strip_adjoint(raw: Tensor) -> Tensor:
    """Backprojection of correlations with the pulse; it keeps the phase of the range of a point."""
    pulse = RADAR.pulse.spectrum(64, RADAR.sampling_hz).conj()
    image = focus.backproject_strip(raw, RADAR, ALONG, RANGES, doppler_hz=0.0, reference=pulse)
    return image * torch.exp(4j * math.pi / RADAR.wavelength_m * RANGES)


def _far(amplitude: Tensor) -> Tensor:
    """Range profiles (trial, pulse, range) of points on a turntable, by the direct sum."""
    away = ALONG * torch.cos(ANGLES)[:, None] + 2.0 * torch.sin(ANGLES)[:, None]
    turns = 2 / WAVES.wave_speed_m_s * FREQUENCIES[:, None] * away[:, None]
    return radar.range_profiles((torch.exp(-2j * math.pi * turns) @ amplitude[:, None, :, None])[..., 0])


PAIRS = [
    Pair("FFT", core.centred_fft, lambda y: 16 * core.centred_ifft(y), (3, 16), (3, 16)),
    Pair("frequency samples", radar.frequency_samples, radar.range_profiles, (3, 16), (3, 16)),
    Pair(
        "NUFFT",
        lambda x: focus.nufft_type2(x, POINTS),
        lambda y: focus.nufft_type1(y, POINTS, 16),
        (3, 16),
        (3, 5),
        1e-9,
    ),
    Pair(
        "shift in range",
        lambda x: compensate.shift_range(x, SHIFTS),
        lambda y: compensate.shift_range(y, -SHIFTS),
        (16, 9),
        (16, 9),
    ),
    Pair(
        "phase of pulses",
        lambda x: compensate.correct_pulse_phase(x, SHIFTS),
        lambda y: compensate.correct_pulse_phase(y, -SHIFTS),
        (16, 9),
        (16, 9),
    ),
    Pair(
        "omega-K and its inverse",
        lambda x: focus.omega_k(x, RADAR, doppler_hz=5.0),
        lambda y: InvertibleOmegaK(RADAR, y, doppler_hz=5.0).defocus(y),
        (24, 64),
        (24, 64),
    ),
    Pair("echo of a strip and backprojection", _strip, _strip_adjoint, (3,), (3,), 2e-3, in_range=True),
    Pair(
        "echo of a turntable and backprojection",
        _far,
        lambda y: focus.backproject_spotlight(y, WAVES, ALONG, 2.0 + 0 * ALONG),
        (3,),
        (16, 24),
        1e-8,
    ),
]
