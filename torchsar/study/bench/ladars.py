"""Estimators of the radial motion of a triangular ladar's target."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchsar.compensate import (
    MirrorProduct,
    MlPeak,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
)
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_ladar
from torchsar.radar import LIGHT_M_S, TriangularLadar
from torchsar.scene import LadarWorld, LetterE, Points, Polynomial, Scene, Sinusoid, Speckle
from torchsar.study.bench.direct.triangular import Ladar
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World, rms
from torchsar.study.bench.nothing import nothing

F64 = torch.float64
# settings of the scenes and methods, by choice
PERIODS = 96
RADAR = TriangularLadar(LIGHT_M_S / 1.55e-6, 5e9, 16e-6, 16e6, 60.0, 3000.0)
MOTION = (Polynomial([0.3, 20.0]), Sinusoid(3e-6, 2000.0, 20.0))
FASTER = (Polynomial([0.3, 20.0]), Sinusoid(60e-6, 3000.0, 20.0))


def own(
    scene: Scene | None = None, snr_db: float | None = 10.0, motion=MOTION, gate: bool = False
) -> Callable[[int, int], Batch]:
    """Draw sweeps of a scene in radial motion with our own simulator."""

    def draw(trials: int, seed: int) -> Batch:
        scatterers = scene or Points([0.0, 0.03, -0.05], [0.4, 0.9, 1.3], [1.0, 0.7, 0.5], random_phase=True)
        world = LadarWorld(scatterers, motion=motion, snr_db=snr_db)
        recording, truth = simulate_ladar(RADAR, world, PERIODS, Draws(seed, trials=range(trials)))
        return Batch(recording.signal, {"velocity_m_s": truth.values["velocity_m_s"].expand(trials, PERIODS)})

    return draw


def emitted(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw sweeps of six random points by an independent generator."""
    ladar = Ladar(RADAR.carrier_hz, sampling_hz=RADAR.sample_rate_hz, parts=2)
    start = RADAR.sweep_axes(PERIODS)[1].start
    turning = (torch.arange(PERIODS, dtype=F64) + 0.5) * RADAR.pulse_step_s
    speed = 0.3 + 20 * turning + 12e-3 * torch.pi * torch.cos(2 * torch.pi * 2000 * turning + 0.3)

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        x, y = draws.uniform("x", (6,), -0.08, 0.08), draws.uniform("y", (6,), 0.3, 1.5)
        level = draws.normal("level", (6,), torch.complex128)
        power = level.abs().square()
        x = x - (power * x).sum(-1, keepdim=True) / power.sum(-1, keepdim=True)  # velocities are those of its centre
        clean = torch.stack(
            [ladar.sweeps(*one, PERIODS, lambda t: swing(t - start)) for one in zip(x, y, level, strict=True)]
        )
        noise = draws.normal("noise", tuple(clean.shape[1:]), torch.complex128)
        power = clean.abs().square().mean((-3, -2, -1), keepdim=True)
        data = clean + noise * (power * 10 ** (-snr_db / 10)).sqrt()
        return Batch(signal(data), {"velocity_m_s": speed.expand(trials, -1)})

    return draw


def swing(t: Tensor) -> Tensor:
    """Radial motion in metres."""
    return 0.3 * t + 10 * t.square() + 3e-6 * torch.sin(2 * torch.pi * 2000 * t + 0.3)


def signal(x: Tensor) -> Signal:
    """Sweeps with the axes of the ladar."""
    return Signal(x.to(torch.complex64), RADAR.sweep_axes(PERIODS))


def slow(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of the velocity in m/s."""
    return rms(found - truth)


# tolerances of use
JUDGED = [Quantity("velocity_m_s", 0.01, slow, 1e-5)]
WORLDS = (
    *nothing((2, PERIODS, RADAR.sweep_samples), signal),
    *(World("own", own(snr_db=snr), snr) for snr in SNR_DB),
    World("clutter", own(Speckle(300, 0.1, 1.2, range_m=0.9)), 10.0),
    World("one point", own(Points([0.0], [0.4], random_phase=True)), 10.0),
    World("letter", own(LetterE(spine_azimuth_m=-45 * 0.08 / 62)), 10.0),  # velocities are those of its centre
    World("aliased", own(motion=FASTER), 10.0),
    *(World("direct", emitted(snr), snr) for snr in (-10.0, 10.0)),
)


def entries() -> list[Entry]:
    """Entries of the radial-motion estimators."""
    stages = {
        "SegmentedInterference": SegmentedInterference(RADAR),
        "SegmentedInterference:sum": SegmentedInterference(RADAR, "sum", "per_pulse"),
        "MirrorProduct": MirrorProduct(RADAR),
        "MlPeak": MlPeak(RADAR),
        "SpectrumCorrelation": SpectrumCorrelation(RADAR),
        "RadialMotion": RadialMotion(RADAR),
    }
    return [*(Entry(f"{name}", stage, WORLDS, JUDGED) for name, stage in stages.items())]


BENCH = Bench("radial", "radial motion seen by a triangular ladar", entries)
