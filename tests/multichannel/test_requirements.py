"""Limits and requirements against published figures and false targets measured in images."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from torchsar.metrics import replica_level, replica_zones
from torchsar.multichannel import (
    LeastSquares,
    MinimumMeanSquare,
    MultichannelUse,
    PointMotion,
    doppler_offsets,
    focus_azimuth,
    multichannel_limits,
    multichannel_requirements,
    reconstruct,
)
from torchsar.multichannel.limits import singular_speeds_m_s
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar

RADAR = published_radar(transmit_range=(-243.0, 0.0208, 1e-6, 1e-9))
STILL: dict[str, Any] = {"u_r_m_s": (0.0, 0.0), "u_a_m_s": (0.0, 0.0)}


def limits(radar=RADAR, **changes):
    use = MultichannelUse(**{"n_pulse": 3600, "u_r_m_s": (-10.0, 10.0), "u_a_m_s": (-5.0, 5.0), **changes})
    return {row.name: row for row in multichannel_limits(radar, use)}


def needs(radar=RADAR, **changes):
    use = MultichannelUse(**{"n_pulse": 3600, "u_r_m_s": (-10.0, 10.0), "u_a_m_s": (0.0, 0.0), **changes})
    return {row.effect: row for row in multichannel_requirements(radar, use)}


def test_the_default_of_two_bands_passes():
    rows = limits(u_a_m_s=(0.0, 5.0))
    assert all(row.ok for row in rows.values()), [row.sentence for row in rows.values() if not row.ok]


# changes, radar changes, name of the row, verdict: every limit that can be predicted
CASES = [
    ({"rebuild": LeastSquares(3), **STILL}, {"prf_hz": 187.5}, "condition number at rest", "refuse"),
    ({"rebuild": LeastSquares(3), **STILL}, {}, "condition number within the velocities", "warn"),
    (
        {"rebuild": LeastSquares(3), "u_a_m_s": (-20.0, 20.0)},
        {},
        "singular speeds along track within the search",
        "warn",
    ),
    ({"rebuild": LeastSquares(4)}, {}, "channels", "refuse"),
    ({"u_a_m_s": (0.0, 300.0)}, {}, "speed past the fastest target", "refuse"),
    ({"n_pulse": 800}, {}, "record", "refuse"),
    ({"n_pulse": 1700, "pattern": True}, {}, "record with a pattern", "warn"),
    ({"integration_s": 5.0, "estimators": ("sir",)}, {}, "Doppler band inside the intensity ratio", "refuse"),
    ({"integration_s": 5.0}, {}, "Doppler band of the integration time", "warn"),
    ({"u_r_m_s": (-21.0, 0.0)}, {}, "slant-range speed", "warn"),
    ({"y0_m": 250.0}, {}, "tone left for the keystone transform", "warn"),
    ({"deramped": False}, {}, "Doppler band for the keystone transform", "warn"),
    ({"clutter": True, "estimators": ("sir",)}, {}, "stationary clutter beside the intensity ratio", "warn"),
    ({"snr_db": -16.0}, {}, "SNR gathered over channels and pulses", "warn"),
    ({"snr_db": 0.0, "estimators": ("sir",)}, {}, "SNR of a sample for the intensity ratio", "warn"),
    ({"y0_m": 3500.0}, {}, "image time of the fastest target", "warn"),
]


@pytest.mark.parametrize(("changes", "radar", "name", "verdict"), CASES, ids=[case[2] for case in CASES])
def test_each_limit_has_its_verdict_and_sentence(changes, radar, name, verdict):
    row = limits(published_radar(**radar), **changes)[name]
    assert row.verdict == verdict
    assert row.consequence in row.sentence and row.remedy in row.sentence


def test_sentences_name_what_makes_a_reconstruction_singular():
    assert (
        "187.5 Hz"
        in limits(published_radar(prf_hz=187.5), rebuild=LeastSquares(3), **STILL)["condition number at rest"].sentence
    )
    assert (
        "u_a = 12 m/s"
        in limits(rebuild=LeastSquares(3), u_a_m_s=(-20.0, 20.0))[
            "singular speeds along track within the search"
        ].sentence
    )


def test_values_of_the_thresholds():
    assert limits(snr_db=-14.0)["SNR gathered over channels and pulses"].ok
    assert limits(n_pulse=1800, pattern=True, **STILL)["record with a pattern"].limit == pytest.approx(9.6)
    assert limits(rebuild=LeastSquares(3), **STILL)["condition number within the velocities"].value == pytest.approx(
        10.2, abs=0.1
    )
    assert limits(dtype=torch.complex128)["condition number at rest"].limit == 1e6
    assert "condition number at rest" not in limits(rebuild=MinimumMeanSquare(5))


def test_singular_speeds():
    assert singular_speeds_m_s(RADAR, 3, (-20.0, 20.0)) == pytest.approx([12.0])
    assert singular_speeds_m_s(RADAR, 2, (-20.0, 20.0)) == []
    assert singular_speeds_m_s(published_radar(channel_m=(-0.8, 0.0, 0.75)), 3, (-20.0, 20.0)) == []
    assert singular_speeds_m_s(
        published_radar(channel_m=(-1.6, -0.8, 0.0, 0.8, 1.6)), 3, (-20.0, 20.0)
    ) == pytest.approx([12.0])
    assert singular_speeds_m_s(published_radar(channel_m=(0.0, 1.6)), 2, (-20.0, 20.0)) == pytest.approx([12.0])


def test_one_channel_and_one_band_have_finite_rows():
    radar = published_radar(channel_m=(0.0,))
    use = MultichannelUse(3600, rebuild=LeastSquares(1), integration_s=2.0)
    assert all(math.isfinite(row.value) for row in multichannel_limits(radar, use))
    assert all(math.isfinite(row.phase_rad) for row in multichannel_requirements(radar, use))


def test_phases_in_the_published_geometry():
    rows = needs(y0_m=150.0, acceleration_m_s2=0.05, swath_m=165.0)
    known = {
        "transmit range of order 1": 2.757,
        "parabolic receive range": 11.7,
        "y0 left out of the azimuth filter": 1.19,
        "motion in the slant plane": 0.7455,
        "no radial acceleration": 3.31,
    }
    for effect, phase in known.items():
        assert rows[effect].phase_rad == pytest.approx(phase, rel=0.1), effect
    assert rows["transmit range of order 2"].phase_rad < 2e-3
    assert rows["channels as delays of one another"].phase_rad < 0.03
    assert (
        rows["one reference range"].range_cells == pytest.approx(0.25, rel=0.01)
        and not needs(swath_m=170.0)["one reference range"].ok
    )
    assert {effect for effect in rows if not rows[effect].ok} >= {*known} - {"motion in the slant plane"} | {
        "no range migration correction",
        "static bulk correction, velocity unknown",
    }
    assert needs(**STILL)["parabolic receive range"].phase_rad == pytest.approx(5.4, rel=0.05)
    assert (
        needs(**STILL)["static bulk correction, velocity unknown"].ok
        and not needs(**STILL)["no range migration correction"].ok
    )
    assert needs(integration_s=0.5, **STILL)["no range migration correction"].ok


# figures of an independent float64 prototype: bands, errors, row, level in dB
LEVELS = [
    (3, {"u_r_error_m_s": 0.1}, "u_r wrong", -41.8),
    (3, {"u_r_error_m_s": 0.5}, "u_r wrong", -29.3),
    (2, {"u_r_error_m_s": 0.5}, "u_r wrong", -57.7),
    (3, {"u_a_error_m_s": 0.1, "u_a_m_s": (10.0, 10.0)}, "u_a wrong", -53.0),
    (3, {"channel_error_rad": math.radians(1)}, "a channel's phase wrong", -35.0),
    (2, {"channel_error_rad": math.radians(1)}, "a channel's phase wrong", -45.0),
]


@pytest.mark.parametrize(("bands", "errors", "effect", "level"), LEVELS)
def test_replicas_of_errors(bands, errors, effect, level):
    row = next(row for name, row in needs(rebuild=LeastSquares(bands), **errors).items() if name.startswith(effect))
    predicted = float(row.neglects.split("at ")[1].split(" dB")[0])
    assert predicted == pytest.approx(level, abs=3.5)
    assert row.ok == (predicted <= -50)


@pytest.mark.parametrize(("bands", "error"), [(3, 0.3), (2, 2.0)])
def test_predicted_replicas_are_those_of_images(bands, error):
    n, radar = 3600, published_radar()
    data = azimuth_echo(radar, n)
    motion = PointMotion.of(radar, data, error)
    spectrum = reconstruct(data, radar, motion, LeastSquares(bands))
    profile = focus_azimuth(spectrum, doppler_offsets(n, bands, 180.0), radar, motion, 337.5)
    zones = replica_zones(radar, bands, 0.0, integration_s=4.5, focused_at=(error, 0.0))
    measured = float(replica_level(profile, 300 / (bands * 180), zones)["mfta_db"])
    row = next(
        row
        for name, row in needs(radar, rebuild=LeastSquares(bands), u_r_error_m_s=error, **STILL).items()
        if name.startswith("u_r wrong")
    )
    assert float(row.neglects.split("at ")[1].split(" dB")[0]) == pytest.approx(measured, abs=3.5)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"u_r_m_s": (5.0, -5.0)}, "in order"),
        ({"n_pulse": 0}, "n_pulse of 1 or more"),
        ({"y0_m": math.nan}, "y0_m=nan"),
        ({"u_a_m_s": (0.0, math.inf)}, "finite"),
    ],
)
def test_refusals(changes, match):
    with pytest.raises(ValueError, match=match):
        MultichannelUse(**{"n_pulse": 900, **changes})
