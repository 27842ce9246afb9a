"""Step 1 of Remote Sens. 2024, 16, 793: isolation of one scatterer before estimation.

A coarse image is formed with the motion that inaccurate sensors record. One scatterer is isolated
in it in range and azimuth, and its echo is restored for the estimate of the motion.

The paper shows no result of this step. Here it is compared with the gate in range that the other
items use, for points at three ranges and for points in one range cell. It lowers the errors of the
velocities. The remaining phase error is the integral of slow velocity errors, which the isolation
does not remove.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from torchsar.compensate import CompensateMotion, SegmentedInterference
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_ladar
from torchsar.radar import TriangularLadar
from torchsar.reproduce.item import Check, Item, seeds_of, statement
from torchsar.reproduce.sal.points import MOTION, RADAR, SCENE
from torchsar.scene import LadarWorld, Points, QuadraticInSweep
from torchsar.study.systems.sal.judge import Course

SCENES = {"three ranges": SCENE, "one range cell": Points([-0.15, 0.0, 0.15], [1.5] * 3, [0.7, 1.0, 0.7])}
Errors = dict[tuple[str, float, str], list[tuple[float, float]]]


def isolate(
    sweeps: Signal,
    radar: TriangularLadar,
    ranges_m: tuple[float, float],
    near_m: float = 0.3,
    near_hz: float = 1500.0,
) -> Signal:
    """Keep the strongest scatterer of sweeps whose motion is compensated coarsely.

    Args:
        sweeps: Sweeps (ramp, pulse, fast_time), without the velocity that sensors recorded and that
            of the flight past the scatterer.
        radar: Parameters of the ladar.
        ranges_m: Lowest and highest relative range in metres in which it lies.
        near_m: Half width in range of what is kept about it, in metres.
        near_hz: Half width in Doppler of what is kept, in Hz.

    Returns:
        Sweeps of this scatterer.
    """
    _, pulse, fast = sweeps.axes
    image = torch.fft.fft2(sweeps.data)
    beat_m = radar.range_step_m * fast.n * torch.fft.fftfreq(fast.n, dtype=torch.float64)
    range_m = torch.stack([beat_m, -beat_m])[:, None, :]
    doppler_hz = torch.fft.fftfreq(pulse.n, pulse.step, dtype=torch.float64)[:, None]
    inside = (range_m >= ranges_m[0]) & (range_m <= ranges_m[1])
    peak = torch.where(inside, image.abs(), 0).flatten(1).argmax(-1)[:, None, None]
    at_m, at_hz = range_m.gather(-1, peak % fast.n), doppler_hz[peak // fast.n, 0]
    kept = torch.where(((range_m - at_m).abs() <= near_m) & ((doppler_hz - at_hz).abs() <= near_hz), image, 0)
    return sweeps.with_data(torch.fft.ifft2(kept))


def _errors(small: bool, snrs_db: Sequence[float] = (-10.0, 0.0, 20.0), scale: float = 0.99) -> Errors:
    """Rms errors of the velocity (m/s) and residual phases (rad) of all draws.

    The keys are scene, SNR per sample before compression, and method. By choice, the velocity that
    the sensors record is the true one times `scale`, plus 2 mm/s.
    """
    found: Errors = {}
    ranges_m = (1.2, 1.8)  # range gate around the strongest point
    for scene, snr_db, seed in itertools.product(SCENES, snrs_db, seeds_of(small)):
        world = LadarWorld(SCENES[scene], MOTION, snr_db=snr_db, fidelity=QuadraticInSweep())
        recording, truth = simulate_ladar(RADAR, world, 512, Draws(seed))
        sweeps, true = recording.signal, truth.values["velocity_m_s"]
        estimator = SegmentedInterference(RADAR, window_m=ranges_m, assess=False)
        sensors = scale * true + 2e-3
        coarse = sensors + geometric_velocity_m_s(RADAR, sweeps.axis("pulse"))
        alone = isolate(CompensateMotion(RADAR)(sweeps, coarse), RADAR, ranges_m)
        methods = {
            "gate in range": estimator(sweeps)["velocity_m_s"],
            "isolated": coarse + estimator(alone)["velocity_m_s"],
        }
        for method, velocity in methods.items():
            found.setdefault((scene, snr_db, method), []).append(_left(velocity - true))
    return found


def _left(error_m_s: Tensor) -> tuple[float, float]:
    """Rms of a velocity error (m/s), and rms of the residual phase (rad) that it causes."""
    pulse = RADAR.sweep_axes(len(error_m_s))[1]
    error_m = RADAR.period_s * error_m_s.cumsum(-1)
    lit = torch.ones_like(error_m, dtype=torch.bool)
    course = Course(pulse, error_m_s, error_m_s, error_m, error_m, lit)
    return float(course.rms(error_m_s)), float(course.metrics(RADAR)["residual_phase_rms_rad"])


def _text_4(found: Errors, path: Path) -> list[Check]:
    checks = []
    for scene in SCENES:
        rows = {
            (snr_db, method): torch.tensor(draws, dtype=torch.float64).square().mean(0).sqrt()
            for (of, snr_db, method), draws in found.items()
            if of == scene
        }
        gate, isolated = (
            {snr_db: row for (snr_db, of), row in rows.items() if of == method}
            for method in ("gate in range", "isolated")
        )
        ours = "; ".join(
            f"{snr_db:g} dB: {1e3 * float(gate[snr_db][0]):.2f} mm/s and {float(gate[snr_db][1]):.2f} rad by the gate, "
            f"{1e3 * float(row[0]):.2f} mm/s and {float(row[1]):.2f} rad isolated"
            for snr_db, row in isolated.items()
        )
        better = all(float(row[0]) < float(gate[snr_db][0]) for snr_db, row in isolated.items())
        claim, draws = "holds the echo of the scatterer and little of the background", len(next(iter(found.values())))
        checks.append(statement(f"velocity and residual phase, {scene}", claim, better, ours, draws))
    return checks


ITEMS = (Item("Text 4", "scatterers isolated in a coarse image (section 2.4, step 1)", _errors, _text_4),)
