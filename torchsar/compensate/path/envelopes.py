"""Line of sight of each pulse from its envelope, and envelopes that drift against the phases."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.core import power_of, unit_phasor
from torchsar.core.polynomials import legendre
from torchsar.metrics import entropy
from torchsar.optim import lbfgs
from torchsar.radar import LIGHT_M_S
from torchsar.radar.spotlight import frequency_samples, range_profiles

# slopes of the envelopes that are tried: drift at the ends of the record, and its step, in cells
_REACH_CELLS, _STEP_CELLS = 6.0, 0.6
# highest degree of the polynomials of a drift, and steps of their search, found by trial
_DEGREE, _STEPS = 6, 8
# share of the record outside of which polynomials of degree 2 and more are held, because a Hann
# window leaves less than a tenth there, so that the ends would run away
_HELD = 0.8
# unit of a drift in range cells, in which the search takes its first step
_UNIT_CELLS = 0.4


def moved(profiles: Tensor, frequency_hz: Tensor, line_of_sight_m: Tensor) -> Tensor:
    """Remove an error of the line of sight from range profiles, with the phases.

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
    # twelve samples of a fringe, by choice: the maximum is then found by a parabola
    step = LIGHT_M_S / (2 * float(frequency_hz.mean())) / 12
    count = max(1, math.ceil(reach_m / step))
    tried = step * torch.arange(-count, count + 1, dtype=torch.float64, device=products.device)
    match = (products @ unit_phasor(frequency_hz[:, None] * tried * (-2 / LIGHT_M_S), products.dtype)).real
    at = match.argmax(-1).clamp(1, len(tried) - 2)
    low, mid, high = (match.gather(-1, (at + i)[:, None])[:, 0].double() for i in (-1, 0, 1))
    bend = low - 2 * mid + high
    part = torch.where(bend < 0, (low - high) / (2 * torch.where(bend < 0, bend, -1)), 0).clamp(-1, 1)
    return tried[at] + step * part


def drift_m(profiles: Tensor, frequency_hz: Tensor, imaging: Imaging, slopes: bool) -> Tensor:
    """Find how envelopes drift against the phases, by the entropy of the image.

    The drift is a polynomial of time that moves the envelopes and leaves the phase of the carrier
    as it is.

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
    cell = LIGHT_M_S / (2 * float(frequency_hz[-1] - frequency_hz[0]))
    rate = (frequency_hz - frequency_hz.mean()) * (-2 / LIGHT_M_S)  # turns per metre
    time = torch.linspace(-1, 1, pulses, dtype=torch.float64, device=samples.device)
    bent = legendre(time.clamp(-_HELD, _HELD), _DEGREE)[:, 2:]
    basis = torch.cat([time[:, None], bent], 1).mT * (_UNIT_CELLS * cell)

    def shifted(x: Tensor) -> Tensor:
        return samples * unit_phasor((x @ basis)[..., None] * rate, samples.dtype)

    def cost(x: Tensor) -> Tensor:
        return entropy(imaging.image(range_profiles(shifted(x))))[0].double()

    def slope(x: Tensor) -> tuple[Tensor, Tensor]:
        found = [_cost_and_slope(shifted(row[None]), rate, basis, imaging) for row in x]
        return torch.stack([one[0] for one in found]), torch.stack([one[1] for one in found])

    start = torch.zeros(1, _DEGREE, dtype=torch.float64, device=samples.device)
    if slopes:
        count = math.ceil(_REACH_CELLS / _STEP_CELLS)
        tried = start.repeat(2 * count + 1, 1)
        tried[:, 0] = torch.arange(-count, count + 1) * (_STEP_CELLS / _UNIT_CELLS)
        start = tried[torch.stack([cost(x[None]) for x in tried]).argmin(), None]
    found = lbfgs(slope, start, steps=_STEPS, first_step=0.3, with_gradient=True, value_tolerance=1e-5)
    return (found.x @ basis)[0]


def _cost_and_slope(samples: Tensor, rate: Tensor, basis: Tensor, imaging: Imaging) -> tuple[Tensor, Tensor]:
    """Entropy of the image of samples (1, pulse, frequency), and its gradient in a drift."""
    image = imaging.image(range_profiles(samples))
    power = power_of(image)
    total = power.sum()
    log = torch.log((power / total).clamp_min(torch.finfo(power.dtype).tiny))
    value = -(power * log).sum() / total
    back = frequency_samples(imaging.adjoint(image * (-(log + value) / total)))
    # d samples / d drift = 2j pi rate samples
    of_pulse = (-4 * math.pi) * ((back.conj() * samples).imag.double() * rate).sum(-1)[0]
    return value.double(), basis @ of_pulse
