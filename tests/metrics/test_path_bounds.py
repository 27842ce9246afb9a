"""Bound of the line of sight along a path."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.metrics import line_of_sight_bound_m
from torchsar.radar import AntennaPath

F64 = torch.float64
PULSES, N = 24, 32
FREQUENCY = 9.6e9 + 300e6 / N * (torch.arange(N, dtype=F64) - N // 2)
TIME = torch.linspace(-1, 1, PULSES, dtype=F64)
PLACE = torch.stack([-700 + 0 * TIME, 20 * TIME, 700 + 0 * TIME], -1)
ANTENNAS = AntennaPath(PLACE, None, 2 * torch.linalg.vector_norm(PLACE, dim=-1))
POINTS = torch.tensor([[3.0, 2.0, 0.0], [-4.0, 1.0, 0.0], [5.0, -6.0, 0.0]], dtype=F64)
AMPLITUDE = torch.tensor([1.0, 2.0j, -1.0 + 0.5j])


def known_scene(amplitude: torch.Tensor, std: float) -> torch.Tensor:
    """Bound of a scene that is known, for each pulse, rms."""
    path = ANTENNAS.path_m(POINTS)
    wave = 2 * math.pi * FREQUENCY / 299792458.0
    echo = (torch.exp(-1j * wave[:, None] * path[:, None]) * amplitude).sum(-1)
    energy = (2 * wave * echo).abs().square().sum(-1)
    return (std**2 / 2 / energy).mean().sqrt()


def test_the_bound_exceeds_that_of_a_known_scene_and_follows_the_noise() -> None:
    bound = line_of_sight_bound_m(FREQUENCY, ANTENNAS, POINTS, AMPLITUDE, 0.3)
    assert 0.9 * known_scene(AMPLITUDE, 0.3) < bound < 2 * known_scene(AMPLITUDE, 0.3)
    double = line_of_sight_bound_m(FREQUENCY, ANTENNAS, POINTS, 2 * AMPLITUDE, 0.6)
    torch.testing.assert_close(double, bound)
    noise = torch.tensor([0.3, 0.6], dtype=F64)
    both = line_of_sight_bound_m(FREQUENCY, ANTENNAS, POINTS, torch.stack([AMPLITUDE, 2 * AMPLITUDE]), noise)
    torch.testing.assert_close(both, bound.expand(2))
    pair = AntennaPath(PLACE, PLACE.clone(), ANTENNAS.reference_m)
    torch.testing.assert_close(line_of_sight_bound_m(FREQUENCY, pair, POINTS, AMPLITUDE, 0.3), bound)


def test_other_paths_and_noise_are_refused() -> None:
    with pytest.raises(ValueError, match="at least three pulses and a positive finite noise_std"):
        line_of_sight_bound_m(FREQUENCY, ANTENNAS, POINTS, AMPLITUDE, 0.0)
    with pytest.raises(TypeError, match="float64"):
        line_of_sight_bound_m(FREQUENCY, ANTENNAS, POINTS.float(), AMPLITUDE, 1.0)
