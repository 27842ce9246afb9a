"""Derivatives of minima, and of the estimators that find one, at low and high SNR."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.compensate import turning
from tests.helpers import assert_forward_equals_backward
from torchsar import compensate, echo, focus, multichannel, radar, scene
from torchsar.core import Draws, Signal, Stage
from torchsar.optim import implicit

F64 = torch.float64


def cost(x: Tensor, data: Tensor) -> Tensor:
    """Least where x is the root of the data, in units that differ by 1e6."""
    return (x * x.new_tensor([1.0, 1e6]) - data.sqrt()).square().sum(-1)


def test_derivatives_of_a_minimum() -> None:
    data = torch.tensor([[4.0, 9.0], [1.0, 16.0]], dtype=F64, requires_grad=True)
    minimum = data.detach().sqrt() * torch.tensor([1.0, 1e-6], dtype=F64)
    found = implicit(cost, minimum, data)
    assert torch.equal(found, minimum)
    wanted = 0.5 / data.detach().sqrt() * torch.tensor([1.0, 1e-6], dtype=F64)
    torch.testing.assert_close(torch.autograd.grad(found.sum(), data)[0], wanted, rtol=1e-10, atol=0)
    assert_forward_equals_backward(lambda x: implicit(cost, minimum, x), (data,))
    assert not implicit(cost, minimum, data.detach()).requires_grad


def test_without_curvature_derivatives_are_zero() -> None:
    """Beside a trial with a minimum: one where the cost does not depend on x, and a maximum."""
    data = torch.tensor([2.0, 0.0, -2.0], dtype=F64, requires_grad=True)
    found = implicit(lambda x, data: data * (x[..., 0] - data).square(), torch.ones(3, 1, dtype=F64), data)
    slope = torch.autograd.grad(found.sum(), data)[0]
    assert slope[0] != 0
    assert slope[1:].tolist() == [0.0, 0.0]


def strip(snr_db: float) -> tuple[Stage, Signal]:
    seen = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 100.0, 120.0, 4000.0, integration_s=1.0)
    points = scene.Points([0.0, 10.0, -20.0], [0.0, 30.0, -40.0])
    world = scene.StripmapWorld(points, scene.Dwell(1.0), velocity_m_s=125.0, doppler_hz=0.0, snr_db=snr_db)
    recording, _ = echo.simulate(seen, world, 256, 96, Draws(1, trials=range(2)), dtype=torch.complex128)
    return compensate.EffectiveVelocity(focus.OmegaK(seen), 20.0, 64, 1e-4), recording.signal


def centroid(snr_db: float) -> tuple[Stage, Signal]:
    stage, signal = strip(snr_db)
    return compensate.DopplerCentroid(stage._focuser[0].radar), signal


def point(snr_db: float) -> tuple[Stage, Signal]:
    seen = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0, pointing_doppler_hz=0.0)
    world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.4), doppler_hz=20.0, snr_db=snr_db)
    recording, _ = echo.simulate(seen, world, 256, 64, Draws(1, trials=range(2)), dtype=torch.complex128)
    return compensate.PointDoppler(seen), focus.OmegaK(seen)(recording.signal, doppler_hz=0.0)


def mover(snr_db: float, estimator: str = "MovingPointVelocity") -> tuple[Stage, Signal]:
    receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    world = scene.BistaticWorld(scene.MovingPoints([0.05], [0.2], [0.5], [0.0]), scene.BandLimited(1.0), snr_db=snr_db)
    signal = echo.simulate_bistatic(receiver, world, 200, None, Draws(1, trials=range(2)), dtype=torch.complex128)[0]
    search = {"search": multichannel.Search(6.0, 4.0, 20.0, 1.0)} if estimator == "MovingPointVelocity" else {}
    return getattr(multichannel, estimator)(receiver, multichannel.Dwell(1.0), **search), signal.signal


def rotation(snr_db: float) -> tuple[Stage, Signal]:
    clean = torch.stack([turning.echo(*turning.points(seed)) for seed in range(2)])
    noise = torch.stack([turning.noise_std(x, snr_db) * turning.noise(i, *x.shape) for i, x in enumerate(clean)])
    stage = compensate.EntropyRotation(turning.RADAR, "newton", start=[turning.OMEGA, *turning.K.tolist()])
    return stage, Signal(clean + noise, turning.RADAR.raw_axes(turning.PULSES, turning.BINS))


WORLDS = [strip, centroid, point, mover, lambda snr_db: mover(snr_db, "LikelihoodVelocity"), rotation]


@pytest.mark.slow
@pytest.mark.parametrize("snr_db", [0.0, 15.0, 40.0])
@pytest.mark.parametrize("world", WORLDS, ids=["velocity", "centroid", "point", "mover", "likelihood", "rotation"])
def test_estimators_on_good_data(world: Callable[[float], tuple[Stage, Signal]], snr_db: float) -> None:
    """Derivatives of the values agree with differences within 1 % of the largest of the trials."""
    stage, signal = world(snr_db)
    data = signal.data.clone().requires_grad_()
    found = stage(signal.with_data(data))
    direction = torch.randn(data.shape, dtype=data.dtype, generator=torch.Generator().manual_seed(2))
    step = 1e-5 * float(data.detach().abs().mean())
    with torch.no_grad():
        low, high, same = (stage(signal.with_data(data + side * step * direction)).value for side in (-1, 1, 0))
    for name in set(stage.provides) - {"ambiguity", "warp_k", "yc_m"}:
        assert torch.equal(found[name], same[name])
        slope = torch.autograd.grad(found[name].sum(), data, retain_graph=True)[0]
        got, wanted = (slope.conj() * direction).real.sum((-2, -1)), (high[name] - low[name]) / (2 * step)
        error = (got - wanted).abs().amax() / wanted.abs().amax()
        assert error < 0.01, f"{name}: {got.tolist()} for {wanted.tolist()}"
    assert not found.failed.any()
