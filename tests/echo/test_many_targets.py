"""Echoes of many targets are sums by a non-uniform FFT, those of few by a matrix product."""

from __future__ import annotations

import pytest
import torch

from torchsar import Draws, echo, radar, scene
from torchsar.core import unit_phasor
from torchsar.echo.strip import path_geometry
from torchsar.echo.sums import LineSum
from torchsar.metrics import error_db
from torchsar.reproduce.geo.sensor import INTEGRATION_S, RADAR


def _random(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(len(shape))) - 0.5


def _strip(y, x, amplitude, dtype):
    sar = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    # targets at other times than the dwell are left out of the sum
    world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.01))
    placed = path_geometry(scene.Scatterers(2 * y, 150 * x, amplitude), sar, 9, 128, 0.0, 120.0)
    return echo.stripmap_echo(placed, world, sar, 9, 128, dtype)


def _path(y, x, amplitude, dtype):
    place = torch.stack([torch.full((9,), -800.0), 5 * torch.arange(9.0) - 20, torch.full((9,), 600.0)], -1).double()
    antennas = radar.AntennaPath(place, None, 2 * place.norm(dim=-1))
    points = torch.stack([30 * x, 30 * y, 0 * x], -1)
    return echo.path_echo(antennas, points, amplitude[None], radar.InverseRadar(1e10, 1e8, 100.0), 96, dtype)


def _geo(y, x, amplitude, dtype):
    still = scene.MovingPoints((0 * x).tolist(), (0 * x).tolist(), (90 * y).tolist(), (200 * x).tolist())
    movers = still.movers(RADAR, Draws(1)).each(lambda v: v)
    movers = type(movers)(**{**vars(movers), "amplitude": amplitude})
    return echo.bistatic_echo(movers, RADAR, 9, 96, gate=scene.BandLimited(INTEGRATION_S), dtype=dtype)


def _sal(y, x, amplitude, dtype):
    ladar = radar.TriangularLadar(1.934e14, 5e9, 16e-6, 16e6, 60.0, 3000.0)
    return echo.ladar_echo(scene.Scatterers(0.5 * y, 1.2 * x, amplitude), ladar, 9, dtype=dtype)


@pytest.mark.parametrize("echo_of", [_strip, _path, _geo, _sal])
@pytest.mark.parametrize(("dtype", "worst_db"), [(torch.complex64, -125.0), (torch.complex128, -230.0)])
def test_echoes_of_many_targets_are_the_sums_of_those_of_few(echo_of, dtype, worst_db):
    given = _random(2, 150)
    amplitude = torch.complex(*_random(2, 1, 150)[:, 0])
    whole = echo_of(*given, amplitude, dtype)
    parts = [echo_of(*given[:, i : i + 50], amplitude[i : i + 50], torch.complex128) for i in (0, 50, 100)]
    assert float(error_db(whole, torch.stack(parts).sum(0)).max()) < worst_db


@pytest.mark.parametrize("first", [-16, -15.5])
@pytest.mark.parametrize("n", [33, 80])
def test_sum_by_transform_is_the_sum_and_so_are_its_gradients(n, first):
    turns, weight = 3 * _random(2, 3, 70), torch.complex(_random(3, 70), _random(3, 70).flip(-1))
    given = turns.requires_grad_(), weight.requires_grad_()

    def direct(turns, weight):
        steps = torch.arange(n, dtype=torch.float64) + first
        return (weight[..., None] * unit_phasor(turns[..., None] * steps, torch.complex128)).sum(-2)

    def transform(turns, weight):
        return LineSum(turns, n, first, torch.complex128, by_transform=True)(weight)

    found, exact = transform(*given), direct(*given)
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-11)
    seed = torch.complex(_random(*exact.shape), _random(*exact.shape).flip(0))
    for gradients in zip(*(torch.autograd.grad(x, given, seed) for x in (found, exact)), strict=True):
        torch.testing.assert_close(*gradients, rtol=1e-10, atol=1e-9)


def test_a_row_does_not_depend_on_other_trials():
    turns, weight = _random(4, 5, 70), torch.complex(*_random(2, 4, 5, 70))
    whole = LineSum(turns, 96, -48, torch.complex64)(weight.to(torch.complex64))
    alone = LineSum(turns[2], 96, -48, torch.complex64)(weight[2].to(torch.complex64))
    torch.testing.assert_close(whole[2], alone, rtol=0, atol=0)


@pytest.mark.parametrize("turns", [1e18, 1e300, float("inf"), float("nan")])
@pytest.mark.parametrize("by_transform", [True, False])
def test_phases_that_float64_does_not_resolve_are_refused(turns, by_transform):
    given = torch.full((2, 70), 0.25, dtype=torch.float64)
    given[1, 3] = turns
    with pytest.raises(ValueError, match="phase must be at most 4e"):
        LineSum(given, 96, -48, torch.complex64, by_transform)
