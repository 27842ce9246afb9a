"""Stages whose constructors take other objects, as functions of plain keys."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.velocity import EffectiveVelocity
from torchsar.focus import OmegaK
from torchsar.optim.scalar import gradient_minimum, parabola_minimum
from torchsar.radar import StripmapRadar
from torchsar.repair.jitter import BandLimited, CorrectJitter, Exact, Lagrange

_REFINE = {"gradient": gradient_minimum, "parabola": parabola_minimum}


def effective_velocity(
    radar: StripmapRadar,
    reference: Literal["matched", "flat"] | None = "matched",
    reach_m_s: float = 80.0,
    lines: int = 512,
    refine: Literal["gradient", "parabola"] = "gradient",
    tolerance_m_s: float = 0.01,
) -> EffectiveVelocity:
    """Minimum-entropy velocity of range lines that are compressed with `reference` (None: compressed already)."""
    return EffectiveVelocity(OmegaK(radar, reference), reach_m_s, lines, _REFINE[refine], tolerance_m_s)


def jitter_lagrange(points: int = 4, offset_samples: list[float] | None = None) -> CorrectJitter:
    """Jitter correction by Lagrange interpolation through this many points."""
    return CorrectJitter(_tensor(offset_samples), Lagrange(points))


def jitter_band_limited(points: int = 8, band: float = 0.95, offset_samples: list[float] | None = None) -> CorrectJitter:
    """Jitter correction by the best local weights for a signal of this band."""
    return CorrectJitter(_tensor(offset_samples), BandLimited(points, band))


def jitter_exact(offset_samples: list[float] | None = None) -> CorrectJitter:
    """Jitter correction by exact periodic non-uniform reconstruction."""
    return CorrectJitter(_tensor(offset_samples), Exact())


def _tensor(values: list[float] | None) -> Tensor | None:
    return None if values is None else torch.tensor(values, dtype=torch.float64)
