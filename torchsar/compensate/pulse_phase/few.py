"""Few scatterers, compared with each other.

Halves of the range cells hold the same few scatterers and agree on phases that are wrong, where a
scatterer moves within the target or several of them lie at one range.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import dealt, or_one, rotate, safe_angle
from torchsar.compensate.pulse_phase.halves import Again, half_of, settled_apart
from torchsar.core import host_value, power_of, true_positions
from torchsar.metrics.phase import phase_rmse

# A single point: largest relative scatter of its modulus, far below the 0.52 of noise.
STEADY = 0.25
# Few scatterers differ where their phases do by more than this multiple of what noise explains, and
# by more rad, because a step does not go all the way. Up to 10 dB a tenth of the scenes of 2
# to 6 points that stay do so, and at 0 dB nine of ten of those that walk within 40 of 128 pulses.
_BEYOND_NOISE, _BEYOND_RAD = 1.5, 0.02
# Several scatterers in a range cell are less certain than the noise bound, as halves that hold the
# same scatterers show; but not by more than this: four rows of four points at -8 dB differed by 1.7
# to 2.2 times the bound.
_MOST_NOISE = 2.5
# range cells of each half, which hold few scatterers
_FEW_CELLS = 16
# effective number of rows up to which a half holds few scatterers, not clutter beside a point
_MOST_ROWS = 6
# effective number of ranges below which all scatterers have one range
_ONE_RANGE = 1.2


def between_scatterers(
    rows: Tensor,
    present: Tensor,
    phase: Tensor,
    again: Again,
    noise: Tensor,
    mixed_rad: Tensor,
    of_point: Tensor,
    few: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Compare few scatterers with each other.

    Each scatterer has a phase of its own if it moves within the target, and halves of the rows that
    hold the same one do not show it. The halves here have none in common. The difference that noise
    explains follows from the energy of each half over the power of the noise; it is more where
    halves with the same scatterers differ by more, because several scatterers share a range cell. A
    half whose scatterers have one range tells nothing unless it is a single point, because phases
    can be found that make it one.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phase that focuses them in rad, shape (trial, pulse).
        again: Continues the method that found it.
        noise: Variance of the noise of a sample, shape (trial,).
        mixed_rad: Half of the difference between halves that hold the same scatterers in rad, 0
            where a single point makes the image sharp, shape (trial,), float64.
        of_point: Scatter of the echo of the strongest point in rad, shape (trial,).
        few: True for trials that are compared, shape (trial,).

    Returns:
        The standard deviation of the phase in rad, float64: the difference beyond noise, and at
        least the scatter of the strongest point where all scatterers have one range; whether the
        scatterers differ beyond noise; and whether a half tells nothing, bool; shape (trial,) each.
        Zero and False for trials that are not compared. Where noise hides all but one scatterer,
        there is no difference beyond noise.
    """
    zero, no = torch.zeros_like(phase[:, 0], dtype=torch.float64), torch.zeros_like(few)
    count = host_value(few.sum(), len(few))
    if not count:
        return zero, no, no
    at = true_positions(few, count)
    rows, present, phase = rows[at], present[at], phase[at]
    noise = noise[at]
    energy, pulses = power_of(rows).sum(-1), present.sum(-1)
    half, parts, variance, blind = dealt(energy, 2), [], torch.zeros_like(noise), no[at]
    for k in (0, 1):
        power, strongest = torch.where(half == k, energy, -1).sort(-1, descending=True)
        power, strongest = (x[:, : min(-(-x.shape[-1] // 2), _FEW_CELLS)] for x in (power, strongest))
        inside = power >= 0
        part = rows.gather(1, strongest[..., None].expand(-1, -1, rows.shape[-1])) * inside[..., None]
        # energy of the scatterers in noise variances, in as many rows as show most of them, beyond
        # a noise that is a tenth stronger than the median says, and four deviations of its sum
        samples = inside.cumsum(-1) * pulses[:, None]
        seen = power.clamp_min(0).cumsum(-1) / or_one(noise)[:, None] - 1.1 * samples - 4 * samples.sqrt()
        seen = seen.amax(-1)
        excess = (power / or_one(noise)[:, None] - 1.1 * pulses[:, None]).clamp_min(0).to(torch.float64)
        points = excess.sum(-1).square() < _MOST_ROWS * excess.square().sum(-1)
        of_noise = torch.where((seen > 0) & points, pulses / (2 * or_one(seen)), torch.inf)
        scatter, _ = scatter_of_point(rotate(part, phase), present)
        unsteady = scatter.square() > STEADY**2 + 2 * of_noise
        blind = blind | (unsteady & _of_one_range(part, noise, pulses))
        variance = variance + of_noise
        parts.append(part)
    single = _of_one_range(torch.cat(parts, 1), noise, pulses)
    expected = variance.sqrt() / 2
    largest = torch.minimum(_BEYOND_NOISE * mixed_rad[at], _MOST_NOISE * expected)
    largest = torch.maximum(_BEYOND_NOISE * expected + _BEYOND_RAD, largest)
    apart = half_of(parts, [again(part, at, phase) for part in parts], phase, present)
    unlike = (apart > largest) & ~blind
    count = host_value(unlike.sum(), len(unlike))
    if count:
        far = true_positions(unlike, count)
        parts, present, phase = [part[far] for part in parts], present[far], phase[far]
        ends = settled_apart(parts, present, phase, again, at[far])
        apart = apart.index_copy(0, far, half_of(parts, ends, phase, present))
    unlike = unlike & (apart > largest)
    std = torch.where(unlike, (apart.square() - expected.square()).clamp_min(0).sqrt(), 0)
    std = torch.where(single, torch.maximum(std, of_point[at]), std)
    found = (whole.index_copy(0, at, some) for whole, some in ((zero, std), (no, unlike), (no, blind)))
    std, unlike, blind = (torch.where(few, x, torch.zeros_like(x)) for x in found)
    return std, unlike, blind


def _of_one_range(rows: Tensor, noise: Tensor, pulses: Tensor) -> Tensor:
    """Whether all scatterers in rows (trial, range, pulse) have one range, a bool per trial.

    The effective number of ranges is that of the eigenvalues of the covariance of the rows, without
    noise of this variance in so many pulses of the rows that are not empty.
    """
    cells = (rows != 0).any(-1).sum(-1)
    covariance = rows @ rows.mH
    total = covariance.diagonal(dim1=-2, dim2=-1).real.sum(-1).to(torch.float64)
    squares = power_of(covariance).sum((-2, -1)).to(torch.float64)
    scene = (total - pulses * cells * noise).clamp_min(0)
    squares = squares - 2 * pulses * noise * scene - cells * pulses * (cells + pulses) * noise.square()
    return (scene > 0) & (scene.square() < _ONE_RANGE * squares)


def scatter_of_point(focused: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the scatter of modulus and phase of the strongest point over the pulses.

    The rows are added up with the weights and phases of the point: with the conjugate of its cell
    in the image.

    Args:
        focused: Pulses with the phases removed, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).

    Returns:
        The standard deviation of the modulus over its mean, and that of the phase in rad about a
        straight line, shape (trial,) each.
    """
    bright = power_of(focused).sum(-1).argmax(-1)
    row = focused.gather(1, bright[:, None, None].expand(-1, 1, focused.shape[-1]))
    at = torch.fft.fft(row).abs().argmax(-1)[..., None].expand(-1, focused.shape[-2], 1)
    echo = (focused * torch.fft.fft(focused).gather(-1, at).conj()).sum(-2)
    modulus, count = echo.abs().to(torch.float64), present.sum(-1).clamp_min(1)
    mean = modulus.sum(-1) / count
    spread = torch.where(present, (modulus - mean[:, None]).square(), 0).sum(-1) / (count - 1).clamp_min(1)
    angle = safe_angle(echo).to(torch.float64)
    return torch.where(mean > 0, spread.sqrt() / or_one(mean), torch.pi), phase_rmse(angle, 0 * angle, present)
