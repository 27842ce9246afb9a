"""`torchsar list`: experiments, systems, stages and world objects with their keys, data files."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Mapping

from torchsar.io import inverse, recorded
from torchsar.study.names.registry import GROUPS, WORLD, group_of, stages
from torchsar.study.settings.signature import Catalogue, Section
from torchsar.study.settings.text import packaged_configs, read_tree
from torchsar.study.trials.system import System


def listing(systems: Mapping[str, System]) -> str:
    """The whole list as text."""
    parts = ["EXPERIMENTS (torchsar run NAME; those marked [sweep] are for torchsar sweep NAME)"]
    for name, path in packaged_configs().items():
        tree = read_tree(path)
        parts.append(f"  {name:<25}{tree.get('title', '')}{' [sweep]' if 'sweep' in tree else ''}")
    parts += ["", "SYSTEMS (the key system of a config; keys marked * may differ from trial to trial)"]
    for name, system in systems.items():
        parts.append(f"  {name:<25}{system.about}")
        parts += [f"  {'':<25}  {section}: {_keys(keys)}" for section, keys in system.sections.items()]
        own = [stage for stage in system.stages.entries if stage not in stages().entries]
        parts += [f"  {'':<25}  stage {stage}: {_keys(system.stages.sections[stage])}" for stage in own]
    for group in (*GROUPS, "own"):
        names = [name for name in stages().entries if group_of(name) == group]
        parts += ["", f"STAGES, {group}", *(_line(stages(), name) for name in names)] if names else []
    for title, catalogue in WORLD.items():
        parts += ["", title, *(_line(catalogue, name) for name in catalogue.entries)]
    parts += ["", "DATA (data.file=PATH, a numpy archive)"]
    for name, reader in (("stripmap", recorded.read_stripmap), ("isal", inverse.read_inverse)):
        schema = "\n".join(inspect.cleandoc(reader.__doc__ or "").split("\n\n")[1:])
        parts += [f"  system {name}", textwrap.indent(schema, "    ")]
    return "\n".join(parts)


def _line(catalogue: Catalogue, name: str) -> str:
    about = (inspect.getdoc(catalogue.entries[name]) or "").split("\n\n")[0].replace("`", "").replace("\n", " ")
    return f"  {name:<25}{about}\n  {'':<25}  keys: {_keys(catalogue.sections[name])}"


def _keys(section: Section) -> str:
    keys = []
    for name, key in section.keys.items():
        shown = f"{name}*" if key.per_trial else name
        keys.append(shown if key.default is ... else f"{shown}={_short(key.default)}")
    return ", ".join(keys) or "none"


def _short(value: object) -> str:
    return {None: "null", True: "true", False: "false"}[value] if isinstance(value, bool | None) else str(value)
