"""Correction of non-linear sweeps, against the sweeps of a linear transmitter."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Signal, unit_phasor
from torchsar.repair import CalibrateSweeps, calibrate_sweeps
from torchsar.repair.triangle_calibrate import sweep_error_s
from torchsar.study.bench.direct.triangles import ground, table1


def error_turns(radar, u, ramp):
    """Phase error of a sweep in turns, slow, fast and cubic, different in up and down sweeps."""
    x = u / radar.sweep_s
    slow = (3.0, 2.0)[ramp] * torch.sin(2 * math.pi * x * (1.3 + 0.4 * ramp) + 0.4)
    return slow + (0.7, -0.5)[ramp] * torch.cos(10 * math.pi * x) + (24, -24)[ramp] * x**3


def echo(radar, range_m, velocity_m_s=0.0, linear=False, n_period=3):
    """Sweeps of one scatterer, with the sweep error or linear."""
    u, rows = radar.fast_time_axis().values(), []
    for ramp, sign in ((0, 1), (1, -1)):
        t = torch.arange(n_period, dtype=torch.float64)[:, None] * radar.period_s + (0.5 + ramp) * radar.sweep_s + u
        dtau = 2 * (range_m + velocity_m_s * t) / radar.wave_speed_m_s
        turns = radar.carrier_hz * dtau + sign * radar.chirp_rate_hz_s * (u * dtau - dtau.square() / 2)
        rows.append(turns if linear else turns + error_turns(radar, u, ramp) - error_turns(radar, u - dtau, ramp))
    return signed(radar, torch.stack(rows))


def signed(radar, turns):
    """Beat in the sign convention of the radar."""
    return unit_phasor(turns if radar.dechirp_sign == "lo_conj_echo" else -turns, torch.complex128)


def channel(radar, delay_s, n_period=1, noise=0.0):
    """Beat of the calibration channel."""
    u = radar.fast_time_axis().values()
    rows = [
        s * radar.chirp_rate_hz_s * delay_s * u + error_turns(radar, u, r) - error_turns(radar, u - delay_s, r) + 0.3
        for r, s in ((0, 1), (1, -1))
    ]
    drift = 0.1 * torch.arange(n_period, dtype=torch.float64)[:, None]
    clean = signed(radar, torch.stack(rows)[:, None] + drift)
    return clean + noise * torch.randn(clean.shape, dtype=clean.dtype, generator=torch.Generator().manual_seed(0))


def residual_rad(x, reference, margin=10):
    """Rms phase of x against the reference, without the mean of each sweep."""
    z = (x * reference.conj())[..., margin:-margin]
    return float(torch.angle(z * z.sum(-1, keepdim=True).conj()).square().mean().sqrt())


@pytest.mark.parametrize(
    "radar, delay_s", [(table1(), 50e-9), (table1(dechirp_sign="echo_conj_lo"), 50e-9), (ground(), 70e-9)]
)
def test_error_of_the_sweep(radar, delay_s):
    u, h = radar.fast_time_axis().values(), 1e-10
    true = torch.stack(
        [
            s * (error_turns(radar, u + h, r) - error_turns(radar, u - h, r)) / (2 * h) / radar.chirp_rate_hz_s
            for r, s in ((0, 1), (1, -1))
        ]
    )
    true = true - true.mean(-1, keepdim=True)
    assert 5e-9 < float(true.abs().max()) < 12e-9
    assert float((sweep_error_s(channel(radar, delay_s), radar, delay_s) - true).abs().max()) < 0.06e-9
    assert (
        float((sweep_error_s(channel(radar, delay_s, 64, 0.05), radar, delay_s) - true).square().mean().sqrt()) < 0.1e-9
    )


@pytest.mark.parametrize("sign", ["lo_conj_echo", "echo_conj_lo"])
def test_resampling_is_right_for_all_ranges(sign):
    radar = table1(dechirp_sign=sign)
    calibration = channel(radar, 50e-9)
    for range_m, before in ((1.5, 0.16), (2.0, 0.21), (-0.4, 0.043)):
        x, reference = echo(radar, range_m), echo(radar, range_m, linear=True)
        assert residual_rad(x, reference) == pytest.approx(before, rel=0.05)
        assert residual_rad(calibrate_sweeps(x, calibration, radar, 50e-9), reference) < 0.005


def test_the_range_of_the_gate_lowers_the_error_far_from_the_reference():
    radar = ground()
    x, reference = echo(radar, 10.8), echo(radar, 10.8, linear=True)
    plain, centred = (
        residual_rad(calibrate_sweeps(x, channel(radar, 70e-9), radar, 70e-9, range_m=r), reference)
        for r in (None, 10.5)
    )
    assert plain < 0.04 and centred < 0.005


def test_the_carrier_phase_is_kept():
    """The mean phase of a sweep is kept; a Doppler shift keeps only 2 pi fd (w - u)."""
    radar = table1()
    x, reference = echo(radar, 1.5, 0.5), echo(radar, 1.5, 0.5, linear=True)
    out = calibrate_sweeps(x, channel(radar, 50e-9), radar, 50e-9)
    assert residual_rad(out, reference) < 0.02
    steps = torch.angle(
        (out[:, 1:] * out[:, :-1].conj() * (reference[:, 1:] * reference[:, :-1].conj()).conj()).mean(-1)
    )
    assert float(steps.abs().max()) < 1e-3


def test_stage_batches_gradients_and_dtype():
    radar = table1()
    x = torch.stack([echo(radar, 1.5), echo(radar, 1.0)])
    calibration = torch.stack([channel(radar, 50e-9), channel(radar, 50e-9, noise=0.01)])
    signal = Signal(x, radar.sweep_axes(3))
    out = CalibrateSweeps(radar, 50e-9)(signal, calibration)
    with_delay = CalibrateSweeps(radar)(signal, calibration, torch.tensor(50e-9, dtype=torch.float64))
    assert torch.equal(out.data, with_delay.data)
    torch.testing.assert_close(out.data[1], calibrate_sweeps(x[1], calibration[1], radar, 50e-9), atol=1e-9, rtol=0)
    assert (
        CalibrateSweeps(radar, 50e-9)(signal.to(torch.complex64), calibration.to(torch.complex64)).data.dtype
        == torch.complex64
    )
    few = x[0, :, :1].clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda y: calibrate_sweeps(y, calibration[0], radar, 50e-9), (few,), fast_mode=True, atol=1e-5
    )


def test_invalid_input_raises():
    radar, x = table1(), echo(table1(), 1.5)
    with pytest.raises(ValueError, match="must be positive"):
        CalibrateSweeps(radar, -1.0)
    with pytest.raises(ValueError, match="calibration must be complex \\(..., 2, K or 1, 512\\)"):
        calibrate_sweeps(x, channel(radar, 50e-9)[..., :100], radar, 50e-9)
    with pytest.raises(ValueError, match="delay_s of the calibration channel must be at most half a sweep"):
        calibrate_sweeps(x, channel(radar, 50e-9), radar, 5e-6)
