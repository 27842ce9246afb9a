"""Velocities off by whole PRFs are detected, whatever along-track speed an estimator assumed."""

from __future__ import annotations

import warnings

import pytest
import torch

from torchsar.core import Draws
from torchsar.echo import simulate_bistatic
from torchsar.multichannel import Dwell, Interferometry, SignalIntensityRatio
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, MovingPoints

RADAR = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0, wave_speed_m_s=3e8)


@pytest.mark.parametrize(
    ("u_r", "u_a", "off"),
    [(10.0, 5.0, 0.0), (0.0, 10.0, 0.0), (10.0, 15.0, 0.0), (30.0, 0.0, 1.0), (30.0, 10.0, 1.0), (-30.0, 5.0, -1.0)],
)
def test_the_ambiguity_number_is_right_with_a_wrong_along_track_speed(u_r: float, u_a: float, off: float) -> None:
    world = BistaticWorld(MovingPoints([u_r], [u_a], [0.0], [0.0]), BandLimited(4.5), snr_db=20.0)
    signal = simulate_bistatic(RADAR, world, 900, None, Draws(3))[0].signal
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = SignalIntensityRatio(RADAR, 337.5)(signal)
    assert float(found.info["pulse_rates"]) == off and bool(found.ok) <= (off == 0)
    assert any("whole pulse rates" in str(warning.message) for warning in said) <= (off != 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert float(Interferometry(RADAR, Dwell(4.5))(signal, u_a_m_s=u_a).info["pulse_rates"]) == off


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("dwell_s", "snr_db", "known"), [(2.0, 15.0, True), (1.0, 5.0, False)])
def test_a_short_dwell_is_ok_only_where_it_excludes_other_pulse_rates(dwell_s, snr_db, known) -> None:
    """Speeds beyond lambda PRF / 2 were wrong and ok in every trial."""
    u_r = torch.tensor([-34.0, 32.0, 43.0, -10.0, 0.0, 12.0])[:, None]
    still, y0 = torch.zeros_like(u_r), torch.linspace(-50, 50, 6)[:, None]
    world = BistaticWorld(MovingPoints(u_r, still, y0, still), BandLimited(dwell_s), snr_db=snr_db)
    signal = simulate_bistatic(RADAR, world, 600, None, Draws(4, trials=range(6)), dtype=torch.complex128)[0].signal
    right = torch.tensor([False, False, False, known, known, known])
    assert torch.equal(Interferometry(RADAR, Dwell(dwell_s))(signal).ok, right)
    ratio = SignalIntensityRatio(RADAR, 75.0 * dwell_s, step_m_s=1.0)(signal)
    assert bool((ratio.ok <= right).all()) and bool(ratio.ok.any()) == known
    near = Interferometry(RADAR, Dwell(dwell_s), check_ambiguity=False)(signal)
    assert bool(near.ok.all()) and "pulse_rates" not in near.info


def test_targets_outside_the_record_are_reported() -> None:
    far = MovingPoints([0.0, 0.0], [0.0, 0.0], [0.0, 9000.0], [0.0, 0.0])
    with pytest.warns(UserWarning, match="1 of 2 targets are received in no pulse"):
        simulate_bistatic(RADAR, BistaticWorld(far, BandLimited(4.5)), 90, None, Draws(1))
    with pytest.raises(ValueError, match=r"target 1 \(counted from 0\) with 9000 m"):
        simulate_bistatic(
            RADAR,
            BistaticWorld(MovingPoints([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 9000.0]), BandLimited(4.5)),
            90,
            32,
            Draws(1),
        )
    with pytest.raises(ValueError, match="one entry per target"):
        MovingPoints(10.0, 0.0, 0.0, 0.0)  # type: ignore[arg-type]


def test_zero_data_are_not_ambiguous() -> None:
    world = BistaticWorld(MovingPoints([5.0], [0.0], [0.0], [0.0]), BandLimited(4.5))
    signal = simulate_bistatic(RADAR, world, 120, None, Draws(1))[0].signal
    assert (
        float(Interferometry(RADAR, Dwell(4.5))(signal.with_data(torch.zeros_like(signal.data))).info["pulse_rates"])
        == 0
    )
