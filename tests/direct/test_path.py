"""Images along any path of data of an independent generator, in which antennas never stop."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.direct.path import phase_history
from torchsar.core import Axis, Signal
from torchsar.echo import path_echo
from torchsar.focus import ImageGrid, image_tiles
from torchsar.metrics import impulse_response, registered_error_db
from torchsar.radar import AntennaPath, InverseRadar

POINTS = np.array([[0.0, 0.0, 0.0], [9.0, -6.0, 0.0], [-7.0, 8.0, 0.0]])
AMPLITUDE = np.array([1.0, 0.8, 0.9])
CARRIER_HZ, BANDWIDTH_HZ, FREQUENCIES, STEP_M = 9.6e9, 200e6, 80, 0.2


def aircraft(t: np.ndarray) -> np.ndarray:
    return np.stack([-1500 + 0.5 * np.sin(4 * t), 90.0 * t, 1200 + 0.2 * np.cos(3 * t)], -1)


def hill(t: np.ndarray) -> np.ndarray:
    return np.broadcast_to([-900.0, -700.0, 300.0], (*np.shape(t), 3))


@pytest.mark.parametrize("bistatic", [False, True])
def test_points_lie_where_they_are_and_the_image_is_that_of_our_own_echo(bistatic: bool) -> None:
    pulse_s = np.linspace(-0.6, 0.6, 96)
    transmitter, receiver = (hill, aircraft) if bistatic else (aircraft, aircraft)
    # positions as navigation records them, at the times of the pulses
    places = [torch.from_numpy(np.array(track(pulse_s))) for track in (transmitter, receiver)]
    reference = sum(torch.linalg.vector_norm(place, dim=-1) for place in places)
    history = phase_history(
        transmitter,
        receiver,
        POINTS,
        AMPLITUDE,
        pulse_s,
        reference.numpy(),
        CARRIER_HZ,
        BANDWIDTH_HZ,
        2e-6,
        FREQUENCIES,
    )
    step_hz = BANDWIDTH_HZ / FREQUENCIES
    frequency = CARRIER_HZ + step_hz * (torch.arange(FREQUENCIES, dtype=torch.float64) - FREQUENCIES // 2)
    antennas = AntennaPath(places[0], places[1], reference)
    radar = InverseRadar(CARRIER_HZ, BANDWIDTH_HZ, 80.0)
    own = path_echo(
        antennas, torch.from_numpy(POINTS), torch.from_numpy(AMPLITUDE)[None], radar, FREQUENCIES, torch.complex128
    )
    grid = ImageGrid(torch.tensor([-15.0, -15.0, 0.0]), torch.tensor([[0.0, 1, 0], [1, 0, 0]]), (151, 151), STEP_M)
    both = torch.stack([torch.from_numpy(history), own])
    images = image_tiles(both, frequency, *places, reference, grid, error_db=-60.0)
    axes = tuple(Axis(name, 151, -15.0, STEP_M, "m") for name in ("azimuth", "range"))
    at = torch.from_numpy(POINTS[:, 1].copy()), torch.from_numpy(POINTS[:, 0].copy())
    found = impulse_response(Signal(images[0], axes), at)
    for axis, true in zip(("azimuth", "range"), at, strict=True):
        # during the flight of 7 us the antenna moves by 1 mm, during the pulse by 0.2 mm
        assert float((found[f"position_{axis}_m"] - true).abs().max()) < 0.02
    level = found["peak"].abs() / both[0].numel()
    torch.testing.assert_close(level, torch.from_numpy(AMPLITUDE), rtol=0.03, atol=0)
    assert float(registered_error_db(*images)) < -25
