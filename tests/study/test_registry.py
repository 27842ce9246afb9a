"""Names that configs may use, and a user's own stage among them."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch

from torchsar.core import Stage
from torchsar.study import table
from torchsar.study.names import registry
from torchsar.study.names.registry import GROUPS, WORLD, group_of, stages
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.signature import Catalogue, Section

OWN = '''
from torchsar.core import Stage

class Louder(Stage):
    """Everything times a gain."""
    def __init__(self, gain: float = 2.0):
        super().__init__()
        self.gain = gain
    def forward(self, signal):
        return signal.with_data(signal.data * self.gain)

class Silent(Stage):
    def forward(self, signal):
        return signal
'''


@pytest.mark.parametrize("catalogue", [stages(), *WORLD.values()], ids=["stages", *WORLD])
def test_every_entry_has_keys_that_yaml_can_hold(catalogue: Catalogue) -> None:
    for section in catalogue.sections.values():
        assert set(section.model.model_fields) == set(section.keys)


def test_every_stage_belongs_to_one_group() -> None:
    names = [name for group in GROUPS.values() for name in group]
    assert len(names) == len(set(names))
    assert {group_of(name) for name in names} == set(GROUPS)


class Sample(Stage):
    def __init__(
        self,
        radar: object,
        count: int = 3,
        level: torch.Tensor | float | None = None,
        table: torch.Tensor | None = None,
        pair: tuple[int, int] = (1, 2),
    ) -> None:
        super().__init__()
        self.radar, self.count, self.level, self.table, self.pair = radar, count, level, table, pair


def test_signatures_become_keys_and_values_become_what_they_ask_for() -> None:
    catalogue = Catalogue("stage", "stage", {"sample": Sample}, given=("radar",))
    keys = catalogue.sections["sample"].keys
    assert set(keys) == {"count", "level", "table", "pair"}
    assert [name for name, key in keys.items() if key.per_trial] == ["level"]
    entry = catalogue.check({"stage": "sample", "level": 2.5, "table": [1.0, 2.0], "pair": [3, 4]}, "here", "file")
    made = catalogue.make(entry, "here", "file", radar="the radar")
    assert made.radar == "the radar" and made.count == 3 and made.level == 2.5 and made.pair == (3, 4)
    assert made.table.dtype == torch.float64 and made.table.tolist() == [1.0, 2.0]
    level = torch.tensor([1.0, 2.0])
    assert catalogue.make(entry, "here", "file", {"level": level}, radar=0).level is level
    with pytest.raises(ConfigError, match=r"here.stage names an unknown stage \{'a': 1\}"):
        catalogue.check({"stage": {"a": 1}}, "here", "file")
    for wrong in ({"count": 1.5}, {"count": True}, {"pair": 3}, {"level": "x"}, {"radar": 1}):
        with pytest.raises(ConfigError, match="here"):
            catalogue.check({"stage": "sample", **wrong}, "here", "file")


def test_a_parameter_that_yaml_cannot_hold_is_a_fault_of_the_program() -> None:
    def takes_function(law: type) -> None: ...

    with pytest.raises(TypeError, match="'law'.*register a factory"):
        assert Section(takes_function).keys

    def says_nothing(law) -> None: ...  # type: ignore[no-untyped-def]

    with pytest.raises(TypeError, match="parameter 'law' has no annotation, and cannot be written"):
        assert Section(says_nothing).keys


class Broken:
    """An entry point whose package cannot be loaded."""

    name, value, group = "louder", "louder:Louder", "torchsar.stages"

    def __init__(self, found: object) -> None:
        self.found = found

    def load(self) -> object:
        if isinstance(self.found, BaseException):
            raise self.found
        return self.found


def unreadable(law: type) -> None: ...


@pytest.mark.parametrize(
    "found, said",
    [
        (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
        (ModuleNotFoundError("No module named 'mine'", name="mine"), "ModuleNotFoundError: No module named 'mine'"),
        (SyntaxError("invalid syntax"), "SyntaxError: invalid syntax"),
        (SystemExit(3), "SystemExit: 3"),
        (unreadable, "TypeError: .*'law'"),
        (3, "TypeError"),
    ],
    ids=lambda value: type(value).__name__,
)
@pytest.mark.parametrize("group", ["torchsar.stages", "torchsar.systems"])
def test_a_plugin_that_cannot_be_loaded_is_a_sentence(
    group: str, found: object, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    point = Broken(found)
    for module in (registry, table):
        monkeypatch.setattr(module, "entry_points", lambda group: [point] if group == wanted else [])
    wanted = group
    monkeypatch.setattr(table, "systems", table._Systems())
    if group == "torchsar.systems":
        if not isinstance(found, BaseException):
            pytest.skip("the module of a system is imported, not its content")
        monkeypatch.setattr(table, "import_module", lambda name: point.load() if name == point.value else None)
    registry.stages.cache_clear()
    try:
        with pytest.raises(
            ConfigError, match=rf"entry point 'louder' \(louder:Louder\) .*{said}.*uninstall the package"
        ):
            _ = table.systems["louder"] if group == "torchsar.systems" else registry.stages()
    finally:
        registry.stages.cache_clear()


@pytest.mark.slow
def test_own_stage_joins_through_the_entry_point(tmp_path: Path) -> None:
    (tmp_path / "louder.py").write_text(OWN)
    info = tmp_path / "louder-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: louder\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[torchsar.stages]\nlouder = louder:Louder\nsilent = louder:Silent\n")
    code = (
        "from torchsar.study.names.registry import stages, group_of; s = "
        "stages().make({'stage': 'louder', 'gain': 3.0}, 'x', 'f'); print(s.gain, group_of('louder')); "
        "from torchsar.study.commands.listing import listing; "
        "print(*(line for line in listing({}).splitlines() if line[:8] in ('  louder', '  silent')), sep='\\n')"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parents[2],
    )
    made, *listed = done.stdout.splitlines() or [""]
    assert made == "3.0 own", done.stderr[-1500:]
    # a stage without a docstring is not described by that of its base class
    assert [line.split(maxsplit=1) for line in listed] == [["louder", "Everything times a gain."], ["silent"]]


def test_a_system_of_another_package_does_not_replace_a_built_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("stripmap", "other.package", "torchsar.systems")
    monkeypatch.setattr("torchsar.study.table.entry_points", lambda group: [point])
    with pytest.raises(ConfigError, match=r"torchsar\.systems:stripmap \(other\.package\) has the name of a built-in"):
        list(table.systems)
