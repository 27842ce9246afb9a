"""Reading and writing of YAML, search for config files, and overrides from the command line."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import ComposerError

from torchsar.study.settings.errors import ConfigError, did_you_mean, one_line

# Tags and their values by the rules of YAML 1.2, in which '_' may also be between digits. Thus 1e-6
# is a number and 017 is 17, while 1:30, 2024-01-31, yes and 0b1 are texts.
_RULES = {
    "int": (r"[-+]?[0-9][0-9_]*|0o[0-7]+|0x[0-9a-fA-F]+", "-+0123456789"),
    "float": (
        r"[-+]?(?:(?:[0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)(?:[eE][-+]?[0-9]+)?|[0-9][0-9_]*[eE][-+]?[0-9]+|\.(?:inf|Inf|INF))|\.(?:nan|NaN|NAN)",
        "-+0123456789.",
    ),
    "bool": (r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "null": (r"~|null|Null|NULL|", ["~", "n", "N", ""]),
}
# Largest depth of sections and lists inside each other, and largest number of values in a document
# with all repetitions. Both are far more than configs have, and few enough for all later steps.
_DEEPEST, _MOST_VALUES = 50, 200_000


class _Loader(yaml.SafeLoader):
    """Loader of safe YAML 1.2. It rejects duplicate keys, and documents that are too large."""

    yaml_implicit_resolvers: dict[Any, Any] = {}
    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        mark, self.depth = self.peek_event().start_mark, self.depth + 1
        if self.depth > _DEEPEST:
            raise ComposerError(None, None, f"more than {_DEEPEST} parts inside each other", mark)
        again = self.check_event(yaml.AliasEvent)
        node: Any = super().compose_node(parent, index)
        self.depth -= 1
        parts: Any = node.value
        if isinstance(parts, str):
            parts = parts.encode()[:0]  # this raises a ValueError for half of a surrogate pair
        if not again:
            node.size = 1 + sum(one.size for part in parts for one in (part if isinstance(part, tuple) else [part]))
        # the size is infinite for a node that contains itself
        if getattr(node, "size", math.inf) > _MOST_VALUES:
            raise ComposerError(None, None, f"more than {_MOST_VALUES} values with all repetitions", mark)
        return node


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key_node, value_node in node.value:
        key = key_node.value if isinstance(key_node, yaml.ScalarNode) else ""
        if not key or key in seen:
            what = f"the key {key!r} is given twice" if key in seen else "a key must be a word"
            raise yaml.constructor.ConstructorError(None, None, what, key_node.start_mark)
        seen[key] = loader.construct_object(value_node, deep=True)
    return seen


def _whole(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = node.value
    return int(text, 0 if text[:2] in ("0o", "0x") else 10)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)
_Loader.add_constructor("tag:yaml.org,2002:int", _whole)


class _Dumper(yaml.SafeDumper):
    """Dumper that keeps the order of mappings and writes lists of scalars on one line."""


_Dumper.add_representer(
    list,
    lambda dumper, items: dumper.represent_sequence(
        "tag:yaml.org,2002:seq", items, flow_style=all(not isinstance(i, (dict, list)) for i in items)
    ),
)
for _tag, (_rule, _first) in _RULES.items():
    for _kind in (_Loader, _Dumper):  # texts that look like numbers are written with quotes
        _kind.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_rule})$"), list(_first))
_Dumper.add_representer(tuple, lambda dumper, items: dumper.represent_list(list(items)))


def parse(text: str, what: str) -> Any:
    """Return the content of a YAML document.

    Args:
        text: The document.
        what: Name of its source, for messages.

    Raises:
        ConfigError: If it is no YAML; the message has the source and the line.
    """
    try:
        return yaml.load(text, Loader=_Loader)  # the loader is a SafeLoader
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{what}{line}: not readable as YAML: {error.problem}") from None
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{what}: not readable as YAML: {one_line(error)}") from None


def dump(tree: Mapping[str, Any]) -> str:
    """Return a tree of plain values as YAML."""
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, width=160, allow_unicode=True)


def packaged_configs() -> dict[str, Path]:
    """Return the files of the configs that are part of torchsar, by name.

    They are in the folder `configs` of an installed package, or beside the package in a checkout;
    configs of sweeps are in its subfolder `sweeps`.
    """
    package = Path(__file__).resolve().parents[2]
    return {
        path.stem: path
        for folder in (package.parent / "configs", package / "configs")
        for path in (*sorted(folder.glob("*.yaml")), *sorted(folder.glob("sweeps/*.yaml")))
    }


def experiments() -> str:
    """Return the packaged configs with their titles, for `torchsar list`."""
    lines = ["EXPERIMENTS (torchsar run NAME, or FILE for a config of your own; [sweep]: torchsar sweep NAME)"]
    for name, path in packaged_configs().items():
        tree = read_tree(path)
        lines.append(f"  {name:<25}{tree.get('title', '')}{' [sweep]' if 'sweep' in tree else ''}")
    return "\n".join(lines)


def find_config(name: str) -> Path:
    """Return the file of a config.

    Args:
        name: Path of a file, or the name of a packaged config such as "stripmap_damaged" or
            "configs/stripmap_damaged.yaml".

    Raises:
        ConfigError: If there is no such file.
    """
    path = Path(name)
    if path.is_file():
        return path
    packaged = packaged_configs()
    if (
        path.parent in (Path("."), Path("configs"), Path("sweeps"), Path("configs/sweeps"))
        and path.suffix in ("", ".yaml")
        and path.stem in packaged
    ):
        return packaged[path.stem]
    if path.is_dir():
        raise ConfigError(f"{name!r} is a folder, not a config file")
    raise ConfigError(
        f"there is no config file {name!r} and no packaged config of that name{did_you_mean(path.stem, packaged)}"
    )


def read_tree(path: Path) -> dict[str, Any]:
    """Return the mapping in a config file. Raises ConfigError if the file holds no mapping."""
    try:
        if path.stat().st_size > 1 << 24:
            raise ConfigError(f"{path}: {path.stat().st_size} bytes are no config; name recorded data by data.file=")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error})") from None
    tree = parse(text, str(path))
    if not isinstance(tree, dict):
        kind = "an empty file" if tree is None else type(tree).__name__
        raise ConfigError(f"{path}: a config must be a mapping of sections, got {kind}")
    return tree


def override(
    tree: dict[str, Any], assignments: Sequence[str], literal: tuple[str, str, Sequence[str]] = ("", "", ())
) -> dict[str, Any]:
    """Return a tree with overrides applied.

    Args:
        tree: The tree.
        assignments: Overrides key=value, with dotted keys and YAML values.
        literal: A section, a mapping in this section whose keys contain dots, and the names of the
            other keys of the section. With ("sweep", "grid", ...) the two overrides
            `sweep.world.noise.snr_db=[0, 10]` and `sweep.grid.world.noise.snr_db=[0, 10]` both set
            the single key "world.noise.snr_db" in the section `sweep`.

    Raises:
        ConfigError: If an assignment is not of the form key=value, or its key is below a number or
            another plain value.
    """
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals or not all(part.strip() for part in key.split(".")):
            raise ConfigError(
                f"command line: {assignment!r} is not an override; write key=value with a dotted key, "
                "such as world.noise.snr_db=10"
            )
        path = key.strip().split(".")
        if path[0] == literal[0] and len(path) > 2 and path[1] not in literal[2]:
            path = [path[0], ".".join(path[1:]).removeprefix(f"{literal[1]}.")]
        tree = _assigned(tree, path, parse(value, f"command line, {key}"), key)
    return tree


def _assigned(tree: Any, path: list[str], value: Any, key: str) -> dict[str, Any]:
    if tree is None:
        tree = {}
    if not isinstance(tree, dict):
        raise ConfigError(
            f"command line: {key} cannot be set, because the part before {'.'.join(path)!r} has the value "
            f"{tree!r} and is not a section"
        )
    head, rest = path[0], path[1:]
    return {**tree, head: _assigned(tree.get(head), rest, value, key) if rest else value}


def fault_of_name(name: Any, longest: int) -> str:
    """Decide whether a store can have an entry of some name, for which it makes a folder.

    Args:
        name: The name.
        longest: Largest number of bytes; file systems allow 255, and names of files are longer.

    Returns:
        The reason why it cannot be used, as the end of a sentence; empty if it can.
    """
    if not isinstance(name, str) or name.strip() in ("", ".", "..", "zarr.json") or re.search("^__|/", name):
        return "since names are words without '/' that do not begin with '__'"
    if not name.isprintable():
        return "since names have only printable characters"
    size = len(name.encode())
    return f"since it has {size} bytes; use {longest} at most" if size > longest else ""
