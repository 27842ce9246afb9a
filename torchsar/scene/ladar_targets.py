"""Targets of the ladar experiments (brief 000, section 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchsar.core import Draws
from torchsar.scene.targets import Scatterers
from torchsar.scene.vibration import refuse_unless_finite


@dataclass(frozen=True)
class LetterE:
    """A letter E of 62 points of amplitude 1: a spine of 17 along range, 5 cm apart, and arms of 15
    along azimuth, 1 cm apart, at spine points 0, 8, 16.

    The arms begin 1 cm beside the spine, towards positive azimuth. first_range_m: range of the
    spine's first point; spine_azimuth_m: azimuth of the spine. random_phase=False gives all points
    the same phase, which makes entropy prefer wrong images (brief 000, section 7).
    """

    first_range_m: float = -0.4
    spine_azimuth_m: float = -0.075
    random_phase: bool = True

    def __post_init__(self) -> None:
        refuse_unless_finite("first_range_m of a letter", self.first_range_m)
        refuse_unless_finite("spine_azimuth_m of a letter", self.spine_azimuth_m)

    def scatterers(self, draws: Draws) -> Scatterers:
        spine, along = torch.arange(17, dtype=torch.float64), torch.arange(1, 16, dtype=torch.float64)
        azimuth = torch.cat([torch.zeros(17, dtype=torch.float64), along, along, along])
        row = torch.cat([spine, *(torch.full((15,), float(at), dtype=torch.float64) for at in (0, 8, 16))])
        turns = (
            draws.uniform("scene.letter.phase", (62,)) if self.random_phase else torch.zeros(62, dtype=torch.float64)
        )
        return Scatterers(
            self.spine_azimuth_m + 0.01 * azimuth,
            self.first_range_m + 0.05 * row,
            torch.polar(torch.ones_like(turns), 2 * math.pi * turns),
        )


@dataclass(frozen=True)
class RetroAndBrokenLine:
    """A retro-reflector and beyond it a broken line of 9 points of random phases: the stand-in for
    the ground experiment (brief 000, section 8 C).

    The retro lies at (azimuth_m, range_m) with amplitude 10^(retro_db / 20), so that at `snr_db`
    zero it has retro_db per sample. The line runs obliquely from line_m[0] to line_m[1] beyond it
    while azimuth runs over line_azimuth_m about it, in three dashes of three points, each line_db
    relative to the retro. Layout chosen here, as the paper has none.
    """

    range_m: float = 10.5
    azimuth_m: float = 0.0
    retro_db: float = 25.0
    line_db: float = -18.0
    line_m: tuple[float, float] = (0.25, 0.55)
    line_azimuth_m: float = 0.08

    def __post_init__(self) -> None:
        for name in ("range_m", "azimuth_m", "retro_db", "line_db", "line_azimuth_m"):
            refuse_unless_finite(f"{name} of a retro-reflector with a line", getattr(self, name))
        if (
            not isinstance(self.line_m, tuple | list)
            or len(self.line_m) != 2
            or not all(math.isfinite(v) for v in self.line_m)
        ):
            raise ValueError(
                f"line_m must be the first and last distance of the line beyond the retro-reflector, got {self.line_m}"
            )

    def scatterers(self, draws: Draws) -> Scatterers:
        along = torch.tensor([0, 1, 2, 4, 5, 6, 8, 9, 10], dtype=torch.float64) / 10
        first, last = self.line_m
        zero = torch.zeros(1, dtype=torch.float64)
        azimuth = self.azimuth_m + torch.cat([zero, self.line_azimuth_m * (along - 0.5)])
        reach = self.range_m + torch.cat([zero, first + (last - first) * along])
        turns = draws.uniform("scene.broken_line.phase", (9,))
        level = 10 ** (self.retro_db / 20)
        line = level * 10 ** (self.line_db / 20) * torch.polar(torch.ones_like(turns), 2 * math.pi * turns)
        return Scatterers(azimuth, reach, torch.cat([torch.full_like(line[..., :1], level), line], -1))
