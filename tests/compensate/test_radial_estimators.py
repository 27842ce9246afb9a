"""Common properties of all estimators of the radial velocity, without noise."""

from __future__ import annotations

import pytest
import torch

from tests.compensate.radials import ESTIMATORS, GATE, ONE, rms, seen, velocity_rms
from tests.echo.ladars import COMMON
from torchsar.compensate.radial.beats import from_beats
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.scene import Points, Polynomial
from torchsar.study.bench.direct.triangles import table1

RADAR = table1()
# rms error without noise in m/s: only grids and summed bins leave a noticeable one
FLOOR = {
    "segmented": 5e-7,
    "segmented_sum": 1e-4,
    "correlation": 2e-3,
    "peak": 6e-7,
    "mirror": 3e-6,
    "mirror_free": 6e-6,
    "mirror_record": 6e-6,
    "recommended": 3e-6,
}
IDS = list(ESTIMATORS)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("window", [GATE, (-1.0, 4.0), None])
def test_without_noise(name, window) -> None:
    sweeps, pulse, truth = seen()
    found = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=window)
    assert float(velocity_rms(found, truth)) < FLOOR[name]
    assert bool(found.ok) and float(found.quality) > 0.9 and bool(found.info["lit"].all())


@pytest.mark.parametrize("name", IDS)
def test_a_static_target_has_the_geometric_velocity(name) -> None:
    """The echo of a static target has the velocity V (V t - x) / R, which azimuth_m removes."""
    radar = table1(speed_m_s=600.0)
    sweeps, pulse, _ = seen(radar, motion=(), scene=Points([0.02], [1.5], [1.0]))
    found = ESTIMATORS[name](sweeps, radar, pulse, window_m=GATE, azimuth_m=0.02)
    assert float(rms(found["velocity_m_s"])) < FLOOR[name]
    if name == "correlation":
        return
    geometric = geometric_velocity_m_s(radar, pulse, 0.02, 1.5)
    kept = ESTIMATORS[name](sweeps, table1(speed_m_s=0.0), pulse, window_m=GATE)
    assert float(geometric.abs().max()) > 0.02
    torch.testing.assert_close(kept["velocity_m_s"], geometric, atol=2 * FLOOR[name], rtol=0)


@pytest.mark.parametrize("name", IDS)
def test_both_dechirp_signs_give_the_same_velocity(name) -> None:
    first, pulse, _ = seen()
    second, _, _ = seen(table1(dechirp_sign="echo_conj_lo"))
    assert torch.equal(second, first.conj())
    one, two = (
        ESTIMATORS[name](first, RADAR, pulse, window_m=GATE),
        ESTIMATORS[name](second, table1(dechirp_sign="echo_conj_lo"), pulse, window_m=GATE),
    )
    for value in one.value:
        torch.testing.assert_close(one[value], two[value], atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", IDS)
@pytest.mark.parametrize("speed", [0.01, 0.0484, 0.05, 3.0, 12.5, 19.5])
def test_velocities_to_the_band_limit_and_their_sign(name, speed) -> None:
    """RD 1.5 m has a beat of 6.25 MHz; 20 m/s add 25.8 MHz to it, and the band ends at 32 MHz.

    Beyond lambda fs / 8 = 12.4 m/s the tone of a mirror product would alias without the shift.
    """
    for sign in (1, -1):
        sweeps, pulse, truth = seen(motion=(Polynomial([sign * speed]),), n=16)
        assert float(velocity_rms(ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE), truth)) < 2 * FLOOR[name]


@pytest.mark.parametrize("name", ["segmented", "peak"])
def test_the_factor_of_the_bandwidth_removes_a_bias(name) -> None:
    """Without the factor 1 + B / (2 fc) the relative error is 1.29e-5.

    That is below 1e-5 m/s here; with the factor the error is below 2e-6 m/s.
    """
    sweeps, pulse, truth = seen()
    factor = 1 + RADAR.bandwidth_hz / (2 * RADAR.carrier_hz)
    assert factor - 1 == pytest.approx(1.29e-5, rel=0.01)
    found, true = ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)["velocity_m_s"], truth.values["velocity_m_s"]
    assert 2e-6 < float((found / factor - true).abs().max()) < 1e-5 and float((found - true).abs().max()) < 2e-6
    bands = type("Bands", (), {"radar": RADAR, "shift": torch.zeros(1, dtype=torch.int64)})
    one_bin = from_beats(
        torch.ones(1, dtype=torch.float64) / RADAR.sweep_s, -torch.ones(1, dtype=torch.float64) / RADAR.sweep_s, bands
    )
    assert float(one_bin) == pytest.approx(RADAR.wavelength_m / (2 * RADAR.sweep_s) * factor, rel=1e-12)


@pytest.mark.parametrize("name", IDS)
def test_a_batch_equals_single_trials_beside_strong_neighbours(name) -> None:
    """In blocks of trials, and beside trials of other levels, other velocities and noise."""
    sweeps, pulse, _ = seen(trials=3, snr_db=10.0, n=24, dtype=torch.complex64)
    g = torch.Generator().manual_seed(0)
    others = torch.stack(
        [
            1e25 * torch.randn(sweeps[0].shape, dtype=sweeps.dtype, generator=g),
            0 * sweeps[0],
            1e-28 * sweeps[1],
            1e6 * sweeps[2].roll(7, -1).conj(),
        ]
    )
    batch = torch.cat([sweeps, others]).reshape(1, 7, *sweeps.shape[1:]).expand(6, -1, -1, -1, -1)
    x = 0.01 * torch.arange(42, dtype=torch.float64).reshape(6, 7)
    together = ESTIMATORS[name](batch, RADAR, pulse, window_m=GATE, azimuth_m=x)
    for i in range(3):
        alone = ESTIMATORS[name](sweeps[i], RADAR, pulse, window_m=GATE, azimuth_m=float(x[4, i]))
        for key, value in {**alone.value, **alone.std, "ok": alone.ok, **alone.info}.items():
            whole = {**together.value, **together.std, "ok": together.ok, **together.info}[key]
            torch.testing.assert_close(
                whole[4, i], value, atol=1e-4 if key in ("phase_rad", "weights", "std", "snr_db") else 1e-6, rtol=1e-5
            )
    assert all(
        bool(torch.isfinite(v.double()).all())
        for v in (*together.value.values(), *together.info.values(), *together.std.values())
    )
    assert not bool(together.ok[:, 3:5].any())


@pytest.mark.parametrize("name", IDS)
def test_single_precision_is_enough(name) -> None:
    sweeps, pulse, truth = seen(n=16)
    found = ESTIMATORS[name](sweeps.to(torch.complex64), RADAR, pulse, window_m=GATE)
    assert found["velocity_m_s"].dtype == torch.float64
    assert float(velocity_rms(found, truth)) < 2 * FLOOR[name]


@pytest.mark.parametrize("name", IDS)
def test_invalid_input_is_rejected(name) -> None:
    sweeps, pulse, _ = seen(n=2)
    estimator = ESTIMATORS[name]
    with pytest.raises(TypeError, match="complex sweeps"):
        estimator(sweeps.real, RADAR, pulse)
    with pytest.raises(ValueError, match="the up sweep before the down sweep, got shape"):
        estimator(sweeps[..., :-1], RADAR, pulse)
    with pytest.raises(ValueError, match="the up sweep before the down sweep, got shape"):
        estimator(sweeps[0], RADAR, pulse)
    for window, said in (
        ((2.0, 1.0), "low < high"),
        ((0.0, 9.0), "beyond the beat band"),
        ((1.5, 1.55), "4 cells or wider"),
    ):
        with pytest.raises(ValueError, match=said):
            estimator(sweeps, RADAR, pulse, window_m=window)


def test_a_velocity_that_rises_steeply_is_followed_to_the_ends() -> None:
    """The shift of blocks of 8 periods is extrapolated linearly to the ends of the record.

    The last block is short.
    """
    sweeps, pulse, truth = seen(motion=(Polynomial([-1.5, 1500.0]),), n=69, scene=ONE)
    for name in ("segmented_sum", "mirror", "peak"):
        assert (
            float(
                (ESTIMATORS[name](sweeps, RADAR, pulse, window_m=GATE)["velocity_m_s"] - truth.values["velocity_m_s"])
                .abs()
                .max()
            )
            < 5e-4
        ), name


def test_the_common_motion_is_not_trivial() -> None:
    _, _, truth = seen(n=512, motion=COMMON, fidelity=None)
    v = truth.values["velocity_m_s"]
    assert 0.25 < float(v.min()) < 0.35 and 0.55 < float(v.max()) < 0.65
