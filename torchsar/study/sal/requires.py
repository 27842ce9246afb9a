"""`torchsar requires` for triangular-sweep ladars: limits of their estimators, and what the scene
requires of echo and compensation.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.focus.ladar_requirements import Limit, ladar_limits, ladar_requirements
from torchsar.focus.requirements import Requirement
from torchsar.radar import TriangularLadar
from torchsar.scene import Extremes, Fidelity, LinearInSweep, QuadraticInSweep, drawn_motion
from torchsar.scene.vibration import displacement_m
from torchsar.study.cases import refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.limits import heed, limit_lines, limit_rows, requirement_lines, requirement_rows, write_needs
from torchsar.study.sal.build import Ladar, check
from torchsar.study.sal.judge import leading, lit_periods
from torchsar.study.sal.sections import SalConfig
from torchsar.study.settings.errors import ConfigError

log = logging.getLogger("torchsar")
_TIMES_A_PERIOD, _MOST_TIMES = 16, 1 << 22
_TOLERANCE_RAD = 0.1
# limits that stop only methods with such a stage; key: value that it has there
_CONCERNS = {
    "SNR after compression": ("segmented_interference", "unwrap", "gradient"),
    "spacing of scatterers": ("segmented_interference", "bins", "peak"),
    "speed of the mirror tone": ("", "", ""),  # estimators take the bulk of the velocity out first
}


def requires(loaded: Loaded, out: Path | None) -> str:
    """Both tables of every case of a simulation as text, predicted from the config alone.

    With `out`: config.yaml, requires.json and requires.txt there.
    """
    refuse_recordings(loaded)
    check(loaded)
    return write_needs(loaded, out, Needs.of)


def heed_limits(loaded: Loaded, case: str) -> None:
    """Refuse or warn of what the case goes beyond, see `heed`."""
    heed(loaded, case, Needs.of(loaded).limits, lambda limit: _stopped(limit, loaded))


def _stopped(limit: Limit, loaded: Loaded) -> list[str]:
    """Methods that a limit stops and that the config does not show beyond their limits."""
    config = loaded.config
    assert isinstance(config, SalConfig)
    names = [
        name
        for name, method in config.processor.items()
        if method.input != "clean" and name not in config.beyond_limits
    ]
    if limit.name not in _CONCERNS:
        return names
    stage, key, value = _CONCERNS[limit.name]
    return [
        name
        for name in names
        if any(
            entry["stage"] == stage and entry.get(key, value) == value
            for entry in (config.processor[name].stages or {}).values()
        )
    ]


@dataclass(frozen=True)
class Needs:
    """Limits and fidelity rows of one case, and the simplest fidelity of its echo."""

    limits: tuple[Limit, ...]
    rows: tuple[Requirement, ...]
    fidelity: str

    @staticmethod
    def of(loaded: Loaded) -> Needs:
        """Predicted from the first trial of a run. Raises ConfigError for what the world
        refuses.
        """
        try:
            return _needs(Ladar.of(loaded), loaded.config.seed)
        except ValueError as error:
            raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from None

    def tree(self) -> dict[str, object]:
        return {
            "limits": limit_rows(self.limits),
            "fidelity": self.fidelity,
            "requirements": requirement_rows(self.rows),
        }

    def text(self, name: str) -> str:
        return "\n".join(
            [
                name,
                *limit_lines(self.limits),
                "",
                *requirement_lines(self.rows),
                f"the simplest echo model that this scene allows: {self.fidelity}",
            ]
        )


def _needs(ladar: Ladar, seed: int) -> Needs:
    draws, radar = Draws(seed, "run", [0]), ladar.radar
    scene = ladar.world.scene.scatterers(draws)
    azimuth, ranges, level = (
        v.reshape(-1, v.shape[-1])[0] for v in (scene.azimuth_m, scene.range_m, scene.amplitude.abs())
    )
    inside = (
        torch.ones_like(level, dtype=torch.bool)
        if ladar.world.gate_m is None
        else (ranges >= ladar.world.gate_m[0]) & (ranges <= ladar.world.gate_m[1])
    )
    inside = inside & (level > 0)
    leads = leading(torch.where(inside, level, 0))
    if not bool(leads.any()):
        raise ValueError(
            "world: no scatterer of the scene has an amplitude above 0 within the gate; give it one, or widen gate_m"
        )
    _refuse_places(radar, float(ranges[inside].min()), float(ranges[inside].max()))
    moved = _motion(ladar, draws)
    apart = torch.diff(torch.unique(ranges[leads]))
    snr_db = (
        None if ladar.world.snr_db is None else float(ladar.world.snr_db) + 20 * math.log10(float(level[leads].max()))
    )
    reach = float(ranges[inside].min()), float(ranges[inside].max())
    limits = ladar_limits(
        radar,
        ladar.periods,
        reach,
        moved.velocity_m_s,
        moved.acceleration_m_s2,
        moved.jerk_m_s3,
        snr_db,
        float(azimuth[leads].max() - azimuth[leads].min()),
        float(apart.min()) if len(apart) else None,
        _lit_share(radar, ladar.periods, azimuth[leads], ranges[leads]),
    )
    rows = ladar_requirements(
        radar, ladar.periods, reach, moved.velocity_m_s, moved.acceleration_m_s2, moved.displacement_m
    )
    across = radar.speed_m_s * ladar.periods * radar.pulse_step_s / 2 + float(azimuth.abs().max())
    extremes = Extremes(reach, across, moved.velocity_m_s, moved.change_m_s, moved.acceleration_m_s2, moved.jerk_m_s3)
    return Needs(limits, rows, simplest_fidelity(radar, extremes))


def _refuse_places(radar: TriangularLadar, near_m: float, far_m: float) -> None:
    """Raise ValueError for scatterers that no sweep can show, even at rest."""
    if near_m <= -radar.reference_range_m:
        raise ValueError(
            f"world: a scatterer at the relative range {near_m:g} m lies behind the ladar, whose "
            f"reference range is {radar.reference_range_m:g} m; ranges of scatterers are relative "
            "to it"
        )
    reach = radar.sample_rate_hz / 2 / radar.beat_hz(1.0)
    if max(-near_m, far_m) >= reach:
        raise ValueError(
            f"world: scatterers lie from {near_m:g} to {far_m:g} m, and beats of relative ranges "
            f"beyond {reach:.4g} m alias; bring the reference range nearer, or sample faster"
        )


@dataclass(frozen=True)
class _Reach:
    """Largest magnitudes of a motion over a recording."""

    displacement_m: float
    velocity_m_s: float
    change_m_s: float
    acceleration_m_s2: float
    jerk_m_s3: float


def _motion(ladar: Ladar, draws: Draws) -> _Reach:
    """Differences of the displacement on a grid of sixteen times a period, coarser in recordings of
    many gaps.
    """
    span = ladar.periods * ladar.radar.pulse_step_s
    n = min(max(8, ladar.periods * ladar.radar.keep_every * _TIMES_A_PERIOD), _MOST_TIMES)
    step = span / n
    moved = displacement_m(
        drawn_motion(ladar.world.motion, draws, span), torch.arange(n, dtype=torch.float64) * step
    ).reshape(-1, n)[0]
    slopes = [moved]
    for _ in range(3):
        slopes.append(
            torch.gradient(slopes[-1], spacing=step)[0][2:-2]
            if len(slopes) > 1
            else torch.gradient(moved, spacing=step)[0]
        )
    velocity, acceleration, jerk = slopes[1:]
    return _Reach(
        _extent(moved),
        *(
            float(x)
            for x in (velocity.abs().max(), velocity.max() - velocity.min(), acceleration.abs().max(), jerk.abs().max())
        ),
    )


def _extent(x: Tensor) -> float:
    return float(x.max() - x.min())


def _lit_share(radar: TriangularLadar, periods: int, azimuth: Tensor, ranges: Tensor) -> float:
    """Share of periods in which any leading scatterer is in the beam."""
    return float(lit_periods(radar, radar.sweep_axes(periods)[1], azimuth, ranges).to(torch.float64).mean())


def simplest_fidelity(radar: TriangularLadar, extremes: Extremes) -> str:
    """The cheapest level whose own neglected phase is below 0.1 rad; those of effects left out
    stand in the table.
    """
    ladder: tuple[tuple[str, Fidelity], ...] = (
        ("linear_in_sweep", LinearInSweep(())),
        ("quadratic_in_sweep", QuadraticInSweep(())),
    )
    for name, level in ladder:
        if level.neglected_phase_rad(radar, extremes)["level"] < _TOLERANCE_RAD:
            return name
    return "every_sample"
