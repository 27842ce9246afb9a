"""Conventional image: positions, widths and phases over the whole swath, and displaced targets."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import centred_ifft
from torchsar.metrics import impulse_response
from torchsar.multichannel import (
    LeastSquares,
    MinimumMeanSquare,
    PointMotion,
    StationaryImage,
    reconstruct,
    stationary_image,
)
from torchsar.study.bench.direct.moving import compressed_echo, published_radar

RADAR = published_radar()


def test_points_at_rest_over_the_whole_swath():
    points = [{}, {"y0": 60.0, "r0": 5600.0}, {"y0": -60.0, "r0": 4800.0, "amplitude": 0.5}]
    signal = compressed_echo(RADAR, 960, 320, points)
    image = StationaryImage(RADAR)(signal)
    for point in points:
        r0, y0, amplitude = point.get("r0", 5000.0), point.get("y0", 0.0), point.get("amplitude", 1.0)
        found = impulse_response(image, (y0, r0), search_m=10.0)
        assert float(found["position_azimuth_m"]) == pytest.approx(y0, abs=0.01)
        assert float(found["position_range_m"]) == pytest.approx(r0, abs=0.05)
        assert float(found["irw_azimuth_m"]) == pytest.approx(0.886 * 0.24 * r0 / (300 * 4.5), rel=0.02)
        assert float(found["pslr_azimuth_db"]) == pytest.approx(-13.2, abs=0.4)
        assert float(found["peak"].abs()) == pytest.approx(amplitude * 4.5 * 300 / math.sqrt(0.24 * r0), rel=0.01)
        turned = found["peak"] * torch.exp(torch.tensor(2j * math.pi * ((r0 - 5000.0) / 0.24 % 1)))
        assert abs(float(torch.angle(turned))) < 0.02


def test_the_bulk_form_is_exact_in_the_middle_only():
    points = [{}, {"r0": 5600.0}]
    signal = compressed_echo(RADAR, 960, 320, points)
    image = {form: StationaryImage(RADAR, form=form)(signal) for form in ("stolt", "bulk")}
    peak = {
        form: [impulse_response(x, (0.0, p.get("r0", 5000.0)), search_m=10.0)["peak"].abs() for p in points]
        for form, x in image.items()
    }
    assert float(peak["bulk"][0] / peak["stolt"][0]) == pytest.approx(1, abs=0.01)
    assert float(peak["bulk"][1] / peak["stolt"][1]) < 0.97


def test_a_moving_point_is_displaced():
    u_r = 4.0
    signal = compressed_echo(RADAR, 1200, 128, [{"u_r": u_r}])
    image = StationaryImage(RADAR)(signal)
    strongest = int(image.data.abs().amax(-1).argmax())
    assert float(image.axes[0].values()[strongest]) == pytest.approx(300 * u_r * 5000 / (300**2 + u_r**2), abs=3.0)


def test_unaliased_pulses_are_those_of_a_fast_radar():
    fast = published_radar(prf_hz=2 * RADAR.prf_hz, channel_m=(0.0,))
    slow, want = (
        compressed_echo(RADAR, 600, 32, [{"r0": 5010.0}], gate_s=2.5),
        compressed_echo(fast, 1200, 32, [{"r0": 5010.0}], gate_s=2.5),
    )
    motion = PointMotion.of(RADAR, slow.data.real)
    got = centred_ifft(reconstruct(slow.data, RADAR, motion, LeastSquares(), with_range=True), dim=-2)
    inside = slice(200, 1000)
    assert (got - want.data[0])[inside].norm() < 0.03 * want.data[0][inside].norm()


def test_trials_dtype_and_gradients():
    radar = published_radar()
    signal = compressed_echo(radar, 12, 16, [{}, {"r0": 5010.0}])
    both = torch.stack([signal.data, 3 * signal.data])
    for rebuild in (LeastSquares(), MinimumMeanSquare()):
        image = stationary_image(both, radar, 4960.0, rebuild)
        assert image.shape == (2, 12 * rebuild.bands, 16)
        torch.testing.assert_close(image[1], 3 * image[0])
        assert stationary_image(both.to(torch.complex64), radar, 4960.0, rebuild).dtype == torch.complex64
    small = signal.data[:, :4, :8].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda d: stationary_image(d, radar, 4980.0), (small,), fast_mode=True)


def test_refusals():
    with pytest.raises(ValueError, match="must be one of"):
        stationary_image(torch.zeros(3, 4, 4, dtype=torch.complex128), RADAR, 4990.0, form="exact")
    with pytest.raises(ValueError, match="rebuild at most 3"):
        StationaryImage(RADAR, LeastSquares(4))
    signal = compressed_echo(published_radar(prf_hz=187.5), 12, 16, [{}])
    with pytest.raises(ValueError, match="sample nearly the same positions"):
        StationaryImage(published_radar(prf_hz=187.5), LeastSquares(3))(signal)
