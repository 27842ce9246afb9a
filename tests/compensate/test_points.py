"""Phases of few points: at the bound of noise, not of scatterers that change, differentiable."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.compensate.scenes import spread_points
from torchsar import Draws
from torchsar.compensate import autofocus
from torchsar.compensate.pulse_phase.points import phases_of_points
from torchsar.data import Simulated
from torchsar.metrics import phase_rmse

PULSES, CELLS = 128, 64


def of_rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())


@pytest.mark.parametrize(("points", "snr_db"), [(2, 25.0), (3, 40.0), (3, 10.0), (5, 25.0)])
def test_few_points_reach_the_bound(points: int, snr_db: float) -> None:
    """Sharpness alone leaves two to three bounds at 25 dB."""
    data, phase = spread_points(24, points, snr_db, seed=points)
    error = phase_rmse(autofocus(data, scene="points", assess=False)["phase_rad"], phase)
    # of a pulse's phase, if all else were known
    bound = 10 ** (-snr_db / 20) / math.sqrt(2 * CELLS)
    explained = error < 1.5 * bound
    assert explained.double().mean() >= 0.8
    assert 0.9 < of_rms(error[explained]) / bound < 1.1


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "per_row"), [(2, 2), (2, 4), (4, 4)])
def test_rows_of_points_of_a_target_that_turns(rows: int, per_row: int) -> None:
    """The rotation bends the phases of the ranges by 0.07 rad against each other.

    Without the bend, points did not explain a tenth of this noise, with three times the error for
    two rows.
    """
    field = f"{{kind: spread_rows, rows: {rows}, per_row: {per_row}, width: 0.5, extent_m: 0.31, range_step_m: 1e-3}}"
    scene = f"world.scene={{field: {field}}}"
    simulated = Simulated("isal_scene", Draws(4, trials=range(16)), batch=16, overrides=[scene])
    recording, truth = next(iter(simulated))
    found = autofocus(recording.signal.data, scene="points", assess=False)
    error = phase_rmse(found["phase_rad"], truth.values["phase_rad"])
    # 10 dB in 256 range cells; points of the same range cancel each other in some pulses
    assert error.median() < 1.7 * 10**-0.5 / math.sqrt(2 * 256)


@pytest.mark.parametrize("points", [8, 12])
def test_more_points_are_explained_too(points: int) -> None:
    data, phase = spread_points(12, points, 25.0, seed=points)
    error = phase_rmse(autofocus(data, scene="points", assess=False)["phase_rad"], phase)
    assert of_rms(error) < 1.2 * 10**-1.25 / math.sqrt(2 * CELLS)


def test_the_phases_have_derivatives() -> None:
    data, phase = spread_points(2, 3, 20.0, seed=5)
    present = torch.ones(2, PULSES, dtype=torch.bool)
    towards = torch.randn(data.shape, generator=torch.Generator().manual_seed(6), dtype=torch.complex128)

    def phases(step: Tensor) -> Tensor:
        found, explained = phases_of_points((data + step * towards).mT, present, phase)
        assert explained.all()
        return (torch.linspace(-1, 1, PULSES).square() * found).sum()

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(phases(step), step)
    with torch.no_grad():
        by_differences = (phases(step + 1e-6) - phases(step - 1e-6)) / 2e-6
    torch.testing.assert_close(slope, by_differences, rtol=2e-3, atol=0)


def test_a_trial_does_not_depend_on_the_others() -> None:
    data = torch.cat([spread_points(1, *case, seed=1)[0] for case in ((2, 25.0), (6, 10.0), (3, 0.0))])
    together = autofocus(data, scene="auto")["phase_rad"]
    for trial, of_trial in enumerate(data):
        alone = autofocus(of_trial, scene="auto")["phase_rad"]
        torch.testing.assert_close(together[trial], alone, rtol=0, atol=1e-9)
