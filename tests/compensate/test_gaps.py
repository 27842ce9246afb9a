"""Phases of pulses of which some are missing."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.compensate.scenes import spread_points
from torchsar.compensate import autofocus
from torchsar.compensate.pulse_phase.gaps import have_gaps, side_lobes
from torchsar.metrics import phase_rmse

PULSES = 128
TIME = torch.arange(PULSES)
PRESENT = {
    "a quarter at once": (TIME < 42) | (TIME >= 74),
    "a quarter in eight gaps": TIME % 16 >= 4,
    "three gaps": (TIME % 30 >= 8) | (TIME < 30) | (TIME >= 120),
}


@pytest.fixture(scope="module")
def pulses() -> tuple[Tensor, Tensor, float]:
    """Whole records, their phases and the median error of the phases found."""
    data, phase = spread_points(8, 40, 15.0, seed=1)
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
    data, _ = spread_points(3, 20, 10.0, seed=2)
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
