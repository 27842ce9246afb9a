"""Cramer-Rao bound of the line of sight along any path."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor

from torchsar.core import gathered_checks, linear_solve, matrix_inverse, refuse_non_finite
from torchsar.radar import LIGHT_M_S, AntennaPath
from torchsar.radar.antenna_path import refuse_unusable

# regularisation relative to the trace: the information about scatterers at equal positions would be
# singular
_RIDGE = 1e-12


@gathered_checks()
def line_of_sight_bound_m(
    frequency_hz: Tensor, antennas: AntennaPath, points_m: Tensor, amplitude: Tensor, noise_std: Tensor | float
) -> Tensor:
    """Compute the least error of the line of sight of all pulses, without its linear terms.

    >>> import torch
    >>> from torchsar import metrics, radar
    >>> place = torch.tensor([[-700.0, y, 700.0] for y in range(-20, 20, 4)], dtype=torch.float64)
    >>> path = radar.AntennaPath(place, None, 2 * place.norm(dim=-1))
    >>> point, frequency = torch.zeros(1, 3).double(), 9.6e9 + 1e7 * torch.arange(16.0).double()
    >>> bound = metrics.line_of_sight_bound_m(frequency, path, point, torch.ones(1) + 0j, 0.1)
    >>> round(1e6 * float(bound), 1)  # micrometres
    39.0

    The samples are those of point scatterers in white circular Gaussian noise. Unknown are one
    range per pulse, and the horizontal position and the complex amplitude of each scatterer. A
    constant and a linear term of the range over the pulses, which act as a displacement of the
    scene, are not part of the error.

    Args:
        frequency_hz: Frequencies in Hz, float64 (frequency,).
        antennas: True path.
        points_m: Positions of the scatterers in metres, float64 (..., point, 3).
        amplitude: Their amplitudes, complex (..., point).
        noise_std: Standard deviation of the complex noise of a sample, a number or shape (...,).

    Returns:
        Square root of the mean variance of the range (half the path) of a pulse in metres, float64
        (...,). The leading dimensions are those to which all arguments broadcast.

    Raises:
        TypeError: If frequencies or positions are not float64.
        ValueError: If values are not finite, the noise is not positive, or there are fewer than
            three pulses.

    Reference:
        Kay 1993, Fundamentals of Statistical Signal Processing: Estimation Theory, Eq. (15.52):
        the Fisher information of complex samples.
    """
    refuse_unusable(frequency_hz=frequency_hz, points_m=points_m)
    refuse_non_finite(amplitude, "amplitude", "give each scatterer a finite amplitude", "values")
    noise = torch.as_tensor(noise_std, dtype=torch.float64)
    if antennas.pulses < 3 or not bool(((noise > 0) & noise.isfinite()).all()):
        raise ValueError(
            "line_of_sight_bound_m needs at least three pulses and a positive finite noise_std, got "
            f"{antennas.pulses} pulses and a least noise_std of {float(noise.min()):g}"
        )
    trials = torch.broadcast_shapes(antennas.trials, points_m.shape[:-2], amplitude.shape[:-1], noise.shape)
    points, amplitude = points_m.expand(*trials, *points_m.shape[-2:]), amplitude.expand(*trials, amplitude.shape[-1])
    every = itertools.product(*map(range, trials))
    std = [_unit_std_m(frequency_hz, antennas.of_trial(one, trials), points[one], amplitude[one]) for one in every]
    return torch.stack(std).reshape(trials) * noise


def _unit_std_m(frequency_hz: Tensor, antennas: AntennaPath, points_m: Tensor, amplitude: Tensor) -> Tensor:
    """Bound for one trial and noise of unit variance."""
    pulses = antennas.pulses
    wave = frequency_hz * (2 * math.pi / LIGHT_M_S)
    amplitude = amplitude.to(torch.complex128)
    own = torch.zeros(pulses, dtype=torch.float64, device=wave.device)
    scene = torch.zeros(4 * len(points_m), 4 * len(points_m), dtype=torch.float64, device=wave.device)
    shared = torch.zeros(pulses, len(scene), dtype=torch.float64, device=wave.device)
    for p in range(pulses):
        legs = [place[p] - points_m for place in antennas.places]
        units = [leg / torch.linalg.vector_norm(leg, dim=-1, keepdim=True) for leg in legs]
        # derivative of the path with respect to the position of the scatterer
        slope = -2 * torch.stack(units).mean(0)
        path = antennas.path_m(points_m, slice(p, p + 1))[0]
        echo = torch.exp(-1j * torch.outer(wave, path))
        moved = (-1j * wave)[:, None] * echo * amplitude
        of_scene = torch.cat([echo, 1j * echo, moved * slope[:, 0], moved * slope[:, 1]], -1)
        of_range = -2j * wave * (echo @ amplitude)
        rows = torch.cat([of_scene.real, of_scene.imag])
        column = torch.cat([of_range.real, of_range.imag])
        scene += rows.mT @ rows
        shared[p], own[p] = column @ rows, column.square().sum()
    scale = scene.diagonal().clamp_min(torch.finfo(torch.float64).tiny).rsqrt()
    scene, shared = scene * scale * scale[:, None], shared * scale
    scene.diagonal().add_(_RIDGE * float(len(scene)))
    information = (torch.diag(own) - shared @ linear_solve(scene, shared.mT)) * 2
    time = torch.linspace(-1, 1, pulses, dtype=torch.float64, device=wave.device)
    line = torch.stack([torch.ones_like(time), time], -1)
    # basis of the errors that are orthogonal to constant and linear terms
    free = torch.linalg.qr(line, mode="complete").Q[:, 2:]
    variance = matrix_inverse(free.mT @ information @ free).diagonal().sum() / pulses
    return variance.sqrt()
