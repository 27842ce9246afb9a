"""Autofocus through images along any path: adjoint, phases, noise, paths of single trials."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.compensate import PathAutofocus, path_autofocus
from torchsar.core import Draws, Recording, unit_phasor
from torchsar.echo import simulate_path
from torchsar.focus import ImageGrid, TileOperator, TilePlan
from torchsar.metrics import phase_rmse
from torchsar.radar import AntennaPath, InverseRadar
from torchsar.scene import Flight, PathWorld, RandomPoints, Sinusoid, StraightPath, Sway

F64 = torch.float64
RADAR = InverseRadar(9.6e9, 300e6, 64.0)
PULSES, CELLS = 64, 64
FLIGHT = Flight(StraightPath((-700.0, -20.0, 700.0), (0.0, 40.0, 0.0)), Sway(x=[Sinusoid(0.2, 1.5)]))
QUICK = {"search": 30, "polish": 4}


def recorded(trials: int, seed: int = 1, snr_db: float = 10.0) -> Recording:
    """Points that migrate through four range cells."""
    world = PathWorld(RandomPoints(20, 20.0, 16.0), FLIGHT, snr_db=snr_db)
    return simulate_path(RADAR, world, PULSES, CELLS, Draws(seed, trials=range(trials)))[0]


def path_of(recording: Recording) -> AntennaPath:
    return AntennaPath(recording.aux["transmitter_m"], None, recording.aux["path_reference_m"])


def white(trials: int, seed: int = 5) -> torch.Tensor:
    return 2 * math.pi * torch.rand(trials, PULSES, dtype=F64, generator=torch.Generator().manual_seed(seed))


def turned(data: torch.Tensor, phase: torch.Tensor) -> torch.Tensor:
    return data * unit_phasor(phase / (2 * math.pi), data.dtype)[..., None]


def test_the_operator_has_its_adjoint() -> None:
    recording = recorded(1)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    grid = ImageGrid(torch.tensor([-8.0, -8.0, 0.0]), torch.eye(3)[:2], (21, 17), 0.8)
    plan = TilePlan(frequency, antennas.transmitter_m, None, antennas.reference_m, grid, -60.0)
    operator = TileOperator(plan)
    made = torch.Generator().manual_seed(1)
    x = torch.randn(2, PULSES, CELLS, dtype=torch.complex128, generator=made)
    y = torch.randn(2, 21, 17, dtype=torch.complex128, generator=made)
    left, right = (operator.image(x) * y.conj()).sum(), (x * operator.adjoint(y).conj()).sum()
    assert abs(left - right) < 1e-10 * abs(left)
    moved = antennas.transmitter_m + torch.zeros(2, 1, 1, dtype=F64)
    with pytest.raises(ValueError, match=r"path that all trials share, got one for each of \(2,\)"):
        TileOperator(TilePlan(frequency, moved, None, antennas.reference_m, grid, -60.0))


def test_white_phases_of_migrating_scatterers_are_found_and_noise_is_not() -> None:
    recording, phase = recorded(2), white(2)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    noise = torch.randn(1, PULSES, CELLS, dtype=torch.complex64, generator=torch.Generator().manual_seed(2))
    data = torch.cat([turned(recording.signal.data, phase), noise])
    found = path_autofocus(data, frequency, antennas, **QUICK)
    error = phase_rmse(found["phase_rad"][:2], phase)
    assert found.ok.tolist() == [True, True, False] and bool((error < 0.2).all())
    std = found.std["phase_rad"][:2].square().mean(-1).sqrt()
    assert bool((error < 2.5 * std).all()), (error, std)


def test_trials_with_paths_of_their_own_equal_singles() -> None:
    recording, phase = recorded(2, seed=3), white(2, 7)
    frequency = recording.aux["frequency_hz"]
    place = recording.aux["transmitter_m"] + torch.tensor([0.0, 0.05], dtype=F64)[:, None, None]
    signal = recording.signal.with_data(turned(recording.signal.data, phase))
    known = {"frequency_hz": frequency, "path_reference_m": recording.aux["path_reference_m"]}
    stage = PathAutofocus(search=4, polish=1)
    both = stage(signal, transmitter_m=place, **known)
    one = stage(signal.with_data(signal.data[1]), transmitter_m=place[1], **known)
    assert both["phase_rad"].shape == (2, PULSES) and both.ok.shape == (2,)
    torch.testing.assert_close(both["phase_rad"][1], one["phase_rad"])


def test_paths_without_a_turn_and_other_sizes_are_refused() -> None:
    recording = recorded(1)
    frequency, antennas = recording.aux["frequency_hz"], path_of(recording)
    still = AntennaPath(antennas.transmitter_m[:1].expand(PULSES, 3), None, antennas.reference_m)
    with pytest.raises(ValueError, match="a line of sight that turns"):
        path_autofocus(recording.signal.data, frequency, still)
    with pytest.raises(ValueError, match=r"profiles \(..., pulse, range\) of \(64, 64\), got \(1, 63, 64\)"):
        path_autofocus(recording.signal.data[:, 1:], frequency, antennas)
