"""Assessment of phases: a second act that can be left out, with a reason for every doubt."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.compensate.scenes import spread_points
from torchsar import Outcome
from torchsar.compensate import (
    Autofocus,
    EntropyFixedPoint,
    LinkPhases,
    Pga,
    PgaSca,
    Sca,
    SharpestPhase,
    autofocus,
    entropy_fixed_point,
    link_phases,
    pga,
    pga_sca,
    phase_polish,
    sca,
    sharpest_phase,
)
from torchsar.metrics import phase_rmse

METHODS = [sca, pga, pga_sca, entropy_fixed_point, sharpest_phase, autofocus, link_phases, phase_polish]


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_values_are_the_same_without_assessment(method, monkeypatch) -> None:
    data, _ = spread_points(3, 20, 10.0, seed=2)
    found = method(data)

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the assessment ran")

    for name in ("assess._seen", "linking.judged", "linking.outcome_of"):
        monkeypatch.setattr(f"torchsar.compensate.pulse_phase.{name}", refuse)
    alone = method(data, assess=False)
    assert torch.equal(alone["phase_rad"], found["phase_rad"])
    assert not alone.std and (alone.outcome == Outcome.NOT_ASSESSED).all() and alone.ok.all()
    assert set(found.std) == {"phase_rad"} and (found.outcome != Outcome.NOT_ASSESSED).all()


@pytest.mark.parametrize("stage", [Sca, Pga, PgaSca, EntropyFixedPoint, LinkPhases, SharpestPhase, Autofocus])
def test_stages_leave_the_assessment_out(stage) -> None:
    from torchsar.study.bench.pulses import signal

    found = stage(assess=False)(signal(spread_points(2, 20, 10.0, seed=2)[0]))
    assert (found.outcome == Outcome.NOT_ASSESSED).all() and found.neutral == {"phase_rad": 0.0}


def vehicle(trials: int, points: int, level_db: float, seed: int) -> tuple[Tensor, Tensor]:
    """Points, and among them a vehicle of four points with a quadratic phase of its own."""
    source = torch.Generator().manual_seed(seed)
    data, phase = spread_points(trials, points, 20.0, seed=seed)
    pulses, cells = data.shape[-2:]
    time = torch.arange(pulses, dtype=torch.float64) - (pulses - 1) / 2
    bend, doppler, place, start = torch.rand(4, trials, 1, generator=source, dtype=torch.float64)
    own = (5 + 35 * bend) * (2 * time / pulses) ** 2 + 2 * math.pi * 0.6 * (doppler - 0.5) * time + start
    away = torch.arange(cells) - (8 + (cells - 20) * place)
    moving = sum(
        torch.exp(1j * (own + 2 * math.pi * k * (0.37 + 0.004 * time)))[..., None] * torch.sinc(away - 1.2 * k)[:, None]
        for k in range(4)
    )
    level = (data.abs().square().mean((1, 2)) / moving.abs().square().mean((1, 2))).sqrt() * 10 ** (level_db / 20)
    return data + level[:, None, None] * moving * torch.exp(1j * phase)[..., None], phase


def test_a_second_motion_among_points_is_seen() -> None:
    """Phases of the vehicle were handed out as ok in half of such trials."""
    data, phase = vehicle(40, 30, 3.0, seed=5)
    found = autofocus(data)
    wrong = phase_rmse(found["phase_rad"], phase) > 0.5
    assert wrong.double().mean() > 0.8 and (found.ok & wrong).double().mean() <= 0.1
    assert (found.outcome[wrong] == Outcome.PARTS_DISAGREE).double().mean() > 0.8


def test_each_cause_has_its_own_reason() -> None:
    source = torch.Generator().manual_seed(3)
    points, _ = spread_points(1, 20, 15.0, seed=2)
    noise = torch.randn(points.shape, generator=source, dtype=torch.complex128)
    wide = torch.fft.ifft(torch.randn(4 * 128, 64, generator=source, dtype=torch.complex128).T * 1.0)
    band = (torch.fft.fftfreq(4 * 128).abs() < 0.3).to(torch.complex128)
    clutter = torch.fft.ifft(torch.fft.fft(wide) * band)[:, :128].T[None]
    found = autofocus(torch.cat([points, noise, 0 * noise, clutter]))
    assert found.outcome.tolist() == [Outcome.OK, Outcome.NOISE, Outcome.EMPTY, Outcome.HOMOGENEOUS]
    assert found.failed.tolist() == [False, True, True, False] and found.doubtful.tolist() == [False] * 3 + [True]


def test_a_kind_of_scene_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="scene must be one of 'sparse', 'points', 'clutter', 'auto', got 'dense'"):
        autofocus(spread_points(1, 3, 10.0, seed=1)[0], scene="dense")  # pyright: ignore[reportArgumentType]
