"""Impairments of the range converter, the channel response and the channel balance."""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import small_recording
from torchsar.core import Draws
from torchsar.echo import ChannelImbalance, ChannelResponse, PeriodicJitter
from torchsar.echo.jitter import sample_unevenly
from torchsar.metrics import error_db

OFFSETS = torch.tensor([0.0, 0.18, -0.12, 0.07], dtype=torch.float64)


@pytest.mark.parametrize("n", [60, 61, 62])
def test_jitter_samples_the_fourier_series_at_the_true_instants(n):
    spectrum = torch.randn(n, dtype=torch.complex128, generator=torch.Generator().manual_seed(n))
    k = torch.fft.fftfreq(n, 1 / n, dtype=torch.float64)
    instants = torch.arange(n) + OFFSETS[torch.arange(n) % 4]
    expected = (spectrum * torch.exp(2j * math.pi * instants[:, None] * k / n)).sum(-1) / n
    torch.testing.assert_close(sample_unevenly(torch.fft.ifft(spectrum)[None], OFFSETS)[0], expected)


def test_jitter_records_a_pilot_of_the_given_tone_and_noise():
    recording, _ = small_recording(trials=2)
    impaired, truth = PeriodicJitter(OFFSETS, pilot_cycles=0.2, pilot_snr_db=20.0, pilot_samples=2000)(
        recording, Draws(1, trials=[0, 1])
    )
    pilot = impaired.aux["pilot"].to(torch.complex128)
    tone = torch.exp(2j * math.pi * 0.2 * (torch.arange(2000) + OFFSETS[torch.arange(2000) % 4]))
    phase = torch.exp(1j * torch.angle((pilot * tone.conj()).sum(-1, keepdim=True)))
    noise = (pilot - tone * phase).abs().square().mean(-1)
    assert pilot.shape == (2, 2000) and bool(((noise / 0.01 - 1).abs() < 0.2).all())
    assert not torch.equal(pilot[0], pilot[1])
    torch.testing.assert_close(truth["offset_samples"], OFFSETS)


def test_jitter_refuses_crossing_instants():
    recording, _ = small_recording()
    with pytest.raises(ValueError, match="coincide or cross"):
        PeriodicJitter((0.0, -1.1))(recording, Draws(0))


def test_response_multiplies_the_spectrum_and_holds_its_edges():
    recording, _ = small_recording()
    impaired, truth = ChannelResponse(lambda u: 2 * u**2, lambda u: 1 + 0.5 * u)(recording, Draws(0))
    n, radar = recording.signal.data.shape[-1], recording.radar
    u = (torch.fft.fftfreq(n, 1 / radar.sampling_hz, dtype=torch.float64) / (radar.pulse.bandwidth_hz / 2)).clamp(-1, 1)
    expected = torch.fft.ifft(torch.fft.fft(recording.signal.data) * torch.polar(1 + 0.5 * u, 2 * u**2))
    assert bool(error_db(impaired.signal.data, expected) < -100)
    assert truth["phase_rad"].shape == truth["amplitude"].shape == (1025,)
    with pytest.raises(ValueError, match="positive"):
        ChannelResponse(amplitude=lambda u: u)(recording, Draws(0))


def test_imbalance_differs_per_trial_and_line():
    recording, _ = small_recording(trials=2)
    gain = torch.tensor([[1.0, 1.2], [1.0, 0.8]], dtype=torch.float64)
    impaired, _ = ChannelImbalance(gain, (0.0, math.pi / 3))(recording, Draws(0, trials=[0, 1]))
    ratio = impaired.signal.data / recording.signal.data
    torch.testing.assert_close(ratio[:, 0::2], torch.ones_like(ratio[:, 0::2]))
    expected = torch.tensor([1.2, 0.8])[:, None, None] * torch.exp(torch.tensor(1j * math.pi / 3))
    torch.testing.assert_close(ratio[:, 1::2], expected.expand(ratio[:, 1::2].shape).to(ratio.dtype))
