"""The command `torchsar list`: prints the names that a config may use (systems, stages, scenes and
other parts of simulated worlds) with the keys of each, and the formats of data files.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable, Mapping
from typing import Any

from torchsar.io import read_inverse, read_path, read_stripmap
from torchsar.study.names.registry import GROUPS, WORLD, group_of, stages
from torchsar.study.settings.signature import Catalogue, Section
from torchsar.study.trials.system import System

# an argument in a docstring: its name is indented by four columns, its further lines by more
_ARGUMENT = re.compile(r"^ {4}((?:\w+, )*\w+): (.*(?:\n {5,}.*)*)", re.MULTILINE)


def listing(systems: Mapping[str, System]) -> str:
    """Return the text that `torchsar list` prints: systems, stages and parts of simulated worlds,
    with their keys, and the formats of data files.
    """
    lines = ["", "SYSTEMS (the key `system` of a config; a number marked * may differ from trial to trial)"]
    for name, system in systems.items():
        lines.append(f"  {name:<26}{system.about}")
        for section, keys in system.sections.items():
            lines += [f"    {section}", *_keys(keys)]
        own = [stage for stage in system.stages.entries if stage not in stages().entries]
        lines += ["    stages of its own", *(f"    {line}" for line in _entries(system.stages, own))] if own else []
    for group in (*GROUPS, "own"):
        names = [name for name in stages().entries if group_of(name) == group]
        lines += ["", f"STAGES, {group} (processor.METHOD.stages)", *_entries(stages(), names)] if names else []
    for title, catalogue in WORLD.items():
        lines += ["", title, *_entries(catalogue, catalogue.entries)]
    lines += ["", "DATA (data.file=PATH, a numpy archive; of system path also CPHD)"]
    for name, reader in (("stripmap", read_stripmap), ("isal", read_inverse), ("path", read_path)):
        parts = inspect.cleandoc(reader.__doc__ or "").split("\n\n")[1:]
        about = next(part for part in parts if not part.startswith(">>>"))
        lines += [f"  system {name}", textwrap.indent(about, "    ")]
    return "\n".join(lines)


def overview(systems: Mapping[str, System]) -> str:
    """Return the names of all systems, stages and parts of simulated worlds, without their keys."""
    lines = ["", "SYSTEMS", *(f"  {name:<24} {system.about}" for name, system in systems.items()), ""]
    named = {f"STAGES, {group}": [s for s in stages().entries if group_of(s) == group] for group in (*GROUPS, "own")}
    named |= {title: list(catalogue.entries) for title, catalogue in WORLD.items()}
    for title, names in named.items():
        text = f"{title}: {', '.join(names)}"
        lines += textwrap.wrap(text, 118, subsequent_indent="  ") if names else []
    return "\n".join(
        [*lines, "", "`torchsar list NAME` explains one of these with its keys, `torchsar list --all` every one."]
    )


def _entries(catalogue: Catalogue, names: Any) -> list[str]:
    lines = []
    for name in names:
        about = _plain((catalogue.entries[name].__doc__ or "").split("\n\n")[0])
        lines += [f"  {name:<26}{about.removeprefix('Impairment: ')}", *_keys(catalogue.sections[name])]
    return lines


def _keys(section: Section, above: str = "") -> list[str]:
    """Return a line for each key, with its default and its description from the docstring of its
    target. `NAME` stands for names that a config chooses.
    """
    described, lines = arguments(section.target), []
    for name, key in section.keys.items():
        shown = f"{above}{name}{'*' if key.per_trial else ''}"
        shown += "" if key.default is ... else f"={_short(key.default)}"
        lines.append(f"      {shown:<30} {described.get(name, '')}".rstrip())
        if isinstance(key.inner, Section):
            lines += _keys(key.inner, f"{above}{name}.{'NAME.' if key.many else ''}")
    return lines


def arguments(target: Callable[..., Any]) -> dict[str, str]:
    """The first sentence about each argument in the docstrings of a class and its bases."""
    found: dict[str, str] = {}
    docs = [getattr(one, "__doc__", None) or "" for one in reversed(getattr(target, "__mro__", (target,)))]
    for names, text in (match for doc in docs for match in _ARGUMENT.findall(inspect.cleandoc(doc))):
        sentence = re.sub(r"(?<!\.)\.$", "", re.split(r"(?<=\.)\s+(?=[A-Z])", _plain(text))[0])
        found.update(dict.fromkeys(names.split(", "), sentence))
    return found


def _plain(text: str) -> str:
    return " ".join(text.replace("`", "").split())


def _short(value: object) -> str:
    if isinstance(value, Mapping):
        return str(value.get("kind", "{}"))
    return {None: "null", True: "true", False: "false"}[value] if isinstance(value, bool | None) else str(value)
