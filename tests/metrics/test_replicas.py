"""Azimuth responses with known answers, and false targets of known level at positions computed
pulse by pulse.
"""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.metrics import azimuth_response, replica_level, replica_zones
from torchsar.multichannel import LeastSquares, PointMotion, doppler_offsets, focus_azimuth, reconstruct
from torchsar.study.bench.direct.moving import azimuth_echo, published_radar

F64 = torch.float64
RADAR = published_radar()


def sinc_profile(
    n: int, positions: list[float], amplitudes: list[float], band: float = 0.9, tone: float = 0.0
) -> torch.Tensor:
    """Points of a rectangular band (turns per sample) about `tone`, positions in samples."""
    i = torch.arange(n, dtype=F64)
    return sum(
        a * torch.sinc(band * (i - p)) * torch.exp(2j * math.pi * tone * (i - p))
        for p, a in zip(positions, amplitudes, strict=True)
    )  # type: ignore[return-value]


@pytest.mark.parametrize(("nulls", "islr"), [(10, -10.17), (20, -9.92)])
def test_response_of_a_sinc(nulls, islr):
    figures = azimuth_response(sinc_profile(512, [200.37], [2.0]), 0.5, -30.0, sidelobe_nulls=nulls)
    assert float(figures["irw_m"]) == pytest.approx(0.8859 / 0.9 * 0.5, rel=2e-3)
    assert float(figures["pslr_db"]) == pytest.approx(-13.26, abs=0.03)
    assert float(figures["islr_db"]) == pytest.approx(islr, abs=0.03)
    assert float(figures["position_m"]) == pytest.approx(200.37 * 0.5 - 30, abs=0.002)
    assert float(figures["peak"].abs()) == pytest.approx(2, rel=1e-3)


def test_response_of_a_squinted_spectrum_uses_its_centre():
    profile = sinc_profile(512, [250.4], [1.0], tone=0.4)
    given, found = (azimuth_response(profile, 1.0, centre_turns=turns) for turns in (0.4, None))
    for figures in (given, found):
        assert float(figures["pslr_db"]) == pytest.approx(-13.26, abs=0.1)
    assert abs(float(azimuth_response(profile, 1.0)["pslr_db"]) + 13.26) > 0.3


def test_each_trial_by_itself():
    profiles = torch.stack([sinc_profile(600, [p], [a]) for p, a in ((100.2, 1.0), (400.7, 1e-3), (590.0, 50.0))])
    together = azimuth_response(profiles, 1.0)
    for i, profile in enumerate(profiles):
        for name, value in azimuth_response(profile, 1.0).items():
            torch.testing.assert_close(together[name][i], value)
    silent = azimuth_response(torch.zeros(2, 64, dtype=torch.complex64), 1.0)
    assert all(bool(torch.isfinite(torch.view_as_real(x) if x.is_complex() else x).all()) for x in silent.values())


def test_known_replicas_are_found_between_samples():
    zones = torch.tensor([[-310.0, -290.0], [290.0, 310.0]], dtype=F64)
    profiles = torch.stack(
        [
            sinc_profile(4096, [2000.3, 2300.8, 1999.3 - 600], [1.0, 0.1, 0.5]),
            sinc_profile(4096, [1000.0, 695.5], [1.0, 0.03]),
        ]
    )
    found = replica_level(profiles, 1.0, zones)
    assert found["mfta_db"].tolist() == pytest.approx(
        [-20.0, -30.46], abs=0.4
    )  # side lobes of the point itself lie at -59 dB there
    assert found["offset_m"].tolist() == pytest.approx([300.5, -304.5], abs=0.6)
    assert found["covered"].tolist() == [1.0, 1.0]


def image(u_r, u_a, bands, n_pulse=3600, focused=None, r0=5000.0):
    """Image (azimuth,) of one point, its spectrum cut to the processed band, and the step of x = v
    t.
    """
    u = (u_r, u_a) if focused is None else focused
    data = azimuth_echo(RADAR, n_pulse, u_r, u_a, r0=r0)
    motion = PointMotion.of(RADAR, data, u[0], u[1], 0.0, r0)
    spectrum = reconstruct(data, RADAR, motion, LeastSquares(bands))
    band = float(motion.square_m2_s2) * 4.5 / (0.24 * r0)
    return focus_azimuth(spectrum, doppler_offsets(n_pulse, bands, 180.0), RADAR, motion, band), (300 - u[1]) / (
        bands * 180
    )


# (u_r, u_a), bands, velocities focused with, and MFTA of an independent float64 model of Remote
# Sens. 2020, 12, 1703, Table 4 and Figure 17
CASES = [
    ((0, 10), 3, None, -61.7, 4),
    ((10, 0), 3, None, -56.0, 1),
    ((10, 5), 3, None, -51.5, 1),
    ((5, 10), 3, None, -49.7, 1),
    ((10, 0), 2, (0, 0), -19.4, 0.5),
    ((10, 0), 3, (0, 0), -6.3, 0.5),
    ((0, 10), 2, (0, 0), -45.6, 0.5),
    ((5, 10), 2, (0, 0), -23.1, 0.5),
]


@pytest.mark.parametrize(("velocity", "bands", "focused", "level", "within"), CASES)
def test_published_cases(velocity, bands, focused, level, within):
    profile, step = image(velocity[0], velocity[1], bands, focused=focused)
    zones = replica_zones(
        RADAR,
        bands,
        velocity[0],
        velocity[1],
        integration_s=4.5,
        focused_at=focused,
        axis_speed_m_s=300.0 - (velocity if focused is None else focused)[1],
    )
    assert float(replica_level(profile, step, zones)["mfta_db"]) == pytest.approx(level, abs=within)


@pytest.mark.parametrize("velocity", [(10, 0), (10, 5), (5, 10), (0, 10)])
def test_two_bands_with_known_velocities_have_the_response_of_theory(velocity):
    profile, step = image(velocity[0], velocity[1], 2)
    zones = replica_zones(RADAR, 2, velocity[0], velocity[1], integration_s=4.5, axis_speed_m_s=300.0 - velocity[1])
    assert float(replica_level(profile, step, zones)["mfta_db"]) < -65
    figures = azimuth_response(profile, step)
    v = 300 - velocity[1]
    assert float(figures["irw_m"]) == pytest.approx(0.886 * 0.24 * 5000 / (v * 4.5), rel=0.02)
    assert float(figures["pslr_db"]) == pytest.approx(-13.26, abs=0.15)
    assert float(figures["islr_db"]) == pytest.approx(-9.8, abs=0.3)


def test_zones_contain_the_replicas_of_the_exact_hyperbola():
    """For a point at 6490 m with u_r = 10 m/s an independent model has a replica at 937.2 m; the
    approximation PRF lambda R0 V_R / V^2 gives 933.9 m.
    """
    zones = replica_zones(RADAR, 2, 10.0, range_m=6490.0, integration_s=4.5)
    assert zones.shape == (4, 2)
    first, last = zones[2].tolist()
    assert first < 937.2 < last and last - first < 50
    torch.testing.assert_close(zones[0, 0], -zones[3, 1], rtol=0.01, atol=0)
    batch = replica_zones(RADAR, 2, torch.tensor([10.0, 0.0], dtype=F64), range_m=6490.0, integration_s=4.5)
    torch.testing.assert_close(batch[0], zones)
    profile, step = image(10, 0, 2, focused=(0, 0), r0=6490.0)
    blurred = replica_zones(RADAR, 2, 10.0, range_m=6490.0, integration_s=4.5, focused_at=(0.0, 0.0))
    assert abs(float(replica_level(profile, step, blurred)["offset_m"])) == pytest.approx(937.2, abs=0.2)


def test_replica_is_found_in_its_zone_at_its_measured_position():
    """The largest false target of the conventional image is found at its position in the whole
    profile.
    """
    profile, step = image(10, 0, 2, focused=(0, 0))
    zones = replica_zones(RADAR, 2, 10.0, integration_s=4.5, focused_at=(0.0, 0.0))
    found = float(replica_level(profile, step, zones)["offset_m"])
    power = profile.abs()
    far = (torch.arange(len(power)) - power.argmax()).abs() * step > 300
    assert abs(found) == pytest.approx(abs(float(((power * far).argmax() - power.argmax()) * step)), abs=1.0)


def test_invalid_arguments_raise():
    profile = sinc_profile(256, [128.0], [1.0])
    with pytest.raises(ValueError, match="record longer"):
        replica_level(profile, 1.0, torch.tensor([[700.0, 740.0]], dtype=F64))
    with pytest.raises(TypeError, match="complex samples"):
        replica_level(profile.real, 1.0, torch.tensor([[70.0, 74.0]], dtype=F64))
    with pytest.raises(ValueError, match="orders from 1 on"):
        replica_zones(RADAR, 2, orders=(0,))
    with pytest.raises(ValueError, match="range_m must be positive"):
        replica_zones(RADAR, 2, range_m=-8e3)
    with pytest.raises(ValueError, match="NaN or Inf"):
        azimuth_response(profile * math.nan, 1.0)
    assert (
        float(
            replica_level(torch.zeros(256, dtype=torch.complex64), 1.0, torch.tensor([[70.0, 74.0]], dtype=F64))[
                "mfta_db"
            ]
        )
        == -300
    )
