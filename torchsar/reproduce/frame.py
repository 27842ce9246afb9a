"""Tsvetkov 2017: a frame of 10 x 10 km, from raw data to amplitudes, and numbers of the text.

The raw data are noise and points, of the published bandwidth and integration time; carrier, pulse
rate, sampling and range are chosen. The focusing is the paper's: Doppler centroid, velocity of
least entropy in a group of range cells in the middle, omega-K, modulus.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchsar.compensate import DopplerCentroid, EffectiveVelocity
from torchsar.core import Draws, Signal
from torchsar.echo import simulate
from torchsar.focus import Detect, OmegaK
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.reproduce.item import Check, Item, given, number, statement
from torchsar.scene import Dwell, Points, StripmapWorld

log = logging.getLogger("torchsar.reproduce")
# bandwidth and integration time are those of the paper; the other values are a choice
SENSOR = StripmapRadar(
    carrier_hz=3.2e9,
    pulse=LinearFM(bandwidth_hz=200e6, duration_s=3e-6),
    sampling_hz=250e6,
    prf_hz=4000.0,
    velocity_m_s=7000.0,
    near_range_m=694.75e3,
    pointing_doppler_hz=0.0,
    integration_s=1.5,
)
# integration time (s) and middle of the swath (m)
DWELL_S, RANGE_M = 1.5, 700e3
# (lines, samples) of the full frame and, in the reduced form, of an aperture and a pulse
SIZES = {False: (11_720, 17_500), True: (7_000, 1_400)}


class _Frame(NamedTuple):
    """Measurements of the processing of a frame: CPU time of each part and wall time (s), threads,
    peak memory of the process (GB), error of the velocity (m/s), and number of samples.
    """

    processor_s: dict[str, float]
    wall_s: float
    threads: int
    peak_gb: float
    velocity_m_s: float
    samples: int


def _raw(lines: int, samples: int, off_m_s: float, slab: int = 1024, step: int = 4096) -> Signal:
    """Simulate noise with three points along track at every `step` range samples.

    The echoes are computed in slabs of `slab` range samples to save memory. off_m_s: true minus
    nominal velocity.
    """
    axes = SENSOR.raw_axes(lines, samples)
    noise = torch.Generator().manual_seed(1)
    data = torch.empty((lines, samples), dtype=torch.complex64)
    torch.view_as_real(data).normal_(generator=noise)
    along = (lines / SENSOR.prf_hz - DWELL_S) * SENSOR.velocity_m_s * 0.45
    points = Points([-along, 0.0, along], [0.0] * 3, [3.0] * 3)
    world = StripmapWorld(points, Dwell(DWELL_S), velocity_m_s=SENSOR.velocity_m_s + off_m_s)
    for first in range((samples - slab) % step // 2, samples - slab + 1, step):
        radar = replace(SENSOR, near_range_m=SENSOR.near_range_m + first * SENSOR.range_step_m)
        data[:, first : first + slab] += simulate(radar, world, lines, slab, Draws(1))[0].signal.data
    return Signal(data, axes)


def _frame(small: bool, off_m_s: float = 2.0, width: int = 1024) -> _Frame:
    """Process a frame; Doppler centroid and velocity are estimated from `width` range samples in
    the middle.
    """
    lines, samples = SIZES[small]
    raw = _raw(lines, samples, off_m_s)
    focus, doppler = OmegaK(SENSOR), DopplerCentroid(SENSOR)
    near = max(0, (samples - width) // 2)
    group = raw.isel(range=slice(near, near + width))
    velocity = EffectiveVelocity(OmegaK(replace(SENSOR, near_range_m=group.axes[-1].start)), reach_m_s=20.0)
    spent, began = dict[str, float](), time.perf_counter()

    def timed(part: str, work: Callable[..., Any], *given: Any, **values: Any) -> Any:
        log.info("frame: %s", part)
        start = time.process_time()
        result = work(*given, **values)
        spent[part] = time.process_time() - start
        return result

    centroid = timed("Doppler centroid", doppler, group)["doppler_hz"]
    speed = timed("velocity", velocity, group, doppler_hz=centroid)["velocity_m_s"]
    image = timed("focusing", focus, raw, doppler_hz=centroid, velocity_m_s=speed)
    amplitude = timed("modulus", Detect(), image)
    wall = time.perf_counter() - began
    import resource  # the module is not available on all operating systems

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    off = float(speed) - SENSOR.velocity_m_s - off_m_s
    return _Frame(spent, wall, torch.get_num_threads(), peak, off, amplitude.data.numel())


def _text_1(seen: _Frame, path: Path) -> list[Check]:
    whole, off = sum(seen.processor_s.values()), abs(seen.velocity_m_s)
    parts = ", ".join(f"{part} {seconds:.1f} s" for part, seconds in seen.processor_s.items())
    ours = (
        f"{seen.samples / 1e6:.0f} million samples in {whole:.0f} s of one processor ({parts}; threads: "
        f"{seen.threads}); {seen.wall_s:.0f} s of wall time on the machine as it was; memory of the process "
        f"{seen.peak_gb:.1f} GB at most"
    )
    return [
        statement("10 x 10 km", "less than a minute", whole < 60 and seen.peak_gb < 8, ours),
        statement("error of the velocity", "1 m/s is allowed", off < 1, f"{off:.2f} m/s"),
    ]


def _half_aperture_m() -> float:
    return SENSOR.velocity_m_s * DWELL_S / 2


def migration_change_m(over_m: float = 5000.0) -> float:
    """Compute by how much the range migration changes over a range.

    Args:
        over_m: The range in metres, by default half the frame.

    Returns:
        The change in metres.
    """
    return _half_aperture_m() ** 2 * over_m / (2 * RANGE_M**2)


def _parabola() -> Check:
    rest = _half_aperture_m() ** 4 / (8 * RANGE_M**3)
    phase = 4 * math.pi / SENSOR.wavelength_m * rest
    claim = "enough for 1 to 1.5 s"
    return statement("parabola of the range", claim, phase < math.pi / 4, f"{phase:.3f} rad are left at the ends")


def _velocity_error() -> float:
    """Error of the velocity that causes a phase of pi / 4 at the ends of the aperture."""
    quadratic = 4 * math.pi / SENSOR.wavelength_m * _half_aperture_m() ** 2 / (2 * RANGE_M)
    return math.pi / 4 * SENSOR.velocity_m_s / (2 * quadratic)


# items in the order of the paper
ITEMS = (
    Item("Text 1", "time of a frame of 10 x 10 km, by one command", _frame, _text_1),
    given(
        "Text 2",
        "resolution in slant range before weighting",
        number("c / 2B (m)", 0.75, SENSOR.wave_speed_m_s / (2 * SENSOR.pulse.bandwidth_hz), 0.005),
    ),
    given("Text 3", "approximation of the range of a target, Eq. (2)", _parabola()),
    given(
        "Text 4",
        "error of the effective velocity that is allowed",
        number("that leaves pi / 4 at the ends of the aperture (m/s)", 1.0, _velocity_error(), 0.3),
    ),
)
