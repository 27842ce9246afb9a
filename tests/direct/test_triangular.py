"""The recommended chain of a triangular-FMCW ladar on sweeps of an independent generator."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from torchsar.compensate import CompensateMotion, CorrectPulsePhase, RadialMotion, radial_motion, range_error
from torchsar.core import Axis, Chain, Draws, Estimate, Signal, use
from torchsar.echo import ladar_echo, simulate_ladar_record
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.metrics import impulse_response
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.repair import BlankTurningPoints, SplitSweeps
from torchsar.scene import EverySample, LadarWorld, Points, Polynomial, Scene, Sinusoid, Speckle
from torchsar.study.bench.direct.triangular import F64, Ladar

BEAM_RAD = 60e-6
MOTION = (Polynomial([0.3, 10.0]), Sinusoid(20e-6, 300.0, 20.0))
DOUBLE = torch.complex128


def moved(t: Tensor) -> Tensor:
    """The same motion in metres, from the start of the record."""
    return 0.3 * t + 10 * t.square() + 20e-6 * torch.sin(2 * math.pi * 300 * t + math.radians(20.0))


def described(ladar: Ladar) -> TriangularLadar:
    """The same numbers in the words of the package."""
    return TriangularLadar(
        ladar.carrier_hz,
        ladar.bandwidth_hz,
        ladar.period_s,
        ladar.sampling_hz,
        ladar.speed_m_s,
        ladar.reference_m,
        None if math.isinf(ladar.beam_rad) else ladar.beam_rad,
    )


def seen(ladar: Ladar, scene: Scene, periods: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Sweeps of the generator, and of the simulator of the package, without noise."""
    s, radar = scene.scatterers(Draws(seed)), described(ladar)
    start = radar.sweep_axes(periods)[1].start
    direct = ladar.sweeps(s.azimuth_m, s.range_m, s.amplitude, periods, lambda t: moved(t - start))
    return direct, ladar_echo(s, radar, periods, MOTION, EverySample(), dtype=DOUBLE)


@pytest.mark.parametrize(
    ("ladar", "periods"),
    [
        (Ladar(sampling_hz=16e6, beam_rad=BEAM_RAD), 256),
        (Ladar(period_s=15.7e-6, sampling_hz=233 / 7.85e-6, parts=3, beam_rad=BEAM_RAD), 255),
        (Ladar(period_s=32.4e-6, sampling_hz=101 / 16.2e-6, beam_rad=BEAM_RAD), 129),
    ],
)
def test_the_recommended_chain_shows_points_at_their_positions(ladar: Ladar, periods: int) -> None:
    """In 0.02 range cell for any sweep and sampling, and as wide as without motion."""
    radar = described(ladar)
    axes = radar.sweep_axes(periods)
    scene = Points([-0.02, 0.0, 0.02], [0.237, 0.413, 0.605], [0.7, 1.0, 0.8])
    chain = Chain(
        motion=RadialMotion(radar, window_m=(0.0, 0.9)),
        compensate=use(CompensateMotion(radar), velocity_m_s="motion"),
        compress=CompressSweeps(radar),
        deramp=DerampAzimuth(radar),
        correct=use(CorrectPulsePhase(), phase_rad="motion"),
        image=AzimuthMatchedFilter(radar, BEAM_RAD),
    )
    trace = chain.trace(Signal(seen(ladar, scene, periods)[0], axes))
    assert bool(trace.estimates["motion"].ok)
    found = impulse_response(trace.signal, (0.0, 0.413), search_m=0.03, centre_turns=(None, 0.0))
    still = chain.trace(Signal(ladar.sweeps(*scatterers(scene), periods), axes)).signal
    rest = impulse_response(still, (0.0, 0.413), search_m=0.03, centre_turns=(None, 0.0))
    # the range counts from the first turning point, before which the target has moved
    before = float(moved(torch.tensor(radar.sweep_s, dtype=F64)))
    assert float(found["position_range_m"]) == pytest.approx(0.413 + before, abs=0.02 * radar.range_step_m)
    for name in ("irw_azimuth_m", "irw_range_m"):
        assert float(found[name]) == pytest.approx(float(rest[name]), rel=0.02)


def scatterers(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth, range and amplitude of a scene."""
    s = scene.scatterers(Draws(0))
    return s.azimuth_m, s.range_m, s.amplitude


def residuals(found: Estimate, radar: TriangularLadar, pulse: Axis, start: float) -> Tensor:
    """Rms errors of the velocity in m/s and of the phase in rad of all trials, (2,)."""
    middle = sweep_middles(radar, pulse)[0] - start
    turning = middle + radar.sweep_s / 2
    speed = 0.3 + 20 * turning + 0.012 * math.pi * torch.cos(2 * math.pi * 300 * turning + math.radians(20.0))
    left = range_error(found, radar, pulse, middle + start) - moved(middle)
    left = left - left.mean(-1, keepdim=True)
    k = torch.linspace(-1, 1, pulse.n, dtype=F64)
    left = left - (left * k).sum(-1, keepdim=True) / k.square().sum() * k
    parts = found["velocity_m_s"] - speed, 4 * math.pi / radar.wavelength_m * left
    return torch.stack([x.square().mean().sqrt() for x in parts])


def noisy(clean: Tensor, snr_db: float, trials: int) -> Tensor:
    """Noise in all trials, the same for any data."""
    noise = Draws(4, trials=range(trials)).normal("noise", tuple(clean.shape), DOUBLE)
    noise = noise if clean.is_complex() else noise.real
    return clean + noise * (clean.abs().square().mean() * 10 ** (-snr_db / 10)).sqrt()


@pytest.mark.parametrize(
    ("scene", "snr_db"), [(Points([0.0], [5.0]), 0.0), (Speckle(12, 0.1, 0.5, range_m=5.0), 15.0)], ids=["one", "many"]
)
def test_radial_motion_is_as_good_as_on_the_simulator_of_the_package(scene: Scene, snr_db: float) -> None:
    """The same scene and noise, with transients of two samples and a detector that integrates."""
    ladar, periods = Ladar(parts=2), 64
    radar = described(ladar)
    pulse = radar.sweep_axes(periods)[1]
    errors, stds = [], []
    for clean in seen(ladar, scene, periods, 3):
        found = radial_motion(noisy(clean, snr_db, 8), radar, pulse, window_m=(4.0, 6.0))
        assert bool(found.ok.all())
        errors.append(residuals(found, radar, pulse, pulse.start))
        stds.append(torch.stack([found.std[n].square().mean().sqrt() for n in ("velocity_m_s", "phase_rad")]))
    assert float((errors[0] / errors[1]).max()) < 1.1
    assert float(((stds[0] / errors[0]) / (stds[1] / errors[1]) - 1).abs().max()) < 0.1


def test_a_record_of_a_real_detector_is_as_good_as_on_the_simulator_of_the_package() -> None:
    """One channel, blocks that start between turning points, and beats of 70 ns after each."""
    ladar = Ladar(period_s=32e-6, sampling_hz=60e6, speed_m_s=3.125, reference_m=4339.5, trigger_s=5.3e-6)
    radar = replace(described(ladar), keep_every=4, detection="real")
    scene = Points([0.0, 0.01, -0.02], [10.5, 10.8, 10.95], [1.0, 0.1, 0.1])
    s, blocks, samples = scene.scatterers(Draws(0)), 64, round(40e-6 * 60e6)
    start = radar.sweep_axes(blocks)[1].start
    direct = ladar.record(s.azimuth_m, s.range_m, s.amplitude, blocks, samples, 4, lambda t: moved(t - start))
    world = LadarWorld(scene, motion=MOTION, fidelity=EverySample())
    own = simulate_ladar_record(radar, world, blocks, Draws(0), 40e-6, ladar.trigger_s, dtype=DOUBLE)[0].signal
    errors = []
    for clean in (direct.real, own.data):
        sweeps = SplitSweeps(radar, ladar.trigger_s)(own.with_data(noisy(clean, 10.0, 8)))
        sweeps = BlankTurningPoints(radar, 11.5)(sweeps)
        pulse = sweeps.axis("pulse")
        found = radial_motion(sweeps.data, radar, pulse, window_m=(8.5, 12.5))
        assert bool(found.ok.all())
        errors.append(residuals(found, radar, pulse, start))
    assert float((errors[0] / errors[1]).max()) < 1.1
