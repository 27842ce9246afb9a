"""Stripmap estimators: Doppler, ambiguity, velocity, and the position of a point."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.compensate import (
    DopplerCentroid,
    EffectiveVelocity,
    EnergyCentre,
    PhaseIncrement,
    PointDoppler,
)
from torchsar.core import Draws, Signal
from torchsar.echo import simulate, simulate_turntable
from torchsar.focus import OmegaK
from torchsar.radar import LIGHT_M_S, InverseRadar, LinearFM, StripmapRadar
from torchsar.scene import (
    Aircraft,
    Dwell,
    Points,
    RandomPoints,
    Scene,
    Speckle,
    StripmapWorld,
    TurntableWorld,
    UniformStartPhase,
)
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World
from torchsar.study.bench.nothing import nothing

F64 = torch.float64
# settings of the scenes and methods, by choice
LINES, CELLS, DWELL_S = 768, 192, 1.0
RADAR = StripmapRadar(
    3.2e9, LinearFM(40e6, 0.5e-6), 50e6, 400.0, 120.0, 4000.0, pointing_doppler_hz=0.0, integration_s=DWELL_S
)
# settings of the scenes and methods, by choice
SQUINTED = replace(RADAR, pointing_doppler_hz=2 * 120 / RADAR.wavelength_m * math.sin(math.radians(8)))
FAST = StripmapRadar(
    3.2e9, LinearFM(100e6, 0.4e-6), 125e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=652.0, integration_s=0.1
)
# a quarter of the Doppler band of the beam, and the velocity error of a quarter of a cycle of phase
DOPPLER_HZ = 0.25 * float(RADAR.azimuth_rate_hz_s(4000.0, 120.0)) * DWELL_S
VELOCITY_M_S = 0.25 * 2 * RADAR.wavelength_m * 4000 / (120 * DWELL_S**2)


def strip(
    scene: Callable[[], Scene] = lambda: RandomPoints(24, 230.0, 150.0, spread_db=6.0),
    snr_db: float | None = 10.0,
    radar: StripmapRadar = RADAR,
    lines: int = LINES,
    cells: int = CELLS,
    doppler_hz: float = 0.0,
    velocity_m_s: float = 0.0,
    beam_s: float | None = None,
) -> Callable[[int, int], Batch]:
    """Draw strips with a random centroid (+-40 Hz about the pointing) and velocity (+-3 m/s)."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        centroid = (radar.pointing_doppler_hz or 0.0) + doppler_hz + draws.uniform("audit.doppler", (), -40.0, 40.0)
        velocity = radar.velocity_m_s + velocity_m_s + draws.uniform("audit.velocity", (), -3.0, 3.0)
        world = StripmapWorld(
            scene(),
            Dwell(beam_s or radar.integration_s or DWELL_S),
            velocity_m_s=velocity,
            doppler_hz=centroid,
            snr_db=snr_db,
        )
        signal = simulate(radar, world, lines, cells, draws)[0].signal
        return Batch(signal, truth_of(centroid, velocity, radar))

    return draw


def truth_of(centroid: Tensor, velocity: Tensor, radar: StripmapRadar = RADAR) -> dict[str, Tensor]:
    """True values of all estimators of a strip."""
    prf = radar.prf_hz
    baseband = centroid - prf * torch.round(centroid / prf)
    return {
        "doppler_hz": centroid,
        "doppler_baseband_hz": baseband,
        "velocity_m_s": velocity,
    }


def direct(snr_db: float, radar: StripmapRadar = RADAR) -> Callable[[int, int], Batch]:
    """Draw strips by a program of its own: chirps in time, with edges between samples, per line.

    The range changes inside the pulse length only by start-stop; a point is lit while its Doppler
    lies within the band of the beam.
    """

    def draw(trials: int, seed: int) -> Batch:
        generator = torch.Generator().manual_seed(seed + 77)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(*shape, generator=generator, dtype=F64)

        t = (torch.arange(LINES, dtype=F64) - LINES // 2) / radar.prf_hz
        wavelength, length = LIGHT_M_S / radar.carrier_hz, radar.pulse.duration_s
        rate, window = radar.pulse.bandwidth_hz / length, torch.arange(math.ceil(length * radar.sampling_hz) + 4)
        data, doppler, speed = [], uniform(-40, 40, trials), 120 + uniform(-3, 3, trials)
        for centroid, v in zip(doppler, speed, strict=True):
            total = torch.zeros(LINES, CELLS, dtype=torch.complex128)
            for _ in range(20):
                t0, r0 = uniform(-1.0, 1.0, 1), radar.near_range_m + uniform(40, 340, 1)
                r = torch.sqrt(r0**2 + (v * (t - t0)) ** 2)
                centre_t = t0 - centroid * wavelength * r0 / (2 * v**2)
                since = 2 * (r - radar.near_range_m) / LIGHT_M_S * radar.sampling_hz
                columns = int(since.min()) + window  # the range changes by less than two samples
                u = (columns - since[:, None]) / radar.sampling_hz - length / 2
                inside = (u.abs() <= length / 2) & ((t - centre_t).abs() <= DWELL_S / 2)[:, None]
                turns = rate / 2 * u**2 - 2 * (r / wavelength)[:, None] + uniform(0, 1, 1)
                total[:, columns] += inside * torch.polar(
                    torch.ones_like(turns), 2 * math.pi * torch.remainder(turns, 1)
                )
            power = total.abs().square()
            level = power[power > 0].mean()
            noise = torch.view_as_complex(torch.randn(LINES, CELLS, 2, generator=generator, dtype=F64)) / math.sqrt(2)
            data.append(total + noise * torch.sqrt(level * 10 ** (-snr_db / 10)))
        signal = Signal(torch.stack(data).to(torch.complex64), radar.raw_axes(LINES, CELLS))
        return Batch(signal, truth_of(doppler, speed))

    return draw


def turntable(trials: int, seed: int) -> Batch:
    """Pulses of a turning aircraft, as if they were a strip."""
    ladar = InverseRadar(193.4e12, 150e9, 2000.0, 0.005)
    world = TurntableWorld(Aircraft(), start_phase=[UniformStartPhase()], snr_db=10.0)
    data = simulate_turntable(ladar, world, 400, CELLS, Draws(seed, trials=range(trials)))[0].signal.data
    return Batch(Signal(data, RADAR.raw_axes(400, CELLS)), None)


def one_row(trials: int, seed: int) -> Batch:
    """One range cell of a strip."""
    batch = strip()(trials, seed)
    return Batch(Signal(batch.data.data[..., 60:61], RADAR.raw_axes(LINES, 1)), batch.truth)


# settings of the scenes and methods, by choice
SPECKLE = Speckle(600, 330.0, 250.0)
SCENES: Sequence[World] = (
    *(World("own", strip(snr_db=snr), snr) for snr in SNR_DB),
    World("clutter", strip(lambda: SPECKLE), 10.0),
    World("one point", strip(lambda: Points([0.0], [0.0], random_phase=True)), 10.0),
    World("few points", strip(lambda: RandomPoints(3, 230.0, 150.0)), 10.0),
    World("many points", strip(lambda: RandomPoints(200, 330.0, 250.0)), 10.0),
    World("one row", one_row, 10.0),
    World("partly lit", strip(lambda: RandomPoints(24, 40.0, 150.0, azimuth_m=115.0), lines=512), 10.0),
    World("direct", direct(10.0), 10.0),
    World("direct", direct(-10.0), -10.0),
)
NOTHING = nothing((LINES, CELLS), lambda x: Signal(x, RADAR.raw_axes(LINES, CELLS)))
OTHER_SYSTEM = World("turntable", turntable)
# worlds, with settings by choice
ALIASED = World("aliased", strip(doppler_hz=RADAR.prf_hz), 10.0)
SHORT = World("short dwell", strip(beam_s=0.4), 10.0)


def circular_hz(found: Tensor, truth: Tensor) -> Tensor:
    """Difference of baseband centroids modulo the PRF."""
    off = found - truth
    return (off - RADAR.prf_hz * torch.round(off / RADAR.prf_hz)).abs()


def middle_of(found: Tensor, truth: Tensor) -> Tensor:
    """Worst error of a centroid per range cell against one for all, modulo the PRF."""
    return circular_hz(found, truth[..., None]).amax(-1)


# tolerances of use
BASEBAND = [Quantity("doppler_baseband_hz", DOPPLER_HZ, circular_hz, 0.5)]


def points(snr_db: float, doppler_hz: float = 0.0) -> Callable[[int, int], Batch]:
    """Draw images of one point that the beam centre crosses in the middle line."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        centroid = 652.0 + doppler_hz + draws.uniform("audit.doppler", (), -60.0, 60.0)
        world = StripmapWorld(Points([0.0], [0.0], random_phase=True), Dwell(0.1), doppler_hz=centroid, snr_db=snr_db)
        signal = simulate(FAST, world, 512, 192, draws)[0].signal
        return Batch(OmegaK(FAST)(signal), {"doppler_hz": centroid})

    return draw


def image(scene: Scene) -> Callable[[int, int], Batch]:
    """Draw images of a scene that has no point at the beam centre's crossing."""

    def draw(trials: int, seed: int) -> Batch:
        world = StripmapWorld(scene, Dwell(0.1), doppler_hz=652.0, snr_db=10.0)
        batch = simulate(FAST, world, 512, 192, Draws(seed, trials=range(trials)))[0].signal
        return Batch(OmegaK(FAST)(batch), None)

    return draw


# settings of the scenes and methods, by choice
POINT_WORLDS = (
    *nothing((512, 192), lambda x: Signal(x, FAST.image_axes(FAST.raw_axes(512, 192)))),
    *(World("own", points(snr), snr) for snr in (-30.0, -20.0, -10.0, 0.0, 20.0, 40.0)),
    World("clutter", image(Speckle(2400, 900.0, 60.0)), 10.0),
)


def velocity() -> Entry:
    """The effective velocity of a strip."""
    baseband, found = PhaseIncrement(RADAR), EffectiveVelocity(OmegaK(RADAR), 25.0)
    return Entry(
        "EffectiveVelocity",
        lambda x: found(x, baseband(x)["doppler_baseband_hz"]),
        (*NOTHING, *SCENES, OTHER_SYSTEM, SHORT, World("beyond the search", strip(velocity_m_s=40.0), 10.0)),
        [Quantity("velocity_m_s", VELOCITY_M_S, floor=0.05)],
    )


def entries() -> list[Entry]:
    """Estimators of the Doppler centroid."""
    return [
        Entry(
            "DopplerCentroid",
            DopplerCentroid(RADAR),
            (*NOTHING, *SCENES, ALIASED, OTHER_SYSTEM, SHORT),
            [Quantity("doppler_hz", DOPPLER_HZ, floor=0.5)],
        ),
        Entry("PhaseIncrement", PhaseIncrement(RADAR), (*NOTHING, *SCENES, ALIASED), BASEBAND),
        Entry("EnergyCentre", EnergyCentre(RADAR), (*NOTHING, *SCENES, ALIASED), BASEBAND),
        Entry(
            "DopplerCentroid:squinted",
            DopplerCentroid(SQUINTED),
            [World("own", strip(snr_db=snr, radar=SQUINTED), snr) for snr in (-10.0, 10.0)],
            [Quantity("doppler_hz", DOPPLER_HZ, floor=0.5)],
        ),
        Entry(
            "DopplerCentroid:fast",
            DopplerCentroid(FAST),
            [
                World("own", strip(lambda: RandomPoints(24, 2500.0, 60.0), snr, FAST, 1024, 512), snr)
                for snr in (-10.0, 10.0)
            ],
            [Quantity("doppler_hz", 0.25 * float(FAST.azimuth_rate_hz_s(700e3, 7000.0)) * 0.1, floor=0.5)],
        ),
        Entry("PointDoppler", PointDoppler(FAST), POINT_WORLDS, [Quantity("doppler_hz", 60.0, floor=0.5)]),
    ]


BENCH = Bench("doppler", "the Doppler centroid of a strip, or the Doppler of a point", entries)
