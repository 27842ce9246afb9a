"""`torchsar list`."""

from __future__ import annotations

import inspect
import textwrap

from torchsar.io import inverse, recorded
from torchsar.study.catalogue import Catalogue
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.registry import (
    BEAMS,
    CALIBRATIONS,
    FIDELITIES,
    GATES,
    IMPAIRMENTS,
    LOG_AMPLITUDES,
    MOTIONS,
    MULTICHANNEL_IMPAIRMENTS,
    PATHS,
    RADIAL_MOTIONS,
    RECEIVE_RANGES,
    SCENES,
    SEAS,
    START_PHASES,
    SWEEP_ERRORS,
    SWEEP_FIDELITIES,
    group_of,
    stages,
)
from torchsar.study.sal.sections import LADAR_IMPAIRMENTS
from torchsar.study.settings.text import packaged_configs, read_tree

_WORLD = {
    "SCENES": SCENES,
    "BEAMS (stripmap)": BEAMS,
    "PATHS (stripmap)": PATHS,
    "MOTIONS (isal)": MOTIONS,
    "START PHASES (isal)": START_PHASES,
    "FIDELITIES (isal)": FIDELITIES,
    "MOTIONS (sal)": RADIAL_MOTIONS,
    "LOG-AMPLITUDES (sal)": LOG_AMPLITUDES,
    "FIDELITIES (sal)": SWEEP_FIDELITIES,
    "SWEEP ERRORS (sal)": SWEEP_ERRORS,
    "CALIBRATIONS (sal)": CALIBRATIONS,
    "GATES (geo)": GATES,
    "SEAS (geo)": SEAS,
    "RECEIVE RANGES (geo)": RECEIVE_RANGES,
    "IMPAIRMENTS (stripmap)": IMPAIRMENTS,
    "IMPAIRMENTS (isal)": TARGET_IMPAIRMENTS,
    "IMPAIRMENTS (sal)": LADAR_IMPAIRMENTS,
    "IMPAIRMENTS (geo)": MULTICHANNEL_IMPAIRMENTS,
}


def listing() -> str:
    """Experiments, stages and world objects with their keys, and the keys of data files."""
    parts = ["EXPERIMENTS (torchsar run NAME; those marked [sweep] are for torchsar sweep NAME)"]
    for name, path in packaged_configs().items():
        tree = read_tree(path)
        parts.append(f"  {name:<25}{tree.get('title', '')}{' [sweep]' if 'sweep' in tree else ''}")
    for group in ("repair", "compensate", "focus", "own"):
        names = [name for name in stages().entries if group_of(name) == group]
        if names:
            parts += ["", f"STAGES, {group}"] + [_line(stages(), name) for name in names]
    for title, catalogue in _WORLD.items():
        if catalogue.entries:
            parts += ["", title] + [_line(catalogue, name) for name in catalogue.entries]
    parts += ["", "DATA (data.file=PATH, a numpy archive)"]
    for system, reader in (("stripmap", recorded.read_stripmap), ("isal", inverse.read_inverse)):
        schema = inspect.cleandoc(reader.__doc__ or "").split("\n\n")[1]
        parts += [f"  system {system}", textwrap.indent(schema, "    ")]
    return "\n".join(parts)


def _line(catalogue: Catalogue, name: str) -> str:
    keys = []
    for key, field in catalogue.model(name).model_fields.items():
        keys.append(key if field.is_required() else f"{key}={_short(field.default)}")
    about = (inspect.getdoc(catalogue.entries[name]) or "").split("\n")[0].replace("`", "")
    return f"  {name:<25}{about}\n  {'':<25}  keys: {', '.join(keys) or 'none'}"


def _short(value: object) -> str:
    return (
        {None: "null", True: "true", False: "false"}.get(value, str(value))
        if isinstance(value, (bool, type(None)))
        else str(value)
    )
