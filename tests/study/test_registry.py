"""Names that configs may use, and a user's own stage among them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchsar.study.catalogue import Catalogue
from torchsar.study.registry import BEAMS, GROUPS, IMPAIRMENTS, PATHS, SCENES, group_of, stages

from torchsar.core import Stage
from torchsar.study.settings.errors import ConfigError

OWN = '''
from torchsar.core import Stage

class Louder(Stage):
    """Everything times a gain."""
    def __init__(self, gain: float = 2.0):
        super().__init__()
        self.gain = gain
    def forward(self, signal):
        return signal.with_data(signal.data * self.gain)
'''


@pytest.mark.parametrize("catalogue", [stages(), SCENES, BEAMS, PATHS, IMPAIRMENTS], ids=lambda c: c.what)
def test_every_entry_has_keys_that_yaml_can_hold(catalogue: Catalogue) -> None:
    for name in catalogue.entries:
        assert catalogue.model(name).model_fields is not None


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
    assert set(catalogue.model("sample").model_fields) == {"count", "level", "table", "pair"}
    made = catalogue.make(
        {"stage": "sample", "level": 2.5, "table": [1.0, 2.0], "pair": [3, 4]}, "here", "file", radar="the radar"
    )
    assert made.radar == "the radar" and made.count == 3 and made.level == 2.5 and made.pair == (3, 4)
    assert made.table.dtype == torch.float64 and made.table.tolist() == [1.0, 2.0]
    for wrong in ({"count": 1.5}, {"count": True}, {"pair": 3}, {"level": "x"}, {"radar": 1}):
        with pytest.raises(ConfigError, match="here"):
            catalogue.make({"stage": "sample", **wrong}, "here", "file", radar="the radar")


def test_own_stage_joins_through_the_entry_point(tmp_path: Path) -> None:
    (tmp_path / "louder.py").write_text(OWN)
    info = tmp_path / "louder-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: louder\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[torchsar.stages]\nlouder = louder:Louder\n")
    code = (
        "from torchsar.study.registry import stages, group_of; s = "
        "stages().make({'stage': 'louder', 'gain': 3.0}, 'x', 'f'); print(s.gain, "
        "group_of('louder'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        cwd=Path(__file__).parents[2],
    )
    assert done.stdout.split() == ["3.0", "own"], done.stderr[-1500:]
