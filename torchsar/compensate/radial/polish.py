"""Residual phase of each pulse after the motion was compensated by integrated velocities.

The error of integrated velocities grows over the record; the error of the phases estimated here
does not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, refuse_odd_counts, rotate, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.sharpen import Run, in_turn
from torchsar.core import Estimate

# standard deviation of the phase from which on it is not ok: a Strehl ratio of exp(-0.25) = 0.78
ENOUGH_STD_RAD = 0.5
# over-relaxation, found by trial: larger values converge faster, at 2 or more need not converge
_RELAXATION = 1.7
# level of the Wiener weights, found by trial: this share of the power of a typical bright cell, and
# at least so many times the mean power; higher levels exclude weak scatterers, lower ones include
# noise
_SHARE, _LEVEL = 0.02, 4.0


def phase_polish(
    data: Tensor, *, start: Tensor | None = None, iterations: int = 80, tolerance_rad: float = 0.005
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

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. Its standard deviation is predicted from
        the energy of the cells above the noise. `quality` is the share of the energy in cells that
        clearly exceed the noise. `ok` is False where the standard deviation is 0.5 rad or more.
        `info` holds "iterations", and "image_cells" and "range_cells" of shape (...,), the
        effective numbers of cells of the image and of range cells that hold this energy.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or the number of iterations is not a whole number of 1 or more.
    """
    pulses = prepare(data, "phase_polish", empty=False)
    refuse_odd_counts("phase_polish", 1, iterations=iterations)
    along = AlongPulses()
    begin = starting_phase(start, pulses, "phase_polish")
    begin = torch.zeros_like(pulses.rows[:, 0].real) if begin is None else begin
    settle = Run(_single_points, along, 1, 1.0, 0.0)
    search = Run(_scene, along, iterations, _RELAXATION, tolerance_rad)
    finish = Run(_near_peak, AlongPulses(2), 5, 1.0, tolerance_rad / 2)
    phase, taken = in_turn(pulses.rows, begin, [settle, search, finish])
    quality, std, scatterers, range_cells = _confidence(rotate(pulses.rows.detach(), phase.detach()))
    shape = pulses.trials
    # fewer than three pulses cannot distinguish a phase error from a shift of the image
    ok = (std < ENOUGH_STD_RAD) & (pulses.present.sum(-1) > 2)
    return Estimate(
        {"phase_rad": phase.to(torch.float64).reshape(*shape, pulses.n)},
        quality=quality.reshape(shape),
        ok=ok.reshape(shape),
        std={"phase_rad": std[:, None].expand(-1, pulses.n).reshape(*shape, pulses.n)},
        info={
            "iterations": taken.reshape(shape),
            "image_cells": scatterers.reshape(shape),
            "range_cells": range_cells.reshape(shape),
        },
    )


def _bright(power: Tensor) -> Tensor:
    """Power of a typical bright cell, (trial, 1, 1): the mean power weighted with the power."""
    return power.square().sum((-2, -1), keepdim=True) / power.sum((-2, -1), keepdim=True).clamp_min(
        torch.finfo(power.dtype).tiny
    )


def _single_points(power: Tensor, mean: Tensor) -> Tensor:
    """Power over the maximum of the range cell, for trials of few scatterers; else as `_scene`.

    Trials of few scatterers are those whose typical bright cell is within 3 dB of the brightest.
    """
    peak = power.amax(-1, keepdim=True)
    few = _bright(power) > 0.5 * peak.amax(-2, keepdim=True)
    return torch.where(few, power / torch.where(peak > 0, peak, 1), _scene(power, mean))


def _scene(power: Tensor, mean: Tensor) -> Tensor:
    """(p / (p + level))^2 of powers averaged over three range cells, minus the mean of its row.

    Without the mean, a pulse does not contribute to the scene with which it is compared.
    """
    pairs = power + power.roll(1, -2)
    local = (pairs + pairs.roll(-1, -2)) / 4
    share = local / (local + torch.maximum(_LEVEL * mean, _SHARE * _bright(power))).clamp_min(
        torch.finfo(power.dtype).tiny
    )
    weight = share.square()
    return weight - weight.mean(-1, keepdim=True)


def _near_peak(power: Tensor, mean: Tensor) -> Tensor:
    """Weights near one within 10 dB of the strongest cell of a range cell, falling below."""
    peak = power.amax(-1, keepdim=True)
    return power / torch.where(peak > 0, power + 0.1 * peak, 1)


def _confidence(rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Share of the energy that is scene, standard deviation of the phase, and cells, (trial,) each.

    rows: (trial, range, pulse), corrected. The noise level is the median cell of the image; cells
    that clearly exceed it are scene. The phase of a pulse is known to 1 / sqrt(2 g), where g is its
    energy over the noise variance. The effective numbers of cells of the image and of range cells
    are (sum e)^2 / sum e^2 of their energies e.
    """
    image = torch.fft.fft(rows, norm="ortho")
    power = (image.real.square() + image.imag.square()).to(torch.float64)
    whole = power.flatten(-2)
    noise = whole.median(-1).values[:, None, None] / 0.6931471805599453
    tiny = torch.finfo(torch.float64).tiny
    scene = torch.where(power > 12 * noise, power - noise, 0)
    row = scene.sum(-1)
    energy, total = row.sum(-1), whole.sum(-1)
    gain = energy / rows.shape[-1] / noise[:, 0, 0].clamp_min(1e-30)
    return (
        torch.where(total > 0, energy / total.clamp_min(tiny), 0),
        torch.where(total > 0, 1 / torch.sqrt(2 * gain.clamp_min(1e-3)), torch.pi),
        energy.square() / scene.square().sum((-2, -1)).clamp_min(tiny),
        energy.square() / row.square().sum(-1).clamp_min(tiny),
    )
