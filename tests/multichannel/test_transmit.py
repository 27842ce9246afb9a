"""Removal of the transmit range by the ephemeris, and by Eq. (31) with k1 in the response."""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import Signal
from torchsar.multichannel import (
    AzimuthScaling,
    LeastSquares,
    PointMotion,
    RemoveTransmitRange,
    doppler_offsets,
    reconstruct,
    remove_transmit_range,
)
from torchsar.multichannel.azimuth import azimuth_filter
from torchsar.multichannel.response import doppler_centre_hz
from torchsar.multichannel.transmit import neglected_transmit_phase_rad
from torchsar.study.bench.direct.moving import azimuth_echo, compressed_echo, published_radar, time_of

K = (-243.0, 0.0208, -1.3e-6, 2e-9)
N = 900


def echo(radar, **move):
    return Signal(azimuth_echo(radar, N, **move), radar.axes(N))


@pytest.mark.parametrize("with_range", [False, True])
def test_removal_leaves_the_receive_path(with_range):
    far, still = published_radar(transmit_range=K), published_radar()
    make = (lambda r: compressed_echo(r, 90, 64, [{"u_r": 10.0}])) if with_range else (lambda r: echo(r, u_r=10.0))
    out = RemoveTransmitRange(far)(make(far))
    torch.testing.assert_close(out.data, make(still).data, atol=1e-7, rtol=0)


def test_orders_are_removed_one_by_one():
    radar = published_radar(transmit_range=K)
    data, time = echo(radar).data, time_of(radar, N)
    with pytest.warns(UserWarning, match="raise the order to 4"):
        left = RemoveTransmitRange(radar, order=1)(Signal(data, radar.axes(N))).data
    full = RemoveTransmitRange(radar)(Signal(data, radar.axes(N))).data
    lit = data.abs() > 0
    phase = torch.angle((left * full.conj())[lit])
    expected = (-2 * math.pi / 0.24 * (K[1] * time**2 + K[2] * time**3 + K[3] * time**4)).expand(3, N)[lit]
    torch.testing.assert_close(
        torch.remainder(phase - expected + math.pi, 2 * math.pi), torch.full_like(phase, math.pi), atol=1e-6, rtol=0
    )
    # the second order matters in 4.5 s, higher orders do not
    assert neglected_transmit_phase_rad(radar, 1, 4.5) == pytest.approx(2 * math.pi / 0.24 * 0.0208 * 2.25**2, rel=1e-3)
    assert neglected_transmit_phase_rad(radar, 2, 4.5) < 1e-3


def test_coefficients_per_trial_with_gradients():
    time = time_of(published_radar(), 6)
    data = torch.randn(2, 3, 6, 4, dtype=torch.complex128, requires_grad=True)
    k2 = torch.tensor([0.01, 0.02], dtype=torch.float64, requires_grad=True)
    together = remove_transmit_range(data, time, (1.0, k2), 0.24)
    torch.testing.assert_close(together[1], remove_transmit_range(data[1], time, (1.0, 0.02), 0.24))
    assert torch.autograd.gradcheck(lambda d, k: remove_transmit_range(d, time, (1.0, k), 0.24), (data, k2))
    with pytest.raises(ValueError, match="for each of the 6 pulses"):
        remove_transmit_range(data, time[:5], K, 0.24)


@pytest.mark.parametrize("u_r, u_a", [(0.0, 10.0), (10.0, 5.0)])
def test_scaling_with_k1_in_the_response_rebuilds_the_same_image(u_r, u_a):
    radar = published_radar(transmit_range=K)
    signal, motion, rebuild = (
        echo(radar, u_r=u_r, u_a=u_a),
        PointMotion.of(radar, torch.zeros(1), u_r, u_a),
        LeastSquares(),
    )
    removed = reconstruct(RemoveTransmitRange(radar)(signal).data, radar, motion, rebuild)
    scaled = reconstruct(AzimuthScaling(radar)(signal, u_r_m_s=u_r, u_a_m_s=u_a).data, radar, motion, rebuild, K[0])
    offset = doppler_offsets(N, rebuild.bands, radar.prf_hz)
    filtered = [
        torch.fft.ifft(s * azimuth_filter(offset, radar, motion, s.dtype, doppler_centre_hz(radar, motion))).abs()
        for s in (removed, scaled)
    ]
    assert (filtered[0] - filtered[1]).norm() < 0.01 * filtered[0].norm()
    assert filtered[0].max() > 25  # focused: the energy of 810 pulses at one position
    # without k1 in the response the reconstruction fails
    wrong = reconstruct(AzimuthScaling(radar)(signal, u_r_m_s=u_r, u_a_m_s=u_a).data, radar, motion, rebuild)
    assert (wrong.abs() - removed.abs()).norm() > 0.3 * removed.norm()


def test_invalid_orders_are_rejected():
    with pytest.raises(ValueError, match="orders 2 to 4"):
        AzimuthScaling(published_radar(), order=5)
    with pytest.raises(ValueError, match="got -1"):
        RemoveTransmitRange(published_radar(), order=-1)
