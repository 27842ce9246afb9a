"""Runs scripts at reduced size and reads what they print."""

from __future__ import annotations

import importlib.util
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine

ROOT = Path(__file__).resolve().parents[1]
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]\d+)?")


def script(name: str) -> Any:
    """A script of the repository as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look up their annotations
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[name]
    return module


def run(name: str, folder: Path, figures: set[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a script prints with --small, after a look at its figures, which are drawn without a
    layout: that takes half of the time.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)
        script(name).main(["--small", "--out", str(folder / "figures")])
    drawn = sorted((folder / "figures").iterdir())
    assert {path.stem for path in drawn} == figures
    assert all(path.read_bytes().startswith(b"\x89PNG") and path.stat().st_size > 5000 for path in drawn)
    return capsys.readouterr().out


def rows(text: str, label: int) -> dict[str, list[float]]:
    """Numbers of every line by what stands in its first `label` letters; of lines alike,
    the first.
    """
    found: dict[str, list[float]] = {}
    for line in text.splitlines():
        found.setdefault(line[:label].strip(), [float(word) for word in NUMBER.findall(line[label:])])
    return found
