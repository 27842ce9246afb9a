"""Common parts of the tests of radial motion: ladars, motions, estimators by name, errors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from tests.echo.ladars import COMMON
from torchsar.compensate import (
    mirror_product,
    ml_peak,
    radial_motion,
    range_error,
    segmented_interference,
    spectrum_correlation,
)
from torchsar.core import Axis, Draws, Estimate, Truth
from torchsar.echo import simulate_ladar
from torchsar.radar import TriangularLadar, sweep_middles
from torchsar.scene import EverySample, LadarWorld, Points
from torchsar.study.bench.direct.triangles import table1

ESTIMATORS: dict[str, Callable[..., Estimate]] = {
    "segmented": segmented_interference,
    "segmented_sum": partial(segmented_interference, bins="sum", unwrap="per_pulse"),
    "correlation": spectrum_correlation,
    "peak": ml_peak,
    "mirror": mirror_product,
    "mirror_free": partial(mirror_product, intercept="free"),
    "mirror_record": partial(mirror_product, intercept="record"),
    "recommended": radial_motion,
}
ONE = Points([0.0], [1.5], [1.0])
GATE = (0.9, 2.1)  # 40 cells about the one point


def seen(
    radar: TriangularLadar | None = None,
    n: int = 32,
    trials: int | None = None,
    scene=ONE,
    motion=COMMON,
    snr_db=None,
    dtype=torch.complex128,
    fidelity=None,
    seed=1,
) -> tuple[Tensor, Axis, Truth]:
    """Simulate a world; the range is evaluated at every sample unless `fidelity` is given.

    Returns:
        The sweeps, the axis of the periods and the truth.
    """
    radar = table1() if radar is None else radar
    world = LadarWorld(scene, motion=motion, snr_db=snr_db, fidelity=EverySample() if fidelity is None else fidelity)
    recording, truth = simulate_ladar(
        radar, world, n, Draws(seed, trials=None if trials is None else range(trials)), dtype=dtype
    )
    return recording.signal.data, recording.signal.axis("pulse"), truth


def rms(x: Tensor) -> Tensor:
    """Compute the root mean square over the last dimension."""
    return x.square().mean(-1).sqrt()


def velocity_rms(estimate: Estimate, truth: Truth) -> Tensor:
    """Compute the rms error of the radial velocity in m/s."""
    return rms(estimate["velocity_m_s"] - truth.values["velocity_m_s"])


def without_line(x: Tensor) -> Tensor:
    """Subtract the straight line fitted by least squares along the last dimension."""
    k = torch.arange(x.shape[-1], dtype=torch.float64) - (x.shape[-1] - 1) / 2
    x = x - x.mean(-1, keepdim=True)
    return x - (x * k).sum(-1, keepdim=True) / k.square().sum() * k


def range_rms(estimate: Estimate, truth: Truth, radar: TriangularLadar, pulse: Axis) -> Tensor:
    """Compute the detrended rms error of the range in metres, at the middles of the up sweeps."""
    found = range_error(estimate, radar, pulse, sweep_middles(radar, pulse)[0])
    return rms(without_line(found - truth.values["range_error_up_m"]))
