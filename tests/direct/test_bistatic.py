"""Uncompressed bistatic echoes of an independent generator share the geometry of the package."""

from __future__ import annotations

import math

import pytest
import torch

from tests.direct.bistatic import C, echo
from tests.direct.test_stripmap import peak
from torchsar.focus import flat_reference, range_compress
from torchsar.radar import BistaticRadar, LinearFM


@pytest.mark.parametrize("duration_s", [10e-6, 9.9931e-6])
def test_compressed_peaks_lie_at_the_receive_range_with_the_phase_of_the_path(duration_s):
    transmit = (-243.0, 0.018)
    radar = BistaticRadar(1.25e9, LinearFM(50e6, duration_s), 60e6, 180.0, 300.0, 5000.0, transmit_range=transmit)
    _, pulses, samples = radar.axes(5, 1500)
    time_s, line_m = pulses.values().numpy(), samples.values().numpy()
    for channel_m in radar.channel_m:
        raw, range_m = echo(
            time_s,
            line_m,
            carrier_hz=1.25e9,
            rate_hz_s=50e6 / duration_s,
            pulse_s=duration_s,
            speed_m_s=300.0,
            channel_m=channel_m,
            closest_m=5012.3,
            along_m=3.1,
            closing_m_s=11.0,
            transmit=transmit,
        )
        lines = range_compress(torch.from_numpy(raw), flat_reference(radar.pulse, 1500, 60e6))
        place = (range_m - samples.start) / samples.step
        assert max(abs(peak(line) - x) for line, x in zip(lines, place, strict=True)) < 0.02
        shift = torch.fft.fftfreq(1500, dtype=torch.float64) * torch.from_numpy(place)[:, None]
        at_peak = (torch.fft.fft(lines) * torch.exp(2j * math.pi * shift)).mean(-1)
        path = torch.from_numpy(range_m) + radar.transmit_range_m(torch.from_numpy(time_s))
        left = at_peak * torch.exp(2j * math.pi * torch.remainder(path / radar.wavelength_m, 1))
        assert radar.wave_speed_m_s == C and float((left - 1).abs().max()) < 0.01
