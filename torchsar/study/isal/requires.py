"""`torchsar requires` for turning targets: what the scene requires of its echo model and its
processor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from torchsar.core import Draws
from torchsar.focus.inverse_requirements import inverse_requirements
from torchsar.focus.requirements import Requirement
from torchsar.scene import Sinusoid, displacement_m
from torchsar.study.case_run import write_requirements
from torchsar.study.cases import cases_of
from torchsar.study.config import Loaded
from torchsar.study.isal.build import build_radar, build_world, check
from torchsar.study.limits import requirement_lines
from torchsar.study.settings.errors import ConfigError

_SAMPLING = ("vibration followed by pulses", "cross range unambiguous", "range unambiguous")


def requires(loaded: Loaded, out: Path | None) -> str:
    """The table of simplifications of every case of a simulation, as text: phase neglected, range
    cells, verdict.

    Predicted from the config alone: the extents of the scene, and the largest velocity and
    acceleration of its motion. With `out`: config.yaml, requires.json and requires.txt in that
    folder. Raises ConfigError for recordings, of which neither is known.
    """
    if loaded.config.data.file is not None or loaded.config.world is None:
        raise ConfigError(
            f"{loaded.file}: requires predicts what a simulation needs; of a recording neither "
            "the extents of the target nor its motion are known"
        )
    check(loaded)

    def find() -> tuple[str, dict[str, object]]:
        tables = {name or loaded.name: _rows(case) for name, case in cases_of(loaded).items()}
        text = "\n\n".join(_text(name, rows) for name, rows in tables.items())
        return text, {
            name: {"fidelity": fidelity_for(rows), "requirements": [asdict(row) for row in rows]}
            for name, rows in tables.items()
        }

    return write_requirements(loaded, out, find)


def _rows(loaded: Loaded) -> Sequence[Requirement]:
    radar, world, size = build_radar(loaded), build_world(loaded), loaded.config.world
    places = world.scene.scatterers(Draws(loaded.config.seed))
    time_s = torch.arange(4 * size.pulses, dtype=torch.float64) / (4 * radar.prf_hz)
    moved = displacement_m(world.motion, time_s)
    speed, acceleration = (
        float(x.abs().max()) for x in (torch.gradient(moved, spacing=(time_s,))[0], _second(moved, time_s))
    )
    across, along = (2 * float(x.abs().max()) for x in (places.azimuth_m, places.range_m))
    rate = None if world.rotation_rad_s is None else float(torch.as_tensor(world.rotation_rad_s).abs().max())
    vibrations = [
        (float(part.amplitude_m), float(part.frequency_hz)) for part in world.motion if isinstance(part, Sinusoid)
    ]
    steady = not vibrations
    if radar.rotation_rad_s is None and rate is None:
        raise ConfigError(
            f"{loaded.file}: neither radar.rotation_rad_s nor world.rotation_rad_s is set; what a "
            "turning target requires depends on its rotation"
        )
    return inverse_requirements(
        radar,
        size.pulses,
        size.samples,
        max(across, 1e-9),
        max(along, 1e-9),
        speed if steady else 0.0,
        acceleration if steady else 0.0,
        vibrations,
        rate,
    )


def _second(moved: torch.Tensor, time_s: torch.Tensor) -> torch.Tensor:
    return torch.gradient(torch.gradient(moved, spacing=(time_s,))[0], spacing=(time_s,))[0]


def fidelity_for(rows: Sequence[Requirement]) -> str:
    """The simplest echo model that the scene allows: sampling too coarse for it is no matter of the
    model.
    """
    return "phase_only" if all(row.ok for row in rows if row.effect not in _SAMPLING) else "dechirped"


def _text(name: str, rows: Sequence[Requirement]) -> str:
    return "\n".join(
        [name, *requirement_lines(rows), f"the simplest echo model that this scene allows: {fidelity_for(rows)}"]
    )
