"""Raw echoes against direct summation, noise, and errors."""

from __future__ import annotations

import math

import pytest
import torch

from tests.helpers import kondor_radar, small_radar
from torchsar.core import Draws
from torchsar.echo import simulate, stripmap_echo
from torchsar.echo.strip import _line_length, lit_power, path_geometry
from torchsar.metrics import error_db
from torchsar.scene import (
    AlwaysLit,
    Antenna,
    Dwell,
    Hyperbola,
    Parabola,
    Points,
    RandomPoints,
    Speckle,
    StripmapWorld,
    Together,
)


def direct(radar, world, n_pulse, n_range, draws):
    """Sum over targets, pulses and frequencies in complex128, on the same band-limited grid."""
    s = world.scene.scatterers(draws)
    doppler = 0.0 if world.doppler_hz is None else world.doppler_hz
    v = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
    p = path_geometry(s, radar, n_pulse, n_range, doppler, v)
    n = _line_length(p, radar, n_range)
    f = torch.fft.fftfreq(n, 1 / radar.sampling_hz, dtype=torch.float64)
    t = torch.arange(n_pulse, dtype=torch.float64) / radar.prf_hz
    out = torch.zeros(n_pulse, n, dtype=torch.complex128)
    for crossing, zero, closest, amplitude in zip(
        p.crossing_s, p.zero_doppler_s, p.closest_m, p.amplitude, strict=True
    ):
        r = torch.sqrt(closest**2 + (v * (t - zero)) ** 2)
        w = world.beam.weight(
            t - crossing, -2 * v**2 * (t - zero) / (radar.wavelength_m * r) - doppler, torch.tensor(v)
        )
        turns = (
            radar.carrier_hz * 2 * r[:, None] / radar.wave_speed_m_s
            + f * 2 * (r[:, None] - radar.near_range_m) / radar.wave_speed_m_s
        )
        out += amplitude * w[:, None] * torch.polar(torch.ones_like(turns), -2 * math.pi * (turns % 1))
    return torch.fft.ifft(out * radar.pulse.spectrum(n, radar.sampling_hz))[:, :n_range]


@pytest.mark.parametrize("beam", [AlwaysLit(), Dwell(0.1), Antenna(4.0)])
@pytest.mark.parametrize("doppler", [0.0, 70.0])
def test_echo_equals_direct_summation(beam, doppler):
    radar = small_radar()
    world = StripmapWorld(RandomPoints(17, 20.0, 80.0), beam, doppler_hz=doppler)
    double, _ = simulate(radar, world, 40, 100, Draws(3), dtype=torch.complex128)
    assert float(error_db(double.signal, direct(radar, world, 40, 100, Draws(3)))) < -150
    single, _ = simulate(radar, world, 40, 100, Draws(3))
    assert float(error_db(single.signal, double.signal)) < -120


def test_a_target_at_the_far_edge_is_cut_and_never_wraps():
    radar = small_radar()
    # its echo begins 10 samples before the end of the line
    far = (100 - 10 - (100 - radar.pulse_samples) / 2) * radar.range_step_m
    recording, _ = simulate(radar, StripmapWorld(Points([0.0], [far])), 4, 100, Draws(0), dtype=torch.complex128)
    power = recording.signal.data.abs().square().mean(0)
    assert float(power[:80].max()) < 1e-2 * float(power[91:].mean())


def test_noise_follows_its_definition_per_trial():
    snr = torch.tensor([-10.0, 0.0, 30.0], dtype=torch.float64)
    world = StripmapWorld(Speckle(300, 10.0, 60.0), snr_db=snr)
    recording, truth = simulate(small_radar(), world, 64, 100, Draws(5, trials=range(3)), dtype=torch.complex128)
    silent, _ = simulate(
        small_radar(), StripmapWorld(world.scene), 64, 100, Draws(5, trials=range(3)), dtype=torch.complex128
    )
    noise = (recording.signal.data - silent.signal.data).abs().square().mean((-2, -1))
    torch.testing.assert_close(10 * torch.log10(lit_power(silent.signal.data) / noise), snr, atol=0.2, rtol=0)
    torch.testing.assert_close(truth.values["noise_std"].square(), noise, rtol=0.05, atol=0)


def test_trials_are_the_same_in_any_chunk():
    world = StripmapWorld(
        Together({"points": RandomPoints(3, 10.0, 40.0), "sea": Speckle(50, 20.0, 60.0)}), snr_db=10.0
    )
    whole, _ = simulate(small_radar(), world, 24, 80, Draws(2, trials=range(4)), dtype=torch.complex128)
    part, _ = simulate(small_radar(), world, 24, 80, Draws(2, trials=[3, 1]), dtype=torch.complex128)
    torch.testing.assert_close(part.signal.data, whole.signal.data[[3, 1]], rtol=0, atol=1e-10)


def test_echo_is_differentiable_in_positions_velocity_and_doppler():
    radar = small_radar()
    base = Points([1.0, -2.0], [3.0, -4.0]).scatterers(Draws(0))

    def echo(azimuth, range_, velocity, doppler):
        world = StripmapWorld(Points([], []), AlwaysLit(), velocity_m_s=velocity, doppler_hz=doppler)
        placed = path_geometry(type(base)(azimuth, range_, base.amplitude), radar, 3, 30, doppler, velocity)
        return stripmap_echo(placed, world, radar, 3, 30, torch.complex128)

    values = (
        base.azimuth_m,
        base.range_m,
        torch.tensor(120.0, dtype=torch.float64),
        torch.tensor(5.0, dtype=torch.float64),
    )
    assert torch.autograd.gradcheck(
        echo, tuple(v.clone().requires_grad_() for v in values), eps=1e-5, atol=1e-5, rtol=1e-3
    )


def test_the_parabola_predicts_what_it_neglects():
    radar = kondor_radar()
    for range_m, since in ((700e3, 0.75), (20e3, 0.5)):
        t, r, v = (torch.tensor(x, dtype=torch.float64) for x in (since, range_m, radar.velocity_m_s))
        measured = 4 * math.pi / radar.wavelength_m * float(Parabola().range_m(t, r, v) - Hyperbola().range_m(t, r, v))
        assert Parabola().neglected_phase_rad(radar, range_m, since) == pytest.approx(measured, rel=1e-4, abs=1e-6)
    # the parabola suffices for the sensor of Tsvetkov 2017, but not at twenty kilometres
    assert (
        Parabola().neglected_phase_rad(radar, 700e3, 0.75)
        < math.pi / 4
        < Parabola().neglected_phase_rad(radar, 20e3, 0.5)
    )


def test_what_no_radar_can_record_is_refused():
    def refused(match, scene=None, n_range=128, **world):
        with pytest.raises(ValueError, match=match):
            simulate(small_radar(), StripmapWorld(scene or Points([0.0], [0.0]), **world), 8, n_range, Draws(0))

    refused("no scatterer", Points([], []))
    refused("behind the radar, at a range of -8", Points([0.0], [-5000.0]))
    refused("squint beyond 90 degrees", doppler_hz=3000.0)
    refused("line of 20 samples does not hold the pulse of 25", n_range=20)


def test_invalid_worlds_are_refused_at_construction():
    with pytest.raises(ValueError, match=r"as many ranges.*\[2, 1\]"):
        Points([0.0, 1.0], [0.0])
    with pytest.raises(ValueError, match="count=0"):
        Speckle(0, 1.0, 1.0)
    with pytest.raises(ValueError, match="extents"):
        RandomPoints(3, -1.0, 1.0)
    with pytest.raises(ValueError, match="dwell_s must be a positive"):
        Dwell(0.0)
    with pytest.raises(ValueError, match="length_m must be a positive"):
        Antenna(-2.0)
