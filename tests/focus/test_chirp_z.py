"""Chirp-z transform against the direct sum, and correction of range walk by the keystone
transform.
"""

from __future__ import annotations

import math

import pytest
import torch

from torchsar.core import centred_ifft
from torchsar.focus import chirp_z, keystone


def noise(*shape):
    return torch.randn(*shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))


def direct(x, start, step, n, centre):
    j = torch.arange(x.shape[-1], dtype=torch.float64) - centre
    frequency = start[..., None] + step[..., None] * torch.arange(n, dtype=torch.float64)
    return (torch.exp(-2j * math.pi * frequency[..., None] * j) @ x[..., None])[..., 0]


@pytest.mark.parametrize("m, n, centre", [(7, 12, None), (64, 20, 0), (33, 33, 40), (5, 1, None)])
def test_equals_the_direct_sum(m, n, centre):
    x, start, step = (
        noise(2, 3, m),
        torch.tensor([0.3, -5.2, 17.0], dtype=torch.float64),
        torch.tensor([[0.01], [-0.37]], dtype=torch.float64),
    )
    want = direct(x, *torch.broadcast_tensors(start, step), n, m // 2 if centre is None else centre)
    torch.testing.assert_close(chirp_z(x, start, step, n, centre=centre), want, rtol=1e-11, atol=1e-11)
    assert torch.linalg.vector_norm(
        chirp_z(x.to(torch.complex64), start, step, n, centre=centre) - want
    ) < 2e-6 * torch.linalg.vector_norm(want)


def test_along_another_dim_and_of_a_plain_fft():
    x = noise(8, 3)
    torch.testing.assert_close(chirp_z(x, 0.0, 1 / 8, 8, dim=0, centre=0), torch.fft.fft(x, dim=0))
    with pytest.raises(ValueError, match="n=0"):
        chirp_z(x, 0.0, 0.1, 0)


def test_gradients():
    x, start, step = (
        noise(2, 6).requires_grad_(),
        torch.tensor([0.1, 0.4], dtype=torch.float64).requires_grad_(),
        torch.tensor(0.07, dtype=torch.float64).requires_grad_(),
    )
    assert torch.autograd.gradcheck(lambda *a: chirp_z(*a, 5), (x, start, step))
    assert torch.autograd.gradgradcheck(lambda *a: chirp_z(*a, 5), (x, start, step))


def walking(cells, n=64, m=48, carrier=1000.0, step=4.0):
    """(pulse, range frequency) of a point at 3 cells that walks `cells` over the aperture, slow
    time zero at pulse n // 2.
    """
    frequency = step * (torch.arange(m, dtype=torch.float64) - m // 2)
    time = torch.arange(n, dtype=torch.float64) - n // 2
    delay = cells / (m * step) * time / n
    doppler = carrier * delay
    data = torch.exp(-2j * math.pi * (frequency * 3 / (m * step) + (carrier + frequency) * delay[:, None]))
    return data, frequency, carrier, torch.exp(-2j * math.pi * (frequency * 3 / (m * step) + doppler[:, None])), doppler


def profiles(data):
    return centred_ifft(data).abs()


@pytest.mark.parametrize("cells, ambiguity", [(2.0, 0), (-4.0, 0), (26.0, -2)])
def test_range_walk_is_removed(cells, ambiguity):
    """A target that walks 26 cells has 2.1 pulse rates of Doppler, of which the samples show
    0.1.
    """
    data, frequency, carrier, still, doppler = walking(cells)
    assert (round(float(doppler[-1] - doppler[-2]) * -1) == ambiguity) or abs(cells) < 12
    out = keystone(data, frequency, carrier, ambiguity)
    inner = slice(12, -12)
    assert (out - still)[inner].abs().max() < 0.1  # the rest is the cut of the aperture
    assert (profiles(out)[inner].argmax(-1) == profiles(still)[0].argmax()).all()
    assert len(profiles(data).argmax(-1).unique()) > abs(cells) - 1


def test_whole_doppler_bins_are_scaled_exactly():
    n, frequency, carrier = 16, torch.tensor([-100.0, 0.0, 50.0], dtype=torch.float64), 1000.0
    time = torch.arange(n, dtype=torch.float64) - n // 2
    data = torch.exp(2j * math.pi * 3 / n * time)[:, None].expand(n, 3)
    want = torch.exp(2j * math.pi * 3 / n * time[:, None] * carrier / (carrier + frequency))
    torch.testing.assert_close(keystone(data, frequency, carrier), want)
    torch.testing.assert_close(
        keystone(data.expand(2, n, 3), frequency, carrier, torch.tensor([0, 1]))[1],
        want * torch.exp(2j * math.pi * time[:, None] * carrier / (carrier + frequency)),
    )


def test_invalid_arguments_raise():
    data = noise(8, 3)
    with pytest.raises(ValueError, match="one frequency per"):
        keystone(data, torch.zeros(4, dtype=torch.float64), 1e3)
    with pytest.raises(ValueError, match="above minus the carrier"):
        keystone(data, torch.tensor([-2e3, 0.0, 1.0], dtype=torch.float64), 1e3)
