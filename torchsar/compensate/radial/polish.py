"""Residual phase of each pulse after the motion was compensated by integrated velocities.

The error of integrated velocities grows over the record; the error of the phases estimated here
does not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import find_phases, prepare, refuse_odd_counts, starting_phase
from torchsar.compensate.pulse_phase.fixed_point import Run, Wiener, bright, in_turn
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.core import Estimate, power_of

# over-relaxation, found by trial: larger values converge faster, at 2 or more need not converge
_RELAXATION = 1.7
# found by trial: higher levels exclude weak scatterers, lower ones include noise
_SCENE = Wiener(level=4.0, share=0.02)


def phase_polish(
    data: Tensor,
    *,
    start: Tensor | None = None,
    iterations: int = 80,
    tolerance_rad: float = 0.005,
    assess: bool = True,
) -> Estimate:
    """Estimate the residual phase of each pulse relative to the scene that all pulses share.

    It is meant for pulses whose motion was compensated by integrated velocities. The phase that
    remains is a random walk of the order of a radian with small steps, so that the iterations can
    start from zero. If it is larger, they may end in an image with two peaks; a start such as the
    result of `pga` prevents this. Differentiable.

    Every iteration forms the image, weights its cells, transforms it back to pulses, and takes the
    phase of each pulse relative to the result. With the power p of a cell and the maximum p_max of
    its range cell, three kinds of weights are used one after another:

    - One step with the weights p / p_max, which already suffices for a trial of single points. A
      trial of many scatterers starts with the next kind instead.
    - Up to `iterations` over-relaxed steps with Wiener weights. The noise level of the Wiener
      filter is a fiftieth of the power of a typical bright cell, and at least four times the mean
      power.
    - Up to five steps with the weights p / (p + p_max / 10), on twice as many Doppler cells. They
      include scatterers that are illuminated for a part of the record only.

    For single points the error reaches the Cramer-Rao bound of the phase of one sweep where the SNR
    after compression exceeds about 14 dB. A constant and a slope of the phase, which only shift the
    image, stay near zero.

    Args:
        data: Range-compressed pulses after motion compensation and azimuth deramping, by which
            scatterers become tones, shape (..., pulse, range), complex. If only the range cells
            about the scatterers are given, the estimate takes less time and less noise enters.
        start: Phase to start from in rad, shape (..., pulse); by default zero.
        iterations: Largest number of iterations with Wiener weights.
        tolerance_rad: Phase step in rad, rms over the pulses, below which the steps with Wiener
            weights end; the last kind of steps ends below half of it.
        assess: False leaves out the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. `assess=True` adds the standard deviation,
        which follows from two halves of the range cells, and the outcome; `quality`, the outcomes
        and `info` are those of `autofocus`.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or the number of iterations is not a whole number of 1 or more.
    """
    pulses = prepare(data, "phase_polish")
    refuse_odd_counts("phase_polish", 1, iterations=iterations)
    begin = starting_phase(start, pulses, "phase_polish")

    def find(rows: Tensor, present: Tensor, at: Tensor | None) -> tuple[Tensor, Tensor]:
        return sharpened(rows, at, iterations, tolerance_rad)

    def again(rows: Tensor, which: Tensor | slice, at: Tensor) -> Tensor:
        runs = [Run(_SCENE, AlongPulses(), 4, _RELAXATION, 0.0), Run(_near_peak, AlongPulses(2), 5, 1.0, 0.0)]
        return in_turn(rows, at, runs)[0]

    found = conclude(pulses, *find_phases(pulses, find, begin), assess, again)
    return replace(found, value={"phase_rad": found["phase_rad"].to(torch.float64)})


def sharpened(rows: Tensor, start: Tensor | None, iterations: int, tolerance_rad: float) -> tuple[Tensor, Tensor]:
    """Estimate the phases as `phase_polish` does, without a verdict.

    Args:
        rows: Range cells over the pulses, shape (trial, range, pulse), complex.
        start: Phase to start from in rad, shape (trial, pulse), or None for zero.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.

    Returns:
        The phases in rad, shape (trial, pulse), and the iterations taken, shape (trial,).
    """
    start = torch.zeros_like(rows[:, 0].real) if start is None else start
    runs = [
        Run(_single_points, AlongPulses(), 1, 1.0, 0.0),
        Run(_SCENE, AlongPulses(), iterations, _RELAXATION, tolerance_rad),
        Run(_near_peak, AlongPulses(2), 5, 1.0, tolerance_rad / 2),
    ]
    return in_turn(rows, start, runs)


@torch.no_grad()
def scene_cells(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the effective numbers of image cells and of range cells that hold the scene.

    The noise level is the median cell of the image; cells that clearly exceed it are scene. The
    effective number of cells with the energies e is (sum e)^2 / sum e^2.

    Args:
        rows: Corrected range cells over the pulses, shape (trial, range, pulse), complex.

    Returns:
        The number of image cells and that of range cells, float64 (trial,) each.
    """
    power = power_of(torch.fft.fft(rows, norm="ortho")).to(torch.float64)
    noise = power.flatten(-2).median(-1).values[:, None, None] / math.log(2)
    scene = torch.where(power > 12 * noise, power - noise, 0)
    row, tiny = scene.sum(-1), torch.finfo(torch.float64).tiny
    energy = row.sum(-1).square()
    return (
        energy / scene.square().sum((-2, -1)).clamp_min(tiny),
        energy / row.square().sum(-1).clamp_min(tiny),
    )


def _single_points(power: Tensor, mean: Tensor) -> Tensor:
    """Power over the maximum of the range cell, for trials of few scatterers; else as `_SCENE`.

    Trials of few scatterers are those whose typical bright cell is within 3 dB of the brightest.
    """
    peak = power.amax(-1, keepdim=True)
    few = bright(power) > 0.5 * peak.amax(-2, keepdim=True)
    return torch.where(few, power / torch.where(peak > 0, peak, 1), _SCENE(power, mean))


def _near_peak(power: Tensor, mean: Tensor) -> Tensor:
    """Weights near one within 10 dB of the strongest cell of a range cell, falling below."""
    peak = power.amax(-1, keepdim=True)
    return power / torch.where(peak > 0, power + 0.1 * peak, 1)
