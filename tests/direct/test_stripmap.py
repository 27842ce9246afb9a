"""The geometry and the recommended chain of stripmap on data of an independent generator."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchsar.compensate import DopplerCentroid, EffectiveVelocity
from torchsar.core import Chain, Recording, use
from torchsar.focus import OmegaK, OmegaKStolt, RangeCompress
from torchsar.metrics import impulse_response
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.study.bench.direct.stripmap import C, Instrument, echo


def described(radar: Instrument, **more) -> StripmapRadar:
    """The same numbers in the words of the package."""
    pulse = LinearFM(abs(radar.rate_hz_s) * radar.pulse_s, radar.pulse_s, 1 if radar.rate_hz_s > 0 else -1)
    return StripmapRadar(
        radar.carrier_hz, pulse, radar.sampling_hz, radar.prf_hz, radar.velocity_m_s, radar.near_range_m, **more
    )


@pytest.mark.parametrize("reference", ["matched", "flat"])
def test_range_compression_finds_an_echo_whose_edges_lie_between_samples(reference):
    """Any pulse length and sampling rate, from time-bandwidth products of 20 on: the position is
    within 0.02 of a cell of c / (2 bandwidth), and of a sample from products of 60 on.
    """
    draw = np.random.default_rng(5)
    for product in (20.0, 60.0, 250.0, 1257.3):
        for oversampling in (1.0, 1.073, 1.25, 2.0):
            sampling = 10 ** draw.uniform(6, 9)
            bandwidth = sampling / oversampling
            duration = product * draw.uniform(0.95, 1.05) / bandwidth
            sign = draw.choice([-1, 1])
            radar = Instrument(5e9, sign * bandwidth / duration, duration, sampling, 1000.0, 100.0, 9e3)
            n = int(1.5 * duration * sampling) + 200
            place = 40 + draw.uniform(0, 20)
            raw = echo(radar, np.zeros(1), np.array([9e3 + place * C / 2 / sampling]), 1, n)
            known = described(radar)
            line = RangeCompress(known, reference)(Recording.from_arrays(raw, known, dtype=torch.complex128).signal)
            found = peak(line.data[0]) - place
            limit = 0.02 if product >= 60 else 0.02 * oversampling
            assert abs(found) < limit, (product, oversampling, found)


def peak(line: torch.Tensor) -> float:
    """Position of the maximum of the band-limited interpolation of a line, in samples."""
    spectrum, n = torch.fft.fft(line), line.numel()
    frequency = torch.fft.fftfreq(n, dtype=torch.float64)
    grid = int(line.abs().argmax()) + torch.linspace(-1, 1, 201, dtype=torch.float64)
    fine = (torch.exp(2j * math.pi * grid[:, None] * frequency) @ spectrum).abs()
    i = min(max(int(fine.argmax()), 1), 199)
    low, mid, high = fine[i - 1 : i + 2].tolist()
    return float(grid[i]) + 0.01 * 0.5 * (low - high) / (low - 2 * mid + high)


def band(deg: float, prf_hz: float) -> tuple[Instrument, float, float, int]:
    """L band, 250 MHz, 5 km: instrument, Doppler of the beam centre, dwell of 13.1 Hz, pulses."""
    radar = Instrument(1.25e9, 250e6 / 0.8e-6, 0.8013e-6, 300e6, prf_hz, 100.0, 4850.0)
    sine = math.sin(math.radians(deg))
    doppler = 2 * 100.0 * sine * 1.25e9 / C
    dwell = 13.1 / (2 * 100.0**2 * (1 - sine**2) * 1.25e9 / (C * 5000.0))
    return radar, doppler, dwell, int(1.4 * dwell * prf_hz) + 48


def exact_width_m(radar: Instrument, deg: float, dwell_s: float, slant_m: float) -> float:
    """-3 dB width in azimuth of the sum over the aperture and the pulse band, at constant range."""
    sine, cosine = math.sin(math.radians(deg)), math.cos(math.radians(deg))
    t = dwell_s * (np.arange(1200) + 0.5) / 1200 - dwell_s / 2
    offset = np.linspace(-1.2, 1.2, 481)[:, None]
    path = np.hypot(offset + slant_m * sine - 100.0 * t, slant_m * cosine)
    change = path - np.hypot(slant_m * sine - 100.0 * t, slant_m * cosine)
    width = abs(radar.rate_hz_s) * radar.pulse_s
    power = (
        np.abs((np.exp(4j * math.pi * radar.carrier_hz / C * change) * np.sinc(2 * width / C * change)).sum(-1)) ** 2
    )
    over = np.flatnonzero(power > power.max() / 2)
    ends = [
        np.interp(power.max() / 2, power[[out, edge]], offset[[out, edge], 0])
        for out, edge in ((over[0] - 1, over[0]), (over[-1] + 1, over[-1]))
    ]
    return float(ends[1] - ends[0])


@pytest.mark.filterwarnings("ignore:.*hold only zeros")
@pytest.mark.parametrize(("prf_hz", "deg"), [(160.0, 30.0), (80.0, 30.0), (80.0, -30.0)])
def test_stolt_keeps_its_width_where_the_spectrum_of_a_target_spans_more_than_the_prf(prf_hz, deg):
    """The aperture has 13 Hz at each frequency, and 96.5 Hz over the whole pulse band."""
    radar, doppler, dwell, n = band(deg, prf_hz)
    raw = echo(radar, np.array([n / 2 / prf_hz]), np.array([5005.37]), n, 1024, deg, dwell)
    known = described(radar)
    image = OmegaKStolt(known, "flat", doppler_hz=doppler)(Recording.from_arrays(raw, known).signal)
    azimuth = n / 2 / prf_hz * 100.0
    found = impulse_response(image, (azimuth, 5005.37))
    assert float(found["irw_azimuth_m"]) == pytest.approx(exact_width_m(radar, deg, dwell, 5005.37), rel=0.01)
    assert float(found["position_range_m"]) == pytest.approx(5005.37, abs=0.02 * known.range_step_m)
    assert float(found["position_azimuth_m"]) == pytest.approx(azimuth, abs=0.02)


def test_stolt_refuses_an_aperture_that_aliases_at_every_frequency():
    radar, doppler, dwell, _ = band(30.0, 13.0)
    known = described(radar, integration_s=dwell)
    signal = Recording.from_arrays(np.ones((8, 256), dtype=complex), known).signal
    with pytest.raises(ValueError, match=r"14\.664 Hz at the highest range frequency, exceeds the PRF of 13 Hz"):
        OmegaKStolt(known, "flat", doppler_hz=doppler)(signal)
    assert OmegaKStolt(known, "flat", doppler_hz=doppler, band_hz=10.0)(signal).data.isfinite().all()


@pytest.mark.parametrize("moving", [False, True])
def test_the_recommended_chain_works_as_on_the_simulator_of_the_package(moving):
    """Squint of 0.35 degrees, echoes cut between samples; the antenna moves during the flight."""
    radar = Instrument(3.2e9, 50e6 / 1e-6, 1.0037e-6, 62.5e6, 1000.0, 7003.0, 700e3)
    squint, n = 0.35, 512
    draw = np.random.default_rng(2)
    crossing = n / 2000.0 + np.array([-0.1, -0.05, 0.0, 0.04, 0.09])
    slant = 700e3 + (np.array([15.3, 30.8, 42.1, 60.5, 75.9]) + draw.uniform(-0.5, 0.5, 5)) * C / 2 / 62.5e6
    doppler = 2 * 7003.0 * math.sin(math.radians(squint)) * 3.2e9 / C
    raw = echo(radar, crossing, slant, n, 192, squint, 0.3, np.exp(2j * math.pi * draw.random(5)), moving)
    raw += 0.1 * (draw.standard_normal(raw.shape) + 1j * draw.standard_normal(raw.shape))
    known = described(radar, pointing_doppler_hz=doppler, integration_s=0.3)
    chain = Chain(
        doppler=DopplerCentroid(known),
        velocity=use(EffectiveVelocity(OmegaK(known), reach_m_s=30.0, lines=128), doppler_hz="doppler"),
        focus=use(OmegaK(known, "flat"), doppler_hz="doppler", velocity_m_s="velocity"),
    )
    trace = chain.trace(Recording.from_arrays(raw, known))
    assert float(trace.values["doppler.doppler_hz"]) == pytest.approx(doppler, abs=26.0)
    assert float(trace.values["velocity.velocity_m_s"]) == pytest.approx(7003.0, abs=1.0)
    at = (torch.from_numpy(crossing * 7003.0), torch.from_numpy(slant))
    found = impulse_response(trace.signal, at)
    # a moving antenna sees the scene half a flight after the time stamp of its pulse: 16 m
    early = 7003.0 * at[1] / C if moving else 0.0
    assert float((found["position_range_m"] - at[1]).abs().max()) < 0.02 * known.range_step_m
    assert float((found["position_azimuth_m"] + early - at[0]).abs().max()) < 0.02 * 7.0
    assert float((found["irw_range_m"] / known.range_resolution_m - 1).abs().max()) < 0.02
    assert float((found["pslr_range_db"] + 13.26).abs().max()) < 0.7  # five points and noise at -23 dB
