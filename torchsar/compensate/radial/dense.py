"""Phases of the pulses of a dense scene by maximum likelihood.

Many scatterers in a range cell interfere, and sharpness then prefers wrong phases. The phases of
greatest likelihood are the right ones, but a search that starts too far away ends in a local
maximum. It is therefore started from the phases that sharpen the image and from a smooth walk, and
if the results differ it is also made without a start. Only a result that was reached twice is
reliable.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import Pulses, or_one, prepare
from torchsar.compensate.pulse_phase.homogeneous import power_groups
from torchsar.compensate.pulse_phase.linking import linked
from torchsar.core import Estimate, cis, power_of
from torchsar.core.spline import UniformSpline
from torchsar.metrics.phase import phase_rmse
from torchsar.optim import adam

SAME_RAD = 0.1  # rms difference below which two results are the same
# Descent to a smooth walk of the phase: number of cosines, rms of the walk expected in rad, noise
# floors relative to the mean power, steps for each, and length of a step. A high floor lets the
# descent pass over local minima; the walks of velocities from dense scenes are 0.4 to 1.6 rad.
_COSINES, _WALK_RAD, _FLOORS, _STEPS, _RATE = 60, 1.0, (1e-1, 1e-2, 1e-3, 1e-4), 40, 0.15


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
    # Pulses are averaged to about 128 blocks, over which the residual phase is smooth; it makes the
    # search fast, because its time grows with the cube of their number.
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
    # variance of a random walk about a spline through the means of blocks of n steps, over n times
    # that of a step: .115, simulated for n = 2 to 16
    within = step_rad.to(torch.float64).square() * size * 0.115
    # two results of the same deviation differ by the square root of two of it
    spread = (std[best, trial].square() + (within + apart.square() / 2)[:, None]).sqrt()
    at = torch.arange(n, dtype=torch.float64, device=cells.device)
    block = ((at - first) / size).floor().clamp(0, count - 1).long()
    walk = UniformSpline(_without_line(chosen), first + (size - 1) / 2, size).at(at)
    return Walk(walk, spread[:, block], apart)


def _parts(found: Estimate) -> tuple[Tensor, Tensor, Tensor]:
    """Phase, likelihood and deviation; the first and third of shape (trial, pulse)."""
    return found["phase_rad"].double(), found.info["fit_nats"], found.std["phase_rad"].double()


def smooth_walk(rows: Tensor) -> Tensor:
    """Find the smooth walk of the phase that makes the spectra of the range cells most likely.

    The walk is a sum of cosines, whose amplitudes fall like those of a random walk. Range cells of
    similar power share a spectrum P. The sum of ln(P + floor) and of the squared amplitudes is
    minimised, with four floors, from the highest to the lowest.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.

    Returns:
        The phase in rad, shape (trial, pulse), float64.
    """
    n, real = rows.shape[-1], rows.real.dtype
    order = torch.arange(2, min(n // 2, _COSINES) + 2, dtype=real, device=rows.device)
    pulse = (torch.arange(n, dtype=real, device=rows.device) + 0.5) / n
    walks = torch.cos(math.pi * order[:, None] * pulse) * (_WALK_RAD * math.sqrt(30) / math.pi / order[:, None])
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
    for floor in _FLOORS:
        amplitude = adam(lambda x, floor=floor: cost(x, floor), amplitude, steps=_STEPS, rate=_RATE).x
    return (amplitude @ walks).to(torch.float64)


def _without_line(phase: Tensor) -> Tensor:
    """Phases (trial, pulse) without their slope, unwrapped, and without the line that fits them."""
    pulse = torch.arange(phase.shape[-1], dtype=torch.float64, device=phase.device)
    pulse, step = pulse - pulse.mean(), torch.diff(phase)
    step = step - torch.angle(cis(step.detach()).mean(-1, keepdim=True))
    step = step - 2 * math.pi * (step.detach() / (2 * math.pi)).round()
    whole = torch.nn.functional.pad(step.cumsum(-1), (1, 0))
    whole = whole - whole.mean(-1, keepdim=True)
    return whole - (whole * pulse).sum(-1, keepdim=True) / pulse.square().sum() * pulse
