"""Image formation of the triangular ladar against direct sums: range compression, residual video
phase, azimuth.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.echo.ladars import DOUBLE, direct_sweeps
from torchsar.core import Axis, Signal
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, azimuth_matched_filter, compress_sweeps, deramp_azimuth
from torchsar.focus.triangular import profile_axes, video_filter
from torchsar.scene import Polynomial, Scatterers
from torchsar.study.bench.direct.triangles import table1

RADAR = table1(speed_m_s=0.0)
MOVING = table1()


def scatterers(x=(0.0,), r=(1.5,), a=(1.0,)) -> Scatterers:
    return Scatterers(
        torch.tensor(x, dtype=torch.float64), torch.tensor(r, dtype=torch.float64), torch.tensor(a, dtype=DOUBLE)
    )


def carrier_rad(range_m: float) -> float:
    return 2 * math.pi * ((2 * range_m / RADAR.wavelength_m) % 1)


def off(phase: Tensor, expected: float) -> float:
    return float(torch.angle(torch.polar(torch.ones_like(phase), phase - expected)).abs().max())


@pytest.mark.parametrize("ramp", ["up", "down"])
@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
@pytest.mark.parametrize("cell", [133, 50, 1, 0, -50, -256])
def test_a_scatterer_has_its_amplitude_and_the_phase_of_its_range(ramp, sign, cell) -> None:
    radar = table1(speed_m_s=0.0, dechirp_sign=sign)
    range_m = cell * radar.range_step_m
    data = direct_sweeps(scatterers(r=(range_m,), a=(0.7,)), radar, 2)
    profiles = compress_sweeps(data.conj() if sign == "echo_conj_lo" else data, radar, ramp)
    axes = profile_axes(radar.sweep_axes(2)[1], radar, ramp)
    at = round(float(axes[1].index_of(range_m)))
    assert int(profiles.abs().argmax(-1)[0]) == at == cell + 256
    assert float((profiles[:, at].abs() - 0.7).abs().max()) < 1e-9
    assert off(torch.angle(profiles[:, at]), carrier_rad(range_m)) < 1e-6


def test_the_wrong_sign_doubles_the_residual_video_phase() -> None:
    """The phase is -pi K dtau^2 in the up-sweep and + in the down-sweep. The printed sign of Remote
    Sens. 2024, 16, 793, Eq. (5) leaves twice that, 2.8 rad at RD 4 m.
    """
    range_m = 133 * RADAR.range_step_m
    data = direct_sweeps(scatterers(r=(range_m,)), RADAR, 1)
    video = math.pi * RADAR.chirp_rate_hz_s * (2 * range_m / RADAR.wave_speed_m_s) ** 2
    cell = 133 + 256
    for ramp, sign in (("up", -1), ("down", 1)):
        left = compress_sweeps(data, RADAR, ramp, video=False)[0, cell]
        assert off(torch.angle(left), carrier_rad(range_m) + sign * video) < 1e-6
        line = torch.arange(-256, 256, dtype=torch.float64) / RADAR.sweep_s
        wrong = left * video_filter(line, RADAR, "down" if ramp == "up" else "up")[cell]
        assert abs(abs(off(torch.angle(wrong), carrier_rad(range_m))) - 2.8) < 0.03


def test_the_filter_before_the_compensation_leaves_a_phase() -> None:
    """Applied to the shifted beat the filter leaves 2 pi fd 2 RD / c + pi fd^2 / K."""
    velocity = 3 * RADAR.ambiguous_velocity_m_s  # of three bins
    cell = 50
    data = direct_sweeps(scatterers(r=(cell * RADAR.range_step_m,)), RADAR, 1, (Polynomial([velocity]),))
    early = compress_sweeps(data, RADAR)[0, 256 + cell + 3]
    dtau = 2 * cell * RADAR.range_step_m / RADAR.wave_speed_m_s
    fd = RADAR.doppler_hz(velocity)
    range_m = cell * RADAR.range_step_m + velocity * RADAR.period_s / 4
    left = 2 * math.pi * fd * dtau + math.pi * fd**2 / RADAR.chirp_rate_hz_s
    assert off(torch.angle(early)[None], carrier_rad(range_m) + left) < 5e-3 and left > 0.02


@pytest.mark.parametrize(
    "radar, n",
    [
        (MOVING, 200),
        (table1(reference_range_m=10.0, speed_m_s=3.0), 200),
        (table1(reference_range_m=1e6, speed_m_s=7000.0), 200),
    ],
)
def test_azimuth_against_direct_sums(radar, n) -> None:
    """At every pixel the image is the sum over the aperture of the profile times the conjugate
    phase of the hyperbola, from 10 m to 1000 km.
    """
    pulse, range_ = profile_axes(radar.sweep_axes(n)[1], radar)
    range_ = Axis("range", 3, 1.2, 0.3, "m")
    g = torch.Generator().manual_seed(0)
    data = torch.randn(n, 3, dtype=DOUBLE, generator=g)
    t, r = pulse.values(), radar.reference_range_m + range_.values()
    for beam in (None, 60 * radar.speed_m_s * pulse.step / radar.reference_range_m):
        image = azimuth_matched_filter(deramp_azimuth(data, radar, pulse, range_), radar, pulse, range_, beam)
        across = radar.speed_m_s * (t[:, None] - t)  # (x, t)
        turns = (
            2
            / radar.wavelength_m
            * across[..., None].square()
            / (torch.sqrt(r.square() + across[..., None].square()) + r)
        )
        inside = torch.ones_like(turns) if beam is None else (across[..., None].abs() <= beam * r / 2)
        direct = (data * torch.polar(inside.to(torch.float64), -2 * math.pi * turns)).sum(1)
        count = n if beam is None else 2 * torch.floor(beam * r / 2 / (radar.speed_m_s * pulse.step)) + 1
        torch.testing.assert_close(image * count, direct, atol=2e-7 * n, rtol=0)


def test_three_points_focus_at_their_positions() -> None:
    x = (-0.04, 0.0, 0.05)
    s = scatterers(x, (1.2, 1.5, 1.8), (0.7, 1.0, 0.5))
    signal = CompressSweeps(MOVING, window_m=(0.5, 2.5))(Signal(direct_sweeps(s, MOVING, 400), MOVING.sweep_axes(400)))
    assert signal.axis("pulse").start == pytest.approx(MOVING.sweep_axes(400)[1].start + MOVING.period_s / 4)
    image = AzimuthMatchedFilter(MOVING, 40e-6)(signal.with_data(deramp_azimuth(signal.data, MOVING, *signal.axes)))
    for at, (position, range_m) in enumerate(zip(x, (1.2, 1.5, 1.8), strict=True)):
        row, column = (
            round(float(axis.index_of(value))) for axis, value in zip(image.axes, (position, range_m), strict=True)
        )
        near = image.data[row - 4 : row + 5, column - 1 : column + 2].abs()
        assert float(near.max()) == pytest.approx((0.7, 1.0, 0.5)[at], rel=0.06)
        assert abs(int(near.amax(-1).argmax()) - 4) <= 1


def test_window_and_invalid_arguments() -> None:
    sweeps = Signal(torch.zeros(2, 3, 512, dtype=DOUBLE), MOVING.sweep_axes(3))
    out = CompressSweeps(MOVING, window_m=[0.0, 3.0])(sweeps)
    assert out.axis("range").start == pytest.approx(0.0, abs=1e-9) and out.axis("range").stop == pytest.approx(
        3.0, abs=0.04
    )
    with pytest.raises(ValueError, match="window_m must lie in the relative ranges"):
        CompressSweeps(MOVING, window_m=(0.0, 9.0))(sweeps)
    with pytest.raises(ValueError, match="ramp must be"):
        CompressSweeps(MOVING, "left")
    with pytest.raises(ValueError, match="low < high"):
        CompressSweeps(MOVING, window_m=(3.0, 0.0))(sweeps)
    with pytest.raises(ValueError, match="up before down, got shape"):
        compress_sweeps(sweeps.data[..., :100], MOVING)
    with pytest.raises(TypeError, match="complex samples"):
        compress_sweeps(sweeps.data.real, MOVING)
    with pytest.raises(ValueError, match="that match their axes"):
        deramp_azimuth(out.data[..., :5], MOVING, *out.axes)
    with pytest.raises(ValueError, match="does not move across"):
        AzimuthMatchedFilter(RADAR)(out)
    with pytest.raises(ValueError, match="m from the ladar; crop it"):
        near = table1(reference_range_m=5.0)
        deramp_azimuth(torch.zeros(3, 512, dtype=DOUBLE), near, *profile_axes(near.sweep_axes(3)[1], near))
    with pytest.raises(ValueError, match="beam_rad must be a positive angle"):
        azimuth_matched_filter(out.data, MOVING, *out.axes, beam_rad=-1.0)
