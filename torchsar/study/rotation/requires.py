"""`torchsar requires` for targets that turn unevenly: limits of their estimators, and what the
scene requires of its model.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement
from torchsar.focus.rotation_requirements import least_order, rotation_limits, rotation_requirements
from torchsar.metrics.rotation_bounds import rotation_bounds
from torchsar.study.cases import refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.limits import heed, limit_lines, limit_rows, requirement_lines, requirement_rows, write_needs
from torchsar.study.registry import stages
from torchsar.study.rotation.build import Turntable, check
from torchsar.study.rotation.sections import RotationConfig
from torchsar.study.rotation.trials import true_k
from torchsar.study.settings.errors import ConfigError

log = logging.getLogger("torchsar")
# limits that stop only methods which estimate something
_OF_ESTIMATORS = {"scatterers above the noise": "warp_k", "range term, pi lambda sigma_y / ra^2": "omega_rad_s"}


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
    assert isinstance(config, RotationConfig)
    names = [name for name in config.processor if name not in config.beyond_limits]
    estimated = _OF_ESTIMATORS.get(limit.name)
    return names if estimated is None else [name for name in names if estimated in _estimated(loaded, name)]


def _estimated(loaded: Loaded, name: str) -> set[str]:
    """Values that the stages of a method estimate."""
    radar, found = Turntable.of(loaded).radar, set()
    for stage, entry in (loaded.config.processor[name].stages or {}).items():
        made = stages().make(
            {key: value for key, value in entry.items() if key != "uses"},
            f"processor.{name}.stages.{stage}",
            loaded.file,
            radar=radar,
        )
        found |= set(getattr(made, "provides", ()))
    return found


@dataclass(frozen=True)
class Needs:
    """Limits and fidelity rows of one case."""

    limits: tuple[Limit, ...]
    rows: tuple[Requirement, ...]

    @staticmethod
    def of(loaded: Loaded) -> Needs:
        """Predicted from the first trial of a run. Raises ConfigError for what the world
        refuses.
        """
        try:
            return _needs(Turntable.of(loaded), loaded.config.seed)
        except ValueError as error:
            raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from None

    def tree(self) -> dict[str, object]:
        return {
            "limits": limit_rows(self.limits),
            "order": least_order(self.rows),
            "fidelity": self.fidelity,
            "requirements": requirement_rows(self.rows),
        }

    def text(self, name: str) -> str:
        order = least_order(self.rows)
        simplest = (
            "the simplest model that this scene allows: order "
            f"{order}{'' if order <= 4 else ' or more'}, {self.fidelity}"
        )
        return "\n".join([name, *limit_lines(self.limits), "", *requirement_lines(self.rows), simplest])

    @property
    def fidelity(self) -> str:
        """The simplest echo model that the scene allows."""
        return (
            "phase_only"
            if next(row for row in self.rows if row.effect.startswith("fixed envelopes")).ok
            else "dechirped"
        )


def _needs(table: Turntable, seed: int) -> Needs:
    scene = table.world.scene.scatterers(Draws(seed, "run", [0]))
    x, y, amplitude = (v.reshape(-1, v.shape[-1])[0] for v in (scene.azimuth_m, scene.range_m, scene.amplitude))
    yc, omega, k = float(table.world.centre_deviation_m), float(table.rotation.omega_rad_s), true_k(table)
    noise_std = _noise_std(table, amplitude)
    bound = _rate_bound(table, x, y, amplitude, noise_std) if noise_std > 0 else None
    limits = rotation_limits(table.radar, table.pulses, omega, k, x, y + yc, amplitude, noise_std, bound)
    rows = rotation_requirements(table.radar, table.pulses, omega, k, float(x.abs().max()), float((y + yc).abs().max()))
    return Needs(limits, rows)


def _noise_std(table: Turntable, amplitude: Tensor) -> float:
    """Of the noise of a sample, from the mean power of scatterers spread over the range cells."""
    snr_db = table.world.snr_db
    return (
        0.0
        if snr_db is None
        else math.sqrt(float(amplitude.abs().square().sum()) / table.samples) * 10 ** (-float(snr_db) / 20)
    )


def _rate_bound(table: Turntable, x: Tensor, y: Tensor, amplitude: Tensor, noise_std: float) -> float:
    """The centre known: with a free one it is larger where the ranges are few."""
    k = torch.tensor(true_k(table), dtype=torch.float64)
    told = {
        "wavelength_m": table.radar.wavelength_m,
        "prf_hz": table.radar.prf_hz,
        "n_pulse": table.pulses,
        "free_centre": False,
    }
    return float(
        rotation_bounds(
            x,
            y,
            amplitude,
            noise_std,
            float(table.rotation.omega_rad_s),
            k,
            float(table.world.centre_deviation_m),
            **told,
        )["omega_rad_s"]
    )
