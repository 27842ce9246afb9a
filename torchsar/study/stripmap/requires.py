"""`torchsar requires`: what the scene of a config requires of its models."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

from torchsar.focus.requirements import Requirement, recommended_form, requirements
from torchsar.study.case_run import write_requirements
from torchsar.study.config import Loaded
from torchsar.study.methods import run_recommended
from torchsar.study.stripmap.build import build_case, build_radar, true_doppler_hz
from torchsar.study.stripmap.run import check


def requires(loaded: Loaded, out: Path | None) -> str:
    """The table of simplifications with the phase that each would neglect, as text.

    Of a simulation it is predicted from the config alone; of a recording, Doppler and velocity are
    found by the recommended method first.

    With `out`: config.yaml, requires.json and requires.txt in that folder.
    """

    def find() -> tuple[str, dict[str, object]]:
        rows, notes = _rows(loaded)
        return _text(rows, notes), {
            "focuser": recommended_form(tuple(rows)),
            "warnings": notes,
            "requirements": [_plain(row) for row in rows],
        }

    return write_requirements(loaded, out, find)


def _rows(loaded: Loaded) -> tuple[Sequence[Requirement], list[str]]:
    """The table, and the warnings that came up."""
    world = loaded.config.world
    if loaded.config.data.file is not None:
        case = build_case(loaded)
        used = run_recommended(loaded, case).used
        radar, axes, doppler, velocity = (
            case.recording.radar,
            case.recording.signal.axes,
            used.get("doppler_hz"),
            used.get("velocity_m_s"),
        )
    else:
        check(loaded)
        assert world is not None
        radar = build_radar(loaded)
        axes, doppler, velocity = (
            radar.raw_axes(world.lines, world.samples),
            true_doppler_hz(loaded),
            world.velocity_m_s,
        )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        rows = requirements(radar, axes, doppler, velocity)
    return rows, [str(w.message) for w in caught]


def _plain(row: Requirement) -> dict[str, object]:
    return {
        "effect": row.effect,
        "neglects": row.neglects,
        "phase_rad": row.phase_rad,
        "range_cells": row.range_cells,
        "tolerance_rad": row.tolerance_rad,
        "ok": row.ok,
        "verdict": row.verdict,
    }


def _text(rows: Sequence[Requirement], notes: Sequence[str]) -> str:
    lines = [f"{'simplification':<27}{'neglected phase':>16}{'range cells':>13}  {'verdict':<48}neglects"]
    for row in rows:
        cells = "" if math.isnan(row.range_cells) else f"{row.range_cells:.3g}"
        lines.append(f"{row.effect:<27}{row.phase_rad:>12.3g} rad{cells:>13}  {row.verdict:<48}{row.neglects}")
    lines.append(
        f"tolerance {rows[0].tolerance_rad:.3g} rad; the cheapest focuser that this scene "
        f"allows: {recommended_form(tuple(rows))}"
    )
    return "\n".join([*lines, *(f"warning: {note}" for note in notes)])
