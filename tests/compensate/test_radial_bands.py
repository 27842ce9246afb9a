"""Filtering to a range window, the removed shift, and the periods that contain an echo."""

from __future__ import annotations

import math

import pytest
import torch

from tests.compensate.radials import ESTIMATORS, GATE, seen
from tests.echo.ladars import COMMON
from torchsar.compensate.radial.bands import Spectra, filled, window_lines
from torchsar.radar import LIGHT_M_S
from torchsar.scene import LinearInSweep, Points, Polynomial
from torchsar.study.bench.direct.triangles import table1

RADAR = table1()


def test_window_lines() -> None:
    assert window_lines(RADAR, None) == (-256, 512)
    first, lines = window_lines(RADAR, GATE)
    assert first == 30 and lines == 41
    assert window_lines(RADAR, (-256 * RADAR.range_step_m, 255 * RADAR.range_step_m)) == (-256, 512)
    for window in ((-257 * RADAR.range_step_m, 0.0), (0.0, 256 * RADAR.range_step_m)):
        with pytest.raises(ValueError, match="reaches beyond the beat band"):
            window_lines(RADAR, window)
    for window in ((float("nan"), 1.0), (1.0, 1.0)):
        with pytest.raises(ValueError, match="low < high"):
            window_lines(RADAR, window)


def test_bands_are_the_tone_without_its_shift() -> None:
    """A scatterer with a velocity of whole bins is the tone of its range in both sweeps.

    Its level differs by a power of two.
    """
    step = RADAR.ambiguous_velocity_m_s
    sweeps, _, _ = seen(
        table1(speed_m_s=0.0),
        motion=(Polynomial([-7 * step]),),
        n=9,
        scene=Points([0.0], [50 * RADAR.range_step_m], [0.7]),
    )
    bands = Spectra.of(sweeps, table1(speed_m_s=0.0)).bands(GATE, taper=0.0, oversampling=2, video=True)
    assert bool((bands.shift == -7).all()) and bool(bands.lit.all()) and bands.up.shape == (9, 128)
    assert bands.noise_lines == 41
    middle = bands.time_s.abs() < 0.4 * RADAR.sweep_s
    for sweep, x in ((0, bands.up), (1, bands.down)):
        turns = torch.angle(x[..., 1:] * x[..., :-1].conj())[..., middle[1:]].mean() / (2 * torch.pi) * 128
        assert float(turns) == pytest.approx(50, abs=0.05), sweep
        level = math.log2(float(x.abs()[..., middle].mean()) / 0.7)
        assert level == pytest.approx(round(level), abs=0.04)


def test_filled() -> None:
    values = torch.tensor([[9.0, 1.0, 9.0, 9.0, 4.0, 9.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]], dtype=torch.float64)
    known = torch.tensor([[False, True, False, False, True, False], [False] * 6])
    torch.testing.assert_close(
        filled(values, known),
        torch.tensor([[1.0, 1.0, 2.0, 3.0, 4.0, 4.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]], dtype=torch.float64),
    )


@pytest.mark.parametrize("snr_db", [None, 20.0])
@pytest.mark.parametrize("name", list(ESTIMATORS))
def test_periods_without_an_illuminated_scatterer_are_marked(name, snr_db) -> None:
    """A beam of 12 urad illuminates the point for 37 periods, in which the velocity is found.

    In the other periods it is interpolated and finite.
    """
    radar = table1(beam_rad=12e-6)
    sweeps, pulse, truth = seen(radar, n=96, snr_db=snr_db, fidelity=LinearInSweep())
    found = ESTIMATORS[name](sweeps, radar, pulse, window_m=GATE)
    lit = found.info["lit"]
    shines = (sweeps.abs().mean(-1) > 0.5).all(-2) if snr_db is None else lit
    assert torch.equal(lit, shines) and 35 <= int(lit.sum()) <= 38
    assert float((found["velocity_m_s"] - truth.values["velocity_m_s"])[lit].abs().max()) < (
        6e-3 if snr_db is None and name == "correlation" else 8e-3 if snr_db else 2e-4
    )
    assert bool(torch.isfinite(found["velocity_m_s"]).all()) and bool(found.ok)


@pytest.mark.parametrize("periods", [1, 2, 3, 8, 9])
@pytest.mark.parametrize("name", list(ESTIMATORS))
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_few_periods(name, periods) -> None:
    sweeps, pulse, truth = seen(n=periods, motion=COMMON)
    found = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)
    assert found["velocity_m_s"].shape == (periods,)
    assert float((found["velocity_m_s"] - truth.values["velocity_m_s"]).abs().max()) < (
        2e-3 if name == "correlation" else 1e-4
    )


def test_a_scatterer_that_enters_the_beam_between_two_sweeps_does_not_change_the_velocity() -> None:
    """Only the down sweep of that period contains it; its lag to another scatterer is no motion."""
    radar = table1(
        carrier_hz=LIGHT_M_S / 1.064e-6, bandwidth_hz=3.2e9, period_s=25e-6, sample_rate_hz=16e6, beam_rad=114e-6
    )
    scene = Points([-0.06, 0.0, 0.06], [1.0, 1.5, 2.0], [0.7, 1.0, 0.7])
    sweeps, pulse, truth = seen(radar, n=512, scene=scene, snr_db=20.0, dtype=torch.complex64, fidelity=LinearInSweep())
    found = ESTIMATORS["mirror"](sweeps, radar, pulse, window_m=(-1.0, 4.0))
    away = (found["velocity_m_s"] - truth.values["velocity_m_s"])[found.info["lit"]]
    assert float(away.abs().max()) < 3e-3
