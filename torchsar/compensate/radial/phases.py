"""Residual phase of each pulse after the motion was compensated by integrated velocities.

The error of integrated velocities grows over the record; the error of the phases estimated here
does not. Phases that sharpen the image are correct where scatterers are few. Where many scatterers
in a range cell interfere, the sharpest image has wrong phases. The phases of greatest likelihood
are then correct, but a search that starts too far away ends in a local maximum. It is therefore
started from the phases that sharpen the image and from a smooth walk. If the results differ, it is
also made without a start. Only a result that was reached twice is reliable.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import Pulses, find_phases, or_one, prepare, refuse_odd_counts, starting_phase
from torchsar.compensate.pulse_phase.fixed_point import Run, Wiener, bright, in_turn
from torchsar.compensate.pulse_phase.homogeneous import power_groups
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.linking import linked
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    cis,
    differentiable,
    power_of,
)
from torchsar.core.spline import Spline
from torchsar.metrics.phase import phase_rmse
from torchsar.optim import adam

# found by trial: a higher level excludes weak scatterers, a lower one includes noise
_SCENE = Wiener(level=4.0, share=0.02)


@differentiable("where ok")
def phase_polish(
    data: Tensor,
    *,
    start: Tensor | None = None,
    iterations: int = 80,
    tolerance_rad: float = 0.005,
    assess: bool = True,
) -> Estimate:
    """Estimate the residual phase of each pulse relative to the scene that all pulses share.

    >>> import torch
    >>> from torchsar.compensate import phase_polish
    >>> phase = torch.tensor([0.0, 0.3, 0.5, 0.2, 0.0, -0.3, -0.5, -0.2])
    >>> point = torch.exp(1j * phase)[:, None] * torch.tensor([0.0, 1.0, 0.0])  # pulses, cells
    >>> (phase_polish(point, assess=False)["phase_rad"] - phase).abs().max().round(decimals=1)
    tensor(0., dtype=torch.float64)

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
        return in_turn(rows, at, _runs(4, 0.0))[0]

    found = conclude(pulses, *find_phases(pulses, find, begin), assess, again)
    return replace(found, value={"phase_rad": found["phase_rad"].to(torch.float64)})


def sharpened(rows: Tensor, start: Tensor | None, iterations: int, tolerance_rad: float) -> tuple[Tensor, Tensor]:
    """Estimate the phases as `phase_polish` does, without assessment.

    Args:
        rows: Range cells over the pulses, shape (trial, range, pulse), complex.
        start: Phase to start from in rad, shape (trial, pulse), or None for zero.
        iterations: Largest number of iterations, see `phase_polish`.
        tolerance_rad: Tolerance of the iterations in rad, see `phase_polish`.

    Returns:
        The phases in rad, shape (trial, pulse), and the iterations taken, shape (trial,).
    """
    start = torch.zeros_like(rows[:, 0].real) if start is None else start
    return in_turn(rows, start, [Run(_single_points, AlongPulses(), 1, 1.0, 0.0), *_runs(iterations, tolerance_rad)])


def _runs(iterations: int, tolerance_rad: float) -> list[Run]:
    """The iterations with Wiener weights, and the last ones, on twice as many Doppler cells.

    Over-relaxation by 1.7 was found by trial. Larger values converge faster, but with 2 or more the
    iterations need not converge.
    """
    last = Run(_near_peak, AlongPulses(2), 5, 1.0, tolerance_rad / 2)
    return [Run(_SCENE, AlongPulses(), iterations, 1.7, tolerance_rad), last]


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
    """Weights of image cells. In trials of few scatterers it is the power over the maximum of the
    range cell, in others the weight of `_SCENE`.

    Trials of few scatterers are those whose typical bright cell is within 3 dB of the brightest.
    """
    peak = power.amax(-1, keepdim=True)
    few = bright(power) > 0.5 * peak.amax(-2, keepdim=True)
    return torch.where(few, power / torch.where(peak > 0, peak, 1), _SCENE(power, mean))


def _near_peak(power: Tensor, mean: Tensor) -> Tensor:
    """Weights near one for cells within 10 dB of the strongest one of their range cell, and smaller
    ones for weaker cells.
    """
    peak = power.amax(-1, keepdim=True)
    return power / torch.where(peak > 0, power + 0.1 * peak, 1)


class PhasePolish(Stage):
    """Residual phase of each pulse after motion compensation; see `phase_polish`.

    Provides `phase_rad` of shape (..., pulse).

    Args:
        iterations: Largest number of iterations with Wiener weights.
        tolerance_rad: Phase step in rad, rms over the pulses, below which the iterations of a trial
            end.
        assess: False leaves out standard deviation and outcome.
    """

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}
    differentiable = "where ok"

    def __init__(self, iterations: int = 80, tolerance_rad: float = 0.005, assess: bool = True) -> None:
        super().__init__()
        self.options: dict[str, Any] = {"iterations": iterations, "tolerance_rad": tolerance_rad, "assess": assess}

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the residual phase of every pulse of a signal of axes (pulse, range).

        Returns:
            `Estimate` by the function `phase_polish` with `phase_rad` of shape (..., pulse), to be
            removed.
        """
        return phase_polish(signal.data, **self.options)


SAME_RAD = 0.1  # rms difference in rad below which two results count as the same


class Walk(NamedTuple):
    """Residual phases of dense scenes.

    Args:
        phase_rad: Phases in rad without steps of whole turns and without a straight line, shape
            (trial, pulse), float64.
        std_rad: Their standard deviation: that of the likelihood, of the walk within a block of
            pulses, and that which the difference of the two nearest results shows, same shape.
        apart_rad: Rms difference in rad of the nearest result from another start, shape (trial,).
    """

    phase_rad: Tensor
    std_rad: Tensor
    apart_rad: Tensor


def linked_walk(cells: Tensor, polished_rad: Tensor, step_rad: Tensor) -> Walk:
    """Estimate the residual phase of each pulse of dense scenes by maximum likelihood.

    Args:
        cells: Range cells after motion compensation and azimuth deramping, shape (trial, pulse,
            range), complex, of 32 pulses or more.
        polished_rad: Phases that sharpen the image in rad, shape (trial, pulse).
        step_rad: Standard deviation of the phase step between pulses that is due to noise in rad,
            shape (trial,).

    Returns:
        The most likely of the phases from two or three starts.
    """
    n = cells.shape[-2]
    # Pulses are averaged to about 128 blocks, over which the residual phase is smooth. This makes
    # the search fast, because its time grows with the cube of their number.
    size = max(1, n // 128)
    count = n // size
    first = (n - count * size) // 2

    def averaged(x: Tensor) -> Tensor:
        return x[:, first : first + count * size].unflatten(1, (count, size)).mean(2)

    pulses = prepare(averaged(cells), "linked_walk", empty=False)
    start = torch.angle(averaged(cis(polished_rad.detach().to(torch.float64))))
    results = [linked(pulses, begin, still=True) for begin in (start, smooth_walk(pulses.rows.detach()))]
    phase, gain, std = (torch.stack(parts) for parts in zip(*map(_parts, results), strict=True))
    differ = (phase_rmse(phase[0], phase[1]) > SAME_RAD).nonzero()[:, 0]
    if len(differ):
        third = _parts(linked(Pulses(pulses.rows[differ], pulses.present[differ], differ.shape), still=True))
        phase, gain, std = (
            torch.cat([of_two, of_two[:1].index_copy(1, differ, of_third[None])])
            for of_two, of_third in zip((phase, gain, std), third, strict=True)
        )
    best = gain.argmax(0)
    trial = torch.arange(len(best), device=best.device)
    chosen = phase[best, trial]
    apart = phase_rmse(phase, chosen).index_put((best, trial), torch.full_like(gain[0], torch.inf)).amin(0)
    # Variance of a random walk around a spline through the means of blocks of n steps: 0.115 n
    # times that of a step, simulated for n = 2 to 16.
    within = step_rad.to(torch.float64).square() * size * 0.115
    # two results of equal standard deviation differ by the square root of two times that deviation
    spread = (std[best, trial].square() + (within + apart.square() / 2)[:, None]).sqrt()
    at = torch.arange(n, dtype=torch.float64, device=cells.device)
    block = ((at - first) / size).floor().clamp(0, count - 1).long()
    walk = Spline(_without_line(chosen), (first + (size - 1) / 2, size)).at(at)
    return Walk(walk, spread[:, block], apart)


def _parts(found: Estimate) -> tuple[Tensor, Tensor, Tensor]:
    """Phase, log likelihood and standard deviation of an estimate; phase and deviation of shape
    (trial, pulse).
    """
    return found["phase_rad"].double(), found.info["fit_nats"], found.std["phase_rad"].double()


def smooth_walk(rows: Tensor) -> Tensor:
    """Find the smooth walk of the phase that makes the spectra of the range cells most likely.

    The walk is a sum of cosines, whose amplitudes fall like those of a random walk of 1 rad rms;
    the walks of velocities from dense scenes are 0.4 to 1.6 rad. Range cells of
    similar power share a spectrum P. The sum of ln(P + floor) and of the squared amplitudes is
    minimised, with four floors, from the highest to the lowest.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.

    Returns:
        The phase in rad, shape (trial, pulse), float64.
    """
    n, real = rows.shape[-1], rows.real.dtype
    order = torch.arange(2, min(n // 2, 60) + 2, dtype=real, device=rows.device)
    pulse = (torch.arange(n, dtype=real, device=rows.device) + 0.5) / n
    walks = torch.cos(math.pi * order[:, None] * pulse) * (math.sqrt(30) / math.pi / order[:, None])
    power = power_of(rows).mean(-1)
    member = power_groups(power).to(real)
    cells = member.sum(-1)
    window = torch.hann_window(n + 2, periodic=False, dtype=real, device=rows.device)[1:-1]
    z = rows / or_one(power.mean(-1))[:, None, None].sqrt() * (window / window.norm())

    def cost(amplitude: Tensor, floor: float) -> Tensor:
        image = torch.fft.fft(z * cis(-amplitude @ walks)[:, None])
        spectra = torch.einsum("gtr,trk->gtk", member, power_of(image)) / or_one(cells)[..., None]
        raised = spectra + floor * spectra.mean(-1, keepdim=True) + torch.finfo(real).tiny
        return (cells * raised.log().sum(-1)).sum(0) + amplitude.square().sum(-1) / 2

    amplitude = torch.zeros(len(rows), len(order), dtype=real, device=rows.device)
    # the first descents have a high floor and therefore pass over local minima
    for floor in (1e-1, 1e-2, 1e-3, 1e-4):
        amplitude = adam(lambda x, floor=floor: cost(x, floor), amplitude, steps=40, rate=0.15).x
    return (amplitude @ walks).to(torch.float64)


def _without_line(phase: Tensor) -> Tensor:
    """Unwrap phases (trial, pulse), and remove the line that fits them best."""
    pulse = torch.arange(phase.shape[-1], dtype=torch.float64, device=phase.device)
    pulse, step = pulse - pulse.mean(), torch.diff(phase)
    step = step - torch.angle(cis(step.detach()).mean(-1, keepdim=True))
    step = step - 2 * math.pi * (step.detach() / (2 * math.pi)).round()
    whole = torch.nn.functional.pad(step.cumsum(-1), (1, 0))
    whole = whole - whole.mean(-1, keepdim=True)
    return whole - (whole * pulse).sum(-1, keepdim=True) / pulse.square().sum() * pulse
