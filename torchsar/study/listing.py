"""`torchsar list`."""

from __future__ import annotations

import inspect
import textwrap

from torchsar.io import recorded
from torchsar.study.catalogue import Catalogue
from torchsar.study.registry import BEAMS, DAMAGES, PATHS, SCENES, group_of, stages
from torchsar.study.text import packaged_configs, read_tree


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
    for title, catalogue in (("SCENES", SCENES), ("BEAMS", BEAMS), ("PATHS", PATHS), ("DAMAGES", DAMAGES)):
        if catalogue.entries:
            parts += ["", title] + [_line(catalogue, name) for name in catalogue.entries]
    schema = inspect.cleandoc(recorded.read_stripmap.__doc__ or "").split("\n\n")[1]
    return "\n".join([*parts, "", "DATA (data.file=PATH, a numpy archive)", textwrap.indent(schema, "  ")])


def _line(catalogue: Catalogue, name: str) -> str:
    keys = []
    for key, field in catalogue.model(name).model_fields.items():
        keys.append(key if field.is_required() else f"{key}={_short(field.default)}")
    about = (inspect.getdoc(catalogue.entries[name]) or "").split("\n")[0].replace("`", "")
    return f"  {name:<25}{about}\n  {'':<25}  keys: {', '.join(keys) or 'none'}"


def _short(value: object) -> str:
    return {None: "null", True: "true", False: "false"}.get(value, str(value)) if isinstance(value, (bool, type(None))) else str(value)
