"""Phases across gaps: pulses that are missing are filled in.

The image of a point has side lobes where pulses are missing. Phases that shift the parts of the
record against each other in Doppler lower them, so that sharpness and a scene that contains them
find wrong phases: with a quarter of the record missing, by 0.5 rad in nearly every scene, and both
halves of the rows agree. With the missing pulses taken from the estimated scene there are no such
lobes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, rotate, safe_angle
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.sharpen import LEAST_PULSES_OF_FACTORS, WIENER_FACTORS, Wiener
from torchsar.core import host_value, power_of


def side_lobes(present: Tensor) -> Tensor:
    """Compute the largest side lobe that missing pulses make.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        The side lobe relative to the main lobe at the Dopplers of an image without padding, shape
        (trial,), float64; 0 without missing pulses and where lobes repeat the whole scene.
    """
    response = torch.fft.rfft(present.to(torch.float64)).abs()
    lobes = response[:, 1:] / or_one(response[:, :1])
    # lobes as high as the main lobe are images of the whole scene, as of every other pulse: they do
    # not change the sharpness
    return torch.where(lobes < 0.98, lobes, 0).amax(-1)


def have_gaps(present: Tensor) -> Tensor:
    """Say where missing pulses change the phases that sharpen an image, see `across_gaps`.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        True where they do, shape (trial,).
    """
    # with 0.07, a gap of a sixteenth of the record, errors of 40 points were a sixth larger
    return side_lobes(present) > 0.06


def longest_gap(present: Tensor) -> Tensor:
    """Compute the length of the longest gap between the first and the last pulse.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        The share of the pulses from the first to the last that the gap takes, shape (trial,),
        float64; 0 without pulses.
    """
    number = torch.arange(1, present.shape[-1] + 1, device=present.device)
    last = torch.where(present, number, 0).cummax(-1).values
    first = torch.where(present, number, number[-1] + 1).amin(-1, keepdim=True)
    steps = torch.where(present[:, 1:] & (number[1:] > first), number[1:] - last[:, :-1], 1).amax(-1)
    span = (last[:, -1:] - first + 1)[:, 0]
    return torch.where(present.any(-1), (steps - 1).double() / or_one(span.double()), 0)


def across_gaps(rows: Tensor, phase_rad: Tensor, iterations: int, tolerance_rad: float) -> Tensor:
    """Compare pulses with a Wiener estimate of the scene from all pulses and fill missing ones in.

    The weights, the steps and their factors are those of `autofocus`. The missing pulses are those
    of the last estimate.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex; missing ones are all zeros.
        phase_rad: Phase to start from in rad, shape (trial, pulse).
        iterations: Largest number of iterations.
        tolerance_rad: Phase step in rad, rms over the pulses and with the smallest factor, below
            which the iterations of a trial end.

    Returns:
        The phase in rad, shape (trial, pulse).
    """
    present, along, scene = (rows != 0).any(-2), AlongPulses(2), Wiener()
    factors = WIENER_FACTORS if rows.shape[-1] >= LEAST_PULSES_OF_FACTORS else (1.0,)
    filled, phase = torch.zeros_like(rows), phase_rad
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    for number in range(-6, iterations):  # the first six fill without changing phases
        pulses = torch.where(present[:, None], rotate(rows, phase), filled)
        image = along.image(pulses)
        power = power_of(image)
        mean = or_one(power.mean((-2, -1), keepdim=True))
        weight = scene.of_scene(power, mean)
        filled = along.adjoint(image * weight)
        if number < 0:
            continue
        others = filled - weight.mean(-1, keepdim=True) * pulses
        step = torch.where(present & active[:, None], safe_angle((others.conj() * pulses).sum(-2)), 0)
        phase = phase + factors[number % len(factors)] * step
        size = (min(factors) * step.detach()).square().sum(-1) / or_one(present.sum(-1))
        active = active & (size > tolerance_rad**2)
        # on an accelerator waiting for the decision costs as much as iterations that change nothing
        if phase.device.type == "cpu" and not host_value(active.sum(), 1):
            break
    return phase
