"""Whole half wavelengths of the line of sight (fringes), which the phases of pulses do not
determine.

They follow from the smoothness of the motion, and from the envelopes of the pulses.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.core import power_of, unit_phasor, wrapped
from torchsar.core.spline import legendre
from torchsar.metrics import entropy
from torchsar.optim import lbfgs
from torchsar.optim.scalar import vertex
from torchsar.radar import LIGHT_M_S
from torchsar.radar.spotlight import frequency_samples, range_profiles


def roughness(carrier_m: Tensor, fringe_m: float) -> Tensor:
    """Measure the second differences of the line of sight over the pulses, modulo a fringe.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (..., pulse).
        fringe_m: Half a wavelength in metres.

    Returns:
        Rms of the second differences, reduced to the nearest fringe, over that of arbitrary ones,
        shape (...,): 1 for rough motion, which says nothing about fringes.
    """
    bends = wrapped(carrier_m.diff(n=2, dim=-1), fringe_m)
    return bends.square().mean(-1).sqrt() * (math.sqrt(12) / fringe_m)


def smoothest(carrier_m: Tensor, fringe_m: float) -> Tensor:
    """Choose fringes so that all second differences are below half a fringe.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (..., pulse).
        fringe_m: Half a wavelength in metres.

    Returns:
        Line of sight in metres, up to a constant and a linear term, shape (..., pulse).
    """
    bends = wrapped(carrier_m.diff(n=2, dim=-1), fringe_m)
    begin, first = carrier_m[..., :1], wrapped(carrier_m[..., 1:2] - carrier_m[..., :1], fringe_m)
    steps = torch.cat([first, first + bends.cumsum(-1)], -1)
    return torch.cat([begin, begin + steps.cumsum(-1)], -1)


def smooth_near(
    carrier_m: Tensor,
    near_m: Tensor,
    before_m: Tensor,
    fringe_m: float,
    near_std_m: float,
    bend_std_m: Tensor,
    reach: int = 6,
) -> Tensor:
    """Choose fringes of a smooth line of sight, given a rough measurement of it.

    The Viterbi algorithm minimises the sum of the squared differences from the measurement and of
    the squared second differences, each over its variance. A measurement of one pulse may be wrong
    by any amount. Fringes are therefore sought around a median: that of the differences of the
    measurement from the previous line of sight, over the pulse and its neighbours. A difference
    counts by at most three standard deviations.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (trial, pulse).
        near_m: Measured line of sight in metres, shape (trial, pulse).
        before_m: Line of sight known before the measurement in metres, shape (trial, pulse).
        fringe_m: Half a wavelength in metres.
        near_std_m: Standard deviation of the measurement in metres.
        bend_std_m: Standard deviation of the second differences in metres, shape (trial,).
        reach: Largest number of fringes from the median.

    Returns:
        Line of sight in metres, shape (trial, pulse).
    """
    n = fringe_m * torch.arange(-reach, reach + 1, dtype=carrier_m.dtype, device=carrier_m.device)
    about = before_m + _local_median(near_m - before_m)
    places = (carrier_m + fringe_m * torch.round((about - carrier_m) / fringe_m))[..., None] + n
    far = ((places - near_m[..., None]) / near_std_m).square().clamp_max(3.0**2)
    weight = bend_std_m.clamp_min(1e-3 * fringe_m)[:, None, None, None].square().reciprocal()
    # cost (trial, place of the last pulse but one, place of the last pulse) of the best path that
    # ends there
    cost, back = far[:, 0, :, None] + far[:, 1, None, :], []
    for p in range(2, places.shape[1]):
        here, before, earlier = (places[:, p - i] for i in range(3))
        bend = here[:, None, None] - 2 * before[:, None, :, None] + earlier[:, :, None, None]
        total, chosen = (cost[..., None] + weight * bend.square()).min(1)
        cost = total + far[:, p, None, :]
        back.append(chosen)
    best = cost.flatten(1).argmin(-1)
    path = [best % len(n), best // len(n)]
    rows = torch.arange(len(cost), device=cost.device)
    for chosen in reversed(back):
        path.append(chosen[rows, path[-1], path[-2]])
    return places.gather(-1, torch.stack(path[::-1], -1)[..., None])[..., 0]


def rough_near(carrier_m: Tensor, near_m: Tensor, before_m: Tensor, fringe_m: float) -> Tensor:
    """Replace measurements of a rough line of sight that lie far from those of their neighbours.

    Args:
        carrier_m: Line of sight in metres, known modulo fringes, shape (trial, pulse).
        near_m: Measured line of sight in metres, shape (trial, pulse).
        before_m: Line of sight known before the measurement in metres, shape (trial, pulse). What
            a measurement adds to it is compared.
        fringe_m: Half a wavelength in metres.

    Returns:
        The measurements; where they lie six times as far from the median of their neighbours as
        usual, and two fringes or more, the place of the carrier that is nearest to that median.
    """
    median = before_m + _local_median(near_m - before_m)
    apart = (near_m - median).abs()
    limit = (6.0 * apart.median(-1, keepdim=True).values).clamp_min(2.0 * fringe_m)
    return torch.where(apart > limit, median + wrapped(carrier_m - median, fringe_m), near_m)


def _local_median(x: Tensor) -> Tensor:
    """Median of each value (trial, pulse) and its neighbours, 25 in all; at the ends, the nearest
    such median.

    There are so many because ten envelopes in a row were wrong at the ends of recordings.
    """
    pulses, width = x.shape[-1], min(25, x.shape[-1])
    medians = x.unfold(-1, width, 1).median(-1).values
    at = torch.arange(pulses, device=x.device) - width // 2
    return medians[..., at.clamp(0, pulses - width)]


def moved(profiles: Tensor, frequency_hz: Tensor, line_of_sight_m: Tensor) -> Tensor:
    """Remove an error of the line of sight from range profiles: from their envelopes and their
    phases.

    Args:
        profiles: Range profiles, shape (..., pulse, range), complex.
        frequency_hz: Frequencies in Hz, float64 (range,).
        line_of_sight_m: Recorded minus true half path in metres, float64 (..., pulse).

    Returns:
        Range profiles as if the recorded path were true over the middle of the scene.
    """
    turns = line_of_sight_m[..., None] * (frequency_hz * (-2 / LIGHT_M_S))
    return range_profiles(frequency_samples(profiles) * unit_phasor(turns, profiles.dtype))


def matched_m(profiles: Tensor, model: Tensor, frequency_hz: Tensor, reach_m: float) -> Tensor:
    """Measure the line of sight of each pulse against a model of its profile.

    Args:
        profiles: Range profiles, shape (pulse, range), complex.
        model: Model of them, same shape.
        frequency_hz: Frequencies in Hz, float64 (range,).
        reach_m: Largest error in metres.

    Returns:
        Error of the line of sight in metres, recorded minus true, at which envelope and phase match
        best, float64 (pulse,).
    """
    products = frequency_samples(profiles) * frequency_samples(model).conj()
    # twelve samples per fringe, by choice; the maximum is then found by a parabola
    step = LIGHT_M_S / (2 * float(frequency_hz.mean())) / 12
    count = max(1, math.ceil(reach_m / step))
    tried = step * torch.arange(-count, count + 1, dtype=torch.float64, device=products.device)
    match = (products @ unit_phasor(frequency_hz[:, None] * tried * (-2 / LIGHT_M_S), products.dtype)).real
    at = match.argmax(-1).clamp(1, len(tried) - 2)
    part = vertex(*(match.gather(-1, (at + i)[:, None])[:, 0].double() for i in (-1, 0, 1)))
    return tried[at] + step * part.clamp(-1, 1)


def drift_m(profiles: Tensor, frequency_hz: Tensor, imaging: Imaging, slopes: bool) -> Tensor:
    """Find how envelopes drift relative to the phases, by the entropy of the image.

    The drift is a polynomial of time that moves the envelopes and does not change the phase of the
    carrier.

    Args:
        profiles: Range profiles with the phases that focus them, shape (pulse, range), complex.
        frequency_hz: Frequencies in Hz, float64 (range,).
        imaging: Image formation.
        slopes: Whether to try slopes of some range cells first, each with one image.

    Returns:
        Range by which each envelope is too near in metres, to be removed by `moved`, float64
        (pulse,).
    """
    samples, pulses = frequency_samples(profiles), len(profiles)
    # a drift of 0.4 cells is the unit of the search, so that its first step is small
    unit = 0.4 * LIGHT_M_S / (2 * float(frequency_hz[-1] - frequency_hz[0]))
    # cycles per metre of displacement
    rate = (frequency_hz - frequency_hz.mean()) * (-2 / LIGHT_M_S)
    time = torch.linspace(-1, 1, pulses, dtype=torch.float64, device=samples.device)
    # The drift over the pulses is described by polynomials up to degree 6, by trial. Those of
    # degree 2 and more are constant outside of the middle 0.8 of the record. The Hann window is
    # below a tenth there, so that the ends would hardly be determined.
    bent = legendre(time.clamp(-0.8, 0.8), 6)[:, 2:]
    basis = torch.cat([time[:, None], bent], 1).mT * unit

    def shifted(x: Tensor) -> Tensor:
        return samples * unit_phasor((x @ basis)[..., None] * rate, samples.dtype)

    def cost_and_gradient(x: Tensor) -> tuple[Tensor, Tensor]:
        """Entropy of the image at one drift (1, term), and its gradient."""
        at = shifted(x)
        image = imaging.image(range_profiles(at))
        power = power_of(image)
        total = power.sum()
        log = torch.log((power / total).clamp_min(torch.finfo(power.dtype).tiny))
        value = -(power * log).sum() / total
        back = frequency_samples(imaging.adjoint(image * (-(log + value) / total)))
        # derivative of the samples with respect to the drift: 2j pi rate times the samples
        of_pulse = (-4 * math.pi) * ((back.conj() * at).imag.double() * rate).sum(-1)[0]
        return value.double()[None], (basis @ of_pulse)[None]

    start = torch.zeros(1, len(basis), dtype=torch.float64, device=samples.device)
    if slopes:  # linear drifts of up to 6 cells at the ends of the record, in steps of 0.6 cells
        tried = torch.nn.functional.pad(torch.arange(-10, 11).to(start)[:, None] * (0.6 / 0.4), (0, len(basis) - 1))
        costs = [entropy(imaging.image(range_profiles(shifted(x[None]))))[0].double() for x in tried]
        start = tried[torch.stack(costs).argmin(), None]
    found = lbfgs(cost_and_gradient, start, steps=8, first_step=0.3, with_gradient=True, value_tolerance=1e-5)
    return (found.x @ basis)[0]
