"""Focused points against the theory of a rectangular band and the tables of the paper.

Echoes are direct sums; the figures marked "prototype" are those of an independent float64
prototype.
"""

from __future__ import annotations

import math

import pytest
import torch

from tests.multichannel.profiles import BAND_HZ, GATE_S, LONG, figures_of, focused, measured, motion_of
from torchsar.core import Signal
from torchsar.multichannel import (
    CorrectMigration,
    FocusAzimuth,
    Keystone,
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    Reconstruct,
    doppler_offsets,
    focus_azimuth,
    reconstruct,
)
from torchsar.multichannel.azimuth import azimuth_filter
from torchsar.study.bench.direct.moving import azimuth_echo, compressed_echo, published_radar, range_of, time_of

F64 = torch.float64
RADAR = published_radar()
TABLE_4 = [(0.0, 10.0), (10.0, 0.0), (10.0, 5.0), (5.0, 10.0)]
OTHERS = [(0.0, 0.0), (20.0, 0.0), (-20.0, 0.0), (0.0, 12.0), (20.0, 20.0), (-20.0, 15.0), (-7.0, 3.0)]


def theory_m(u_a):
    """Return 0.886 lambda R0 / (v T), with the band limited to the processed one."""
    v = 300 - u_a
    return 0.886 * v / min(v**2 * GATE_S / (0.24 * 5000), BAND_HZ)


@pytest.mark.parametrize(("u_r", "u_a"), TABLE_4 + OTHERS)
def test_table_4_with_known_velocities(u_r, u_a):
    found = measured(RADAR, LeastSquares(2), u_r, u_a)
    assert found.irw_m == pytest.approx(theory_m(u_a), rel=0.02)
    assert found.pslr_db == pytest.approx(-13.26, abs=0.15)
    assert found.islr_db == pytest.approx(-9.8, abs=0.3)
    assert found.mfta_db <= -65
    assert found.image_s == pytest.approx(u_r * 5000 / ((300 - u_a) ** 2 + u_r**2), abs=2e-5)


@pytest.mark.parametrize(
    ("u_r", "u_a", "mfta_db"), [(0.0, 10.0, -58.3), (10.0, 0.0, -56.0), (10.0, 5.0, -51.5), (5.0, 10.0, -49.7)]
)
def test_inverse_of_three_bands(u_r, u_a, mfta_db):
    assert measured(RADAR, LeastSquares(3), u_r, u_a).mfta_db == pytest.approx(mfta_db, abs=2.0)


@pytest.mark.parametrize("y0", [150.0, -400.0])
def test_a_point_off_the_middle(y0):
    found = measured(RADAR, LeastSquares(2), 10.0, 5.0, y0)
    assert (
        found.irw_m == pytest.approx(theory_m(5.0), rel=0.02)
        and found.pslr_db == pytest.approx(-13.26, abs=0.15)
        and found.mfta_db < -65
    )
    motion = motion_of(RADAR, 10.0, 5.0, y0)
    assert found.image_s == pytest.approx(float(motion.image_s), abs=2e-5)
    assert float(motion.position_m(motion.image_s)) == pytest.approx(y0, abs=1e-9)


def test_the_filter_needs_the_along_track_position():
    """At y0 = 150 m and u_r = 10 m/s the least range is 5 m smaller than at y0 = 0."""
    motion = motion_of(RADAR, 10.0, 0.0, 150.0)
    assert float(motion_of(RADAR, 10.0).closest_m - motion.closest_m) == pytest.approx(5.0, abs=0.02)
    assert measured(RADAR, LeastSquares(2), 10.0, 0.0, 150.0, used=(10.0, 0.0, 0.0)).pslr_db == pytest.approx(
        -10.7, abs=0.3
    )


def test_conventional_processing_makes_false_targets():
    """Velocities of zero in response and filter (Table 4, two bands, prototype)."""
    for move, irw, mfta in (((10.0, 0.0), 0.96, -19.4), ((0.0, 10.0), 82.4, -45.6)):
        found = measured(RADAR, LeastSquares(2), *move, used=(0.0, 0.0, 0.0))
        assert found.mfta_db == pytest.approx(mfta, abs=3.0)
        assert irw > 50 or found.irw_m == pytest.approx(irw, rel=0.1)


@pytest.mark.parametrize(
    ("rebuild", "mfta_db"),
    [(LeastSquares(2), -17.8), (LeastSquares(3), -28.0), (MinimumMeanSquare(5, 40.0), -30.7)],
    ids=["two", "three", "prior"],
)
def test_through_the_pattern_of_an_antenna(rebuild, mfta_db):
    """Fig. 17 at u_r = 10 m/s (prototype): energy two PRFs away aliases."""
    t = time_of(RADAR, LONG)
    path = range_of(RADAR, t, 10.0)
    along = 300 * t - torch.tensor(RADAR.channel_m, dtype=F64)[:, None]
    data = torch.sinc(0.8 / 0.24 * along / path) * torch.exp(-2j * math.pi * torch.remainder((path - 5000) / 0.24, 1))
    image = focused(data, RADAR, motion_of(RADAR, 10.0), rebuild)
    assert figures_of(image, RADAR, rebuild.bands, 10.0, gate_s=None).mfta_db == pytest.approx(mfta_db, abs=1.5)


def test_peak_and_phase():
    """A unit point for T seconds has the peak T V / sqrt(lambda R) at -45 degrees.

    The phase is relative to that at zero Doppler offset and at the reference range.
    """
    for u_r, u_a, y0 in ((0.0, 0.0, 0.0), (10.0, 5.0, 30.0), (-10.0, 5.0, -60.0)):
        motion, v = motion_of(RADAR, u_r, u_a, y0), 300 - u_a
        peak = measured(RADAR, LeastSquares(2), u_r, u_a, y0, band_hz=None).peak
        assert abs(peak) == pytest.approx(GATE_S * math.sqrt((v**2 + u_r**2) / (0.24 * 5000)), rel=0.01)
        turns = u_r / 0.24 * float(motion.image_s)  # the demodulation, which remains in the image
        assert (
            abs(math.remainder(math.atan2(peak.imag, peak.real) + math.pi / 4 + 2 * math.pi * turns, 2 * math.pi))
            < 0.05
        )


def test_filter_is_the_exact_phase_of_the_spectrum():
    motion, offset = motion_of(RADAR, 10.0, 5.0, 100.0), doppler_offsets(64, 2, 180.0)
    f = offset + 10.0 / 0.24
    v2, cross = 295.0**2 + 100.0, 10.0 * 5000 + 295.0 * 100
    least = math.sqrt(5000.0**2 + 100.0**2 - cross**2 / v2)
    phase = 2 * math.pi / 0.24 * (least * torch.sqrt(1 - 0.24**2 * f**2 / v2) - 5000)
    torch.testing.assert_close(
        azimuth_filter(offset, RADAR, motion, torch.complex128), torch.exp(1j * phase), atol=1e-8, rtol=0
    )
    slow = published_radar(speed_m_s=15.0)  # no point has a Doppler beyond V / lambda
    gone = azimuth_filter(offset, slow, motion_of(slow), torch.complex128)
    assert torch.equal(gone == 0, 0.24 * offset.abs() >= 15.0)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_trials_equal_singles_and_keep_precision(dtype):
    data = torch.stack([azimuth_echo(RADAR, 900, u_r, u_a) for u_r, u_a in TABLE_4]).to(dtype)
    u_r, u_a = torch.tensor(TABLE_4, dtype=F64).unbind(-1)
    signal = Signal(data, RADAR.axes(900))
    focus, rebuild = FocusAzimuth(RADAR, bandwidth_hz=BAND_HZ), Reconstruct(RADAR)
    together = focus(rebuild(signal, u_r_m_s=u_r, u_a_m_s=u_a), u_r_m_s=u_r, u_a_m_s=u_a)
    assert together.data.dtype == dtype and together.names == ("azimuth",)
    exact = [
        focused(azimuth_echo(RADAR, 900, *move), RADAR, motion_of(RADAR, *move), LeastSquares(2)) for move in TABLE_4
    ]
    for found, expected in zip(together.data, exact, strict=True):
        assert float((found - expected).norm() / expected.norm()) < (1e-6 if dtype == torch.complex64 else 1e-12)
    x = together.axis("azimuth").values()
    assert float(x[int(together.data[1].abs().argmax())]) == pytest.approx(300 * 10 * 5000 / (300**2 + 100), abs=0.5)


def test_every_line_is_focused_for_the_range_of_one_target():
    """The range is that of the strongest line, or the given one."""
    points = [{"u_r": 10.0, "r0": 4900.0}, {"u_r": 10.0, "r0": 5150.0, "amplitude": 0.5}]
    signal = compressed_echo(RADAR, 900, 96, points)
    still = CorrectMigration(RADAR, Keystone())(signal, u_r_m_s=10.0)
    spectrum = Reconstruct(RADAR)(still, u_r_m_s=10.0)
    near = spectrum.axis("range").values()
    for range_m, of in ((None, 0), (5150.0, 1)):
        image = FocusAzimuth(RADAR, bandwidth_hz=BAND_HZ)(spectrum, u_r_m_s=10.0, range_m=range_m)
        position, r0, amplitude = image.axis("azimuth").values(), points[of]["r0"], points[of].get("amplitude", 1.0)
        columns = [image.data[:, int((near - point["r0"]).abs().argmin())].abs() for point in points]
        assert float(columns[of].max()) > 0.9 * amplitude * GATE_S * math.sqrt(300**2 / (0.24 * r0))
        assert float(columns[1 - of].max()) < 0.4 * GATE_S * math.sqrt(300**2 / (0.24 * 5000))
        assert float(position[int(columns[of].argmax())]) == pytest.approx(300 * 10 * r0 / (300**2 + 100), abs=0.5)


def test_gradients():
    offset = doppler_offsets(5, 2, 180.0)
    data = torch.randn(2, 10, dtype=torch.complex128, requires_grad=True)
    values = [torch.tensor(x, dtype=F64, requires_grad=True) for x in ([3.0, -5.0], [1.0, 2.0], [10.0, 30.0])]
    assert torch.autograd.gradcheck(
        lambda d, *x: focus_azimuth(d, offset, RADAR, PointMotion.of(RADAR, d, *x), 100.0), (data, *values)
    )


def test_points_outside_the_record():
    """Zero data give a zero image; an image beyond the record wraps around, finite."""
    motion = motion_of(RADAR, 0.0, 0.0, 2000.0)
    assert float(focused(azimuth_echo(RADAR, 900, 0.0, 0.0, 2000.0), RADAR, motion, LeastSquares(2)).abs().max()) == 0
    far = focused(azimuth_echo(RADAR, 900, 40.0, 0.0, 0.0), RADAR, motion_of(RADAR, 40.0), LeastSquares(2))
    assert bool(torch.isfinite(far.abs()).all()) and float(far.abs().max()) > 30


def test_refusals():
    for bad in (0.0, -1.0):
        with pytest.raises(ValueError, match="bandwidth_hz must be positive, or None"):
            FocusAzimuth(RADAR, bandwidth_hz=bad)
    spectrum = Signal(
        reconstruct(azimuth_echo(RADAR, 90), RADAR, motion_of(RADAR), LeastSquares(2)),
        (Reconstruct(RADAR)(Signal(azimuth_echo(RADAR, 90), RADAR.axes(90))).axis("doppler"),),
    )
    with pytest.raises(ValueError, match="u_r_m_s: 1 of 1 values are NaN or Inf"):
        FocusAzimuth(RADAR)(spectrum, u_r_m_s=math.nan)
