"""Phases of pulses of which some are missing."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from torchsar.compensate import autofocus
from torchsar.compensate.pulse_phase.gaps import have_gaps, side_lobes
from torchsar.metrics import phase_rmse

PULSES, CELLS = 128, 64
TIME = torch.arange(PULSES)
PRESENT = {
    "a quarter at once": (TIME < 42) | (TIME >= 74),
    "a quarter in eight gaps": TIME % 16 >= 4,
    "three gaps": (TIME % 30 >= 8) | (TIME < 30) | (TIME >= 120),
}


def scene(trials: int, points: int, snr_db: float, seed: int) -> tuple[Tensor, Tensor]:
    """Pulses (trial, pulse, range) of points in half of the Doppler band, and their phases."""
    source = torch.Generator().manual_seed(seed)
    place, turn, start, size = torch.rand(4, trials, points, generator=source, dtype=torch.float64)
    slow = torch.exp(2j * math.pi * (0.5 * (turn[..., None] - 0.5) * TIME + start[..., None]))
    slow = slow * (-size.clamp_min(1e-3).log()).sqrt()[..., None]
    away = torch.arange(CELLS, dtype=torch.float64) - 4 - (CELLS - 8) * place[..., None]
    response = 0.54 * torch.sinc(away) + 0.23 * (torch.sinc(away - 1) + torch.sinc(away + 1))
    data = torch.einsum("tkp,tkr->tpr", slow, response.to(slow.dtype))
    level = 10 ** (-snr_db / 20) * data.abs().square().mean((1, 2), keepdim=True).sqrt()
    data = data + level * torch.randn(data.shape, generator=source, dtype=torch.complex128)
    phase = 2 * math.pi * torch.rand(trials, PULSES, generator=source, dtype=torch.float64)
    return data * torch.exp(1j * phase)[..., None], phase


@pytest.fixture(scope="module")
def pulses() -> tuple[Tensor, Tensor, float]:
    """Whole records, their phases and the median error of the phases found."""
    data, phase = scene(8, 40, 15.0, seed=1)
    return data, phase, float(phase_rmse(autofocus(data)["phase_rad"], phase).median())


@pytest.mark.parametrize("missing", PRESENT)
def test_missing_pulses_do_not_make_phases_wrong(missing: str, pulses: tuple[Tensor, Tensor, float]) -> None:
    """Sharpness put the parts of the record beside each other: ok in nearly all trials, wrong by
    0.4 to 0.5 rad in four of five with a quarter missing.
    """
    data, phase, whole = pulses
    present = PRESENT[missing].expand(len(data), -1)
    found = autofocus(torch.where(present[..., None], data, 0))
    error, std = phase_rmse(found["phase_rad"], phase, present), found.std["phase_rad"][:, 0]
    assert error.median() < 1.3 * whole
    assert found.ok.double().mean() >= 0.5
    assert not (found.ok & ((error > 5 * std) | (error > 0.5))).any()


def test_trials_without_gaps_are_as_without_the_others() -> None:
    data, _ = scene(3, 20, 10.0, seed=2)
    data[1] = torch.where(PRESENT["three gaps"][:, None], data[1], 0)
    together = autofocus(data)
    for trial in range(3):
        alone = autofocus(data[trial])
        torch.testing.assert_close(together["phase_rad"][trial], alone["phase_rad"], rtol=0, atol=1e-7)
        torch.testing.assert_close(together.std["phase_rad"][trial], alone.std["phase_rad"], rtol=1e-6, atol=1e-9)


def test_side_lobes_of_missing_pulses() -> None:
    """Against the sum over pulses; repeated images do not count."""
    present = torch.stack([*PRESENT.values(), TIME % 2 == 0, TIME >= 0])
    turns = torch.arange(1, PULSES // 2 + 1, dtype=torch.float64)[:, None] * TIME / PULSES
    direct = (torch.exp(-2j * math.pi * turns) @ present.mT.to(torch.complex128)).abs().amax(0) / present.sum(-1)
    torch.testing.assert_close(side_lobes(present)[:3], direct[:3])
    assert torch.equal(have_gaps(present), torch.tensor([True, True, True, False, False])) and direct[3] > 0.99
