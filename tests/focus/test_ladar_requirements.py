"""Limits and fidelity of a triangular ladar against figures of an independent model."""

from __future__ import annotations

import math

import pytest

from torchsar.focus import ladar_limits, ladar_requirements
from torchsar.study.bench.direct.triangles import ground, table1


def rows(radar=None, n_period=1024, ranges=(1.5, 1.5), **bounds):
    return {row.name: row for row in ladar_limits(radar or table1(), n_period, ranges, **bounds)}


def effects(radar=None, n_period=512, ranges=(1.0, 2.0), **bounds):
    return {row.effect: row for row in ladar_requirements(radar or table1(), n_period, ranges, **bounds)}


@pytest.mark.parametrize(
    "name, limit",
    [
        ("speed in the beat band", 20.0),
        ("speed of the mirror tone", 12.4),
        ("acceleration of the gradient", 3027.0),
        ("acceleration within a sweep", 12100.0),
        ("spacing of scatterers", 0.06),
    ],
)
def test_limits_of_table_1(name, limit):
    assert rows(spacing_m=0.05)[name].limit == pytest.approx(limit, rel=0.01)


def test_limits_follow_the_parameters():
    assert rows(table1(period_s=1e-3, sample_rate_hz=1e6), ranges=(0.0, 0.1))[
        "acceleration within a sweep"
    ].limit == pytest.approx(3.1, rel=0.01)
    assert rows(table1(keep_every=4))["acceleration of the gradient"].limit == pytest.approx(3027 / 4, rel=0.01)
    real = rows(ground(), ranges=(10.5, 11.0))["speed with real detection"]
    assert (
        real.limit == pytest.approx(0.775e-6 * 21.89e6, rel=0.01)
        and rows(ground(), ranges=(-0.5, 0.5))["speed with real detection"].verdict == "refuse"
    )


def test_bias_of_a_vibration():
    jerk = 10e-6 * (2 * math.pi * 5e3) ** 3
    assert rows(jerk_m_s3=jerk)["velocity bias by jerk"].value == pytest.approx(jerk * (16e-6) ** 2 / 27)
    assert rows(jerk_m_s3=jerk)["velocity bias by jerk"].value / math.sqrt(2) == pytest.approx(2e-3, rel=0.1)


def test_noise_limits():
    at = rows(snr_db=10.0)
    assert (
        at["accumulated phase error"].value == pytest.approx(0.46, rel=0.02)
        and at["accumulated phase error"].verdict == "ok"
    )
    assert rows(snr_db=10.0, n_period=2048)["accumulated phase error"].verdict == "warn"
    assert at["SNR after compression"].limit == 14 and rows(snr_db=-14.0)["SNR after compression"].verdict == "refuse"
    assert "SNR after compression" not in rows()


@pytest.mark.parametrize(
    "bounds, name, verdict",
    [
        ({"speed_m_s": 19.0}, "speed in the beat band", "ok"),
        ({"speed_m_s": 21.0}, "speed in the beat band", "refuse"),
        ({"speed_m_s": 13.0}, "speed of the mirror tone", "refuse"),
        ({"acceleration_m_s2": 3300.0}, "acceleration of the gradient", "warn"),
        ({"acceleration_m_s2": 13000.0}, "acceleration within a sweep", "warn"),
        ({"spacing_m": 0.05}, "spacing of scatterers", "refuse"),
        ({"spacing_m": 0.07}, "spacing of scatterers", "ok"),
        ({"lit_share": 0.9}, "share of periods with a lit reference", "warn"),
    ],
)
def test_verdicts_and_their_sentences(bounds, name, verdict):
    row = rows(**bounds)[name]
    assert row.verdict == verdict
    assert f"{row.limit:.4g}" in row.sentence and (row.remedy in row.sentence) == (verdict != "ok")


def test_several_azimuths_in_a_narrow_beam():
    beam = table1(beam_rad=114e-6)
    name = "azimuth extent in a narrow beam"
    assert (
        rows(beam, azimuth_extent_m=0.12)[name].verdict == "warn"
        and rows(beam)[name].verdict == "ok"
        and name not in rows(azimuth_extent_m=0.12)
    )


@pytest.mark.parametrize(
    "bad, message",
    [
        ({"speed_m_s": math.nan}, "speed_m_s must be a finite non-negative number"),
        ({"ranges": (2.0, 1.0)}, "least, largest"),
        ({"jerk_m_s3": -1.0}, "jerk_m_s3"),
    ],
)
def test_invalid_input_raises(bad, message):
    with pytest.raises(ValueError, match=message):
        rows(**bad)


def test_fidelity_rows():
    assert effects(ranges=(1.85, 2.15))["no residual video phase"].phase_rad == pytest.approx(0.21, rel=0.03)
    assert effects(ground(), ranges=(10.3, 10.7))["no residual video phase"].phase_rad == pytest.approx(0.73, rel=0.01)
    assert effects(table1(speed_m_s=0.25 / 8e-3), n_period=1000)["parabola for hyperbola"].phase_rad == pytest.approx(
        1.5e-7, rel=0.03
    )
    one = effects(speed_m_s=5.0, acceleration_m_s2=200.0)
    assert 0.002 < one["Doppler linear in the sweep"].phase_rad < 0.02 and one["Doppler linear in the sweep"].ok
    assert not one["one range per sweep"].ok and not one["one range per period"].ok
    assert one["carrier for f(u) in compensation"].range_cells == pytest.approx(5 * 512 * 16e-6 / 0.03, rel=0.01)
    assert (
        effects(displacement_m=0.0029)["carrier for f(u) in compensation"].ok
        and not effects(displacement_m=0.0031)["carrier for f(u) in compensation"].ok
    )


def test_flight_time_is_a_shift_of_the_time_axis():
    """The velocity error is 0.2 mm/s at 20 m/s^2 and 3 km, over half the record from its middle."""
    row = effects(acceleration_m_s2=20.0)["flight time ignored"]
    assert row.phase_rad == pytest.approx(4 * math.pi / 1.55e-6 * 2.0e-4 * 512 * 16e-6 / 2, rel=0.01)
