"""Fingerprints of functions: equal for equal code and values, different for any change."""

from __future__ import annotations

import functools
import importlib
import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from torchsar.core import Chain, Stage
from torchsar.study.montecarlo.fingerprint import code, fingerprint, packages_of
from torchsar.study.settings.errors import ConfigError

PROGRAM = """
import argparse, math, torch
SCALE, TABLE = 2.0, torch.arange(3.0)
options = argparse.Namespace(samples=4, resume=False)
def inner(x): return x * SCALE
def made(window, taps=(1, 2)):
    def trial(parameters, draws, order=3):
        "Text."
        return {"m": sum(inner(t) for t in taps) + window + math.pi + TABLE.sum() + options.samples}
    return trial
class Trial:
    gain = 3
    def __init__(self, window): self.window = window
    def __call__(self, parameters, draws): return {"m": self.gain * self.window}
function = made(5.0)
object = Trial(5.0)
"""
# replacements that change the results of the function, or of the object
CHANGES = {
    "constant of a function that is called": ("x * SCALE", "x * SCALE * 1.5"),
    "operation": ("+ window", "- window"),
    "closed over": ("made(5.0)", "made(6.0)"),
    "default of the factory": ("taps=(1, 2)", "taps=(1, 3)"),
    "default of the function": ("order=3", "order=4"),
    "global number": ("SCALE, TABLE = 2.0", "SCALE, TABLE = 2.5"),
    "global tensor": ("arange(3.0)", "arange(1.0, 4.0)"),
    "option that is read": ("samples=4", "samples=5"),
    "attribute of a library": ("math.pi", "math.e"),
}
OF_OBJECT = {
    "attribute": ("Trial(5.0)", "Trial(6.0)"),
    "attribute of the class": ("gain = 3", "gain = 4"),
    "method": ("self.gain * self.window", "self.gain + self.window"),
}
SAME = {
    "comment": ('"Text."', '"Text."  # a comment'),
    "docstring": ('"Text."', '"Another text."'),
    "lines": ("def inner", "\n\ndef inner"),
    "option that is not read": ("resume=False", "resume=True"),
    "function that is not called": ("class Trial", "def other(): return 7\nclass Trial"),
}


def of(change: tuple[str, str] = ("", ""), name: str = "function") -> dict[str, Any]:
    assert change[0] in PROGRAM
    scope: dict[str, Any] = {"__name__": "mine"}
    exec(compile(PROGRAM.replace(*change) if change[0] else PROGRAM, "mine", "exec", dont_inherit=True), scope)
    return fingerprint(scope[name])


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_any_change_of_a_result_is_seen(change: tuple[str, str]) -> None:
    assert of(change) != of()


@pytest.mark.parametrize("change", OF_OBJECT.values(), ids=OF_OBJECT)
def test_a_callable_object_counts_with_its_class_and_its_state(change: tuple[str, str]) -> None:
    assert of(change, "object") != of(name="object")


@pytest.mark.parametrize("change", SAME.values(), ids=SAME)
def test_what_changes_no_result_is_not_seen(change: tuple[str, str]) -> None:
    assert of(change) == of()


def test_values_are_shown_by_name() -> None:
    assert of()["uses"]["window"] == "float 5.0" and of()["uses"]["inner"].startswith("function ")
    assert of()["uses"]["options.samples"] == "int 4" and "torch" not in of()["uses"]


def test_another_process_gives_the_same() -> None:
    words = "import json\nfrom torchsar.study.montecarlo.fingerprint import fingerprint\n"
    words += f"scope = {{'__name__': 'mine'}}\nexec({PROGRAM!r}, scope)"
    words += "\nprint(json.dumps([fingerprint(scope[n]) for n in ('function', 'object')]))"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [of(), of(name="object")]


@dataclass(frozen=True, slots=True)
class Slotted:
    window: int


@dataclass(frozen=True)
class Setting:
    window: int
    names: frozenset[str] = frozenset({"a", "b", "c"})


def closing_over(value: Any) -> Any:
    return lambda parameters, draws: value


def loop(first: Any) -> list[Any]:
    first.append(first)
    return first


PAIRS: list[tuple[Any, Any]] = [
    (Setting(3), Setting(4)),
    (torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)),
    (functools.partial(int, base=8), functools.partial(int, base=16)),
    (torch.ones(3, dtype=torch.bfloat16), torch.ones(3, dtype=torch.float16)),
    (torch.tensor([1 + 2j]).conj(), torch.tensor([1 + 2j])),
    (np.arange(3), np.arange(3.0)),
    ({"a": 1, "b": 2}, {"a": 2, "b": 1}),
    ({1, 2}, {1, 3}),
    (loop([1]), loop([2])),
    ("\udcff", "\udcfe"),
    (int, float),
    (closing_over(1), closing_over(2)),
    ("abc".upper, "abd".upper),
    (torch.float32, torch.float64),
    (np.exp, np.log),
    (re.compile("a+"), re.compile("a+", re.ASCII)),
    (MappingProxyType({"a": 1}), MappingProxyType({"a": 2})),
    (np.random.default_rng(1), np.random.default_rng(2)),
    (torch.eye(2).to_sparse(), (2 * torch.eye(2)).to_sparse()),
    (Slotted(3), Slotted(4)),
    (np.array([1, None]), np.array([2, None])),
]


@pytest.mark.parametrize("one, other", PAIRS, ids=lambda value: type(value).__name__)
def test_values_of_many_kinds_are_told_apart(one: Any, other: Any) -> None:
    first, second = fingerprint(closing_over(one)), fingerprint(closing_over(other))
    assert first["code"] == second["code"] and first["uses"] != second["uses"]
    assert fingerprint(closing_over(one)) == first


@pytest.mark.parametrize("value", [threading.Lock(), (i for i in range(3)), sys.stdout])
def test_what_cannot_be_compared_is_refused(value: Any) -> None:
    with pytest.raises(ConfigError, match=r"closing_over.* uses value, .* give a version"):
        fingerprint(closing_over(value))


def test_a_name_that_is_assigned_later_counts_as_none() -> None:
    def trial(parameters: Any, draws: Any) -> Any:
        return later

    assert fingerprint(trial)["uses"] == {"later": "NoneType None"}
    later = 1.0
    assert fingerprint(trial)["uses"] == {"later": "float 1.0"}


def test_a_module_counts_by_its_name() -> None:
    assert fingerprint(closing_over(ModuleType("m"))) != fingerprint(closing_over(ModuleType("n")))


class Cached:
    """A class whose members Python cannot pickle."""

    def __init__(self, gain: float) -> None:
        self.gain = gain

    @functools.cached_property
    def square(self) -> float:
        return self.gain**2

    @staticmethod
    def half(x: float) -> float:
        return x / 2


def test_objects_of_classes_with_properties_are_told_apart() -> None:
    assert fingerprint(closing_over(Cached(2.0))) == fingerprint(closing_over(Cached(2.0)))
    assert fingerprint(closing_over(Cached(2.0)))["uses"] != fingerprint(closing_over(Cached(3.0)))["uses"]


def test_wrapped_functions_are_seen() -> None:
    def wrapped(value: int) -> Any:
        return torch.no_grad()(closing_over(value))

    assert fingerprint(wrapped(1)) != fingerprint(wrapped(2))
    assert fingerprint(Setting(3).__eq__) != fingerprint(Setting(4).__eq__)


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package of the user with a stage, which uses a number of another module."""
    folder = tmp_path / "louder_package"
    folder.mkdir()
    (folder / "__init__.py").write_text("from louder_package.stage import Louder\n")
    (folder / "gain.py").write_text("GAIN = 2.0\n")
    (folder / "stage.py").write_text(
        "from torchsar.core import Stage\nfrom louder_package.gain import GAIN\nclass Louder(Stage):\n"
        "    def forward(self, signal): return signal.with_data(GAIN * signal.data)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "louder_package"]:
        del sys.modules[name]


def test_a_package_that_is_not_loaded_counts_as_when_it_is(package: Path) -> None:
    before = code(["louder_package"])
    importlib.import_module("louder_package")
    assert code(["louder_package"]) == before != code(["no_such_package"])


def test_the_code_of_own_stages_counts_with_all_of_their_package(package: Path) -> None:
    Louder = importlib.import_module("louder_package").Louder
    mine = packages_of([Chain(first=Louder(), second=Stage())])
    assert mine == {"louder_package"} and not packages_of([Chain(second=Stage())])
    was = code(mine)
    assert list(was["code"]) == ["louder_package", "torchsar"] and code(mine) == was
    (package / "gain.py").write_text("GAIN = 3.0\n")
    assert code(mine)["code"]["louder_package"] != was["code"]["louder_package"] and code() == code(())
