"""Profiles that are displaced in range: autofocus must not claim the phases that it finds there."""

from __future__ import annotations

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchsar.compensate import autofocus, entropy_fixed_point, link_phases
from torchsar.compensate.pulse_phase.alignment import coherent_jitter
from torchsar.compensate.pulse_phase.alignment import displacement as displacement_of
from torchsar.metrics.phase import phase_rmse

PULSES, CELLS = 192, 96
TIME = torch.linspace(-0.5, 0.5, PULSES, dtype=torch.float64)
COURSES = {
    "aligned": 0 * TIME,
    "jitter": 0.6 * torch.randn(PULSES, generator=torch.Generator().manual_seed(3), dtype=torch.float64),
    "vibration": 2 * torch.sin(2 * math.pi * 23.3 * TIME),
    "drift": 10 * TIME,
    "parabola": 12 * TIME**2,
}


class Displacement(NamedTuple):
    jitter: Tensor
    migration: Tensor


def displacement(rows: Tensor, present: Tensor) -> Displacement:
    """Displacement of pulses (trial, range, pulse)."""
    return Displacement(*displacement_of(torch.fft.fft(rows, dim=-2), present))


def displaced(course: Tensor, points: int, snr_db: float, trials: int, seed: int) -> tuple[Tensor, Tensor]:
    """Pulses (trial, pulse, range) of point scatterers displaced by (pulse,) cells, and phases."""
    draws = torch.Generator().manual_seed(seed)
    at, turn = torch.rand(2, trials, points, generator=draws, dtype=torch.float64)
    amplitude = torch.randn(trials, points, generator=draws, dtype=torch.complex128)
    phase = 2 * math.pi * torch.rand(trials, PULSES, generator=draws, dtype=torch.float64)
    frequency = torch.fft.fftfreq(CELLS, dtype=torch.float64)
    in_range = torch.exp(-2j * math.pi * CELLS * at[..., None] * frequency)
    in_time = torch.exp(2j * math.pi * 0.8 * PULSES * (turn[..., None] - 0.5) * TIME)
    spectrum = torch.einsum("tp,tpf,tpn->tnf", amplitude, in_range, in_time)
    clean = torch.fft.ifft(spectrum * torch.exp(-2j * math.pi * course[:, None] * frequency + 1j * phase[..., None]))
    level = clean.abs().square().mean((1, 2), keepdim=True).sqrt() * 10 ** (-snr_db / 20)
    return clean + level * torch.randn(clean.shape, generator=draws, dtype=torch.complex128), phase


@pytest.mark.parametrize("course", list(COURSES))
@pytest.mark.parametrize("points, snr_db", [(6, 15.0), (60, 5.0)])
def test_what_is_displaced_is_not_believed(course: str, points: int, snr_db: float) -> None:
    data, phase = displaced(COURSES[course], points, snr_db, trials=2, seed=points)
    found = autofocus(data)
    wrong = phase_rmse(found["phase_rad"], phase) > 0.1
    if course == "aligned":
        assert found.ok.all() and not wrong.any()
    else:
        assert not found.ok.any()


@pytest.mark.parametrize("apart", [1, 2, 3])
def test_scatterers_in_one_range_cell_are_no_displacement(apart: int) -> None:
    """Their interference changes the power of the cell in both halves of the band alike, and the
    mean profile of equal cells has hardly a slope: it looked like a displacement of a cell.
    """
    draws = torch.Generator().manual_seed(apart)
    turn = torch.rand(4, CELLS // apart, 4, generator=draws, dtype=torch.float64)
    level = torch.randn(turn.shape, generator=draws, dtype=torch.complex128)
    tones = torch.exp(2j * math.pi * PULSES * (turn[..., None] - 0.5) * TIME)
    data = torch.zeros(4, PULSES, CELLS, dtype=torch.complex128)
    data[..., : CELLS // apart * apart : apart] = (level[..., None] * tones).sum(-2).mT
    phase = 2 * math.pi * torch.rand(4, PULSES, generator=draws, dtype=torch.float64)
    data = data * torch.exp(1j * phase)[..., None]
    data = data + 0.3 * torch.randn(data.shape, generator=draws, dtype=torch.complex128)
    found = autofocus(data)
    assert found.ok.all() and float(phase_rmse(found["phase_rad"], phase).max()) < 0.1
    assert not displacement(data.mT, torch.ones(4, PULSES, dtype=torch.bool)).jitter.any()


def test_displaced_scatterers_are_not_believed() -> None:
    """Phases are wrong by .35 rad although halves of the range cells agree to .1 rad."""
    data, phase = displaced(COURSES["jitter"], 6, 15.0, trials=1, seed=8)
    found = autofocus(data)
    assert float(phase_rmse(found["phase_rad"], phase)) > 0.3
    assert not found.ok.any()
    assert not entropy_fixed_point(data).ok.any()


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_displaced_clutter_is_not_believed(share: float) -> None:
    """Its profiles have no features: the displacement shows between adjacent pulses only."""
    draws = torch.Generator().manual_seed(4)
    trials, pulses, period = 4, 96, 200
    lines = torch.randn(trials, CELLS, int(share * period), generator=draws, dtype=torch.complex128)
    scene = torch.fft.ifft(lines, n=period, norm="forward")[..., :pulses].mT / math.sqrt(share * period)
    frequency = torch.fft.fftfreq(CELLS, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(trials, pulses, generator=draws, dtype=torch.float64)
    for jitter in (0.0, 0.6):
        course = jitter * torch.randn(pulses, 1, generator=draws, dtype=torch.float64)
        moved = torch.fft.ifft(torch.fft.fft(scene) * torch.exp(-2j * math.pi * course * frequency))
        noise = 0.3 * torch.randn(scene.shape, generator=draws, dtype=torch.complex128)
        found = link_phases((moved + noise) * torch.exp(1j * phase)[..., None])
        error = phase_rmse(found["phase_rad"], phase)
        if jitter:
            assert (error > 0.5).all() and not found.ok.any()
            truth = float(course.diff(dim=0).square().mean().sqrt()) / math.sqrt(2)
            assert float(found.info["jitter_cells"].median()) == pytest.approx(truth, rel=0.35)
        else:
            assert (error < 0.2).all() and found.ok.all() and not found.info["jitter_cells"].any()


def test_small_displacements_are_measured() -> None:
    """Up to 40 % too large: the profile of half the band has weaker slopes than its mean power."""
    present = torch.ones(20, PULSES, dtype=torch.bool)
    for name, scale in (("jitter", 0.4 / 0.6), ("vibration", 0.2)):
        data, _ = displaced(scale * COURSES[name], 30, 20.0, trials=20, seed=2)
        truth = float((scale * COURSES[name]).std())
        assert 0.8 * truth < float(displacement(data.mT, present).jitter.median()) < 1.4 * truth
    data, _ = displaced(2 * TIME, 30, 20.0, trials=20, seed=2)
    found, truth = displacement(data.mT, present), 2 / math.sqrt(12)
    assert 0.6 * truth < float(found.migration.median()) < 1.4 * truth
    assert float(found.jitter.median()) < 0.1


def test_a_displacement_depends_on_nothing_else() -> None:
    """Not on level, batch, precision, phases, the offset of the band, or pulses that are lost."""
    data, _ = displaced(COURSES["jitter"], 20, 15.0, trials=4, seed=5)
    rows, present = data.mT, torch.ones(4, PULSES, dtype=torch.bool)
    first = displacement(rows, present)
    draws = torch.Generator().manual_seed(6)
    phase = 2 * math.pi * torch.rand(4, 1, PULSES, generator=draws, dtype=torch.float64)
    carried = rows * torch.exp(1j * (phase + 2 * math.pi * 0.3 * torch.arange(CELLS)[:, None]))
    for other in (displacement(1e5 * rows, present), displacement(rows.to(torch.complex64), present)):
        torch.testing.assert_close(other.jitter, first.jitter, rtol=1e-4, atol=0)
    torch.testing.assert_close(displacement(carried, present).jitter, first.jitter, rtol=0.2, atol=0)
    torch.testing.assert_close(displacement(rows[2:3], present[2:3]).jitter, first.jitter[2:3])
    present[:, ::7] = False
    torch.testing.assert_close(displacement(rows * present[:, None], present).jitter, first.jitter, rtol=0.25, atol=0)


def test_too_few_cells_or_pulses_and_zeros_are_aligned() -> None:
    noise = torch.randn(2, 64, 64, generator=torch.Generator().manual_seed(7), dtype=torch.complex64)
    for rows in (noise[:, :4], noise[..., :5], 0 * noise, noise):
        found = displacement(rows, (rows != 0).any(1))
        assert (
            (found.jitter < 0.25).all()
            and (found.migration < 0.4).all()
            and torch.isfinite(found.jitter + found.migration).all()
        )
        assert not coherent_jitter(rows, (rows != 0).any(1)).any()
