"""Shells complete commands, options, their values and the names of configs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torchsar.cli import main

# lines whose last word is completed, and what is offered
LINES = [
    ("torchsar sw", ["sweep"]),
    ("torchsar --threads 2 sw", ["sweep"]),
    ("torchsar --threads 2 sweep stripmap_do", ["stripmap_doppler"]),
    ("torchsar run isal_table1 --o", ["--out"]),
    ("torchsar export out/strip --to ge", ["geotiff"]),
    ("torchsar run isal_table1 --out isal", []),  # a folder
    ("torchsar config sche", ["schema"]),
    ("torchsar config show radar", ["radarsat1"]),
    ("torchsar completion z", ["zsh"]),
    ("torchsar sweep isal_snr --res", ["--resume"]),
]


@pytest.mark.parametrize(("line", "offered"), LINES)
def test_the_program_offers_the_words_that_may_follow(line: str, offered: list[str], tmp_path: Path) -> None:
    """As the scripts of the shells ask for them, in an empty folder."""
    answer, program = tmp_path / "answer", [sys.executable, "-m", "torchsar"]
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer), "_ARGCOMPLETE_SUPPRESS_SPACE": "1"}
    known = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9", "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(program, env={**os.environ, **asked, **known}, cwd=tmp_path, timeout=60, check=True)
    assert [word for word in answer.read_text(encoding="utf-8").split("\v") if word] == offered


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_command_prints_a_script_that_its_shell_reads(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "torchsar" in script and "_ARGCOMPLETE" in script
    if (program := shutil.which(shell)) is not None:
        subprocess.run([program, "-n"], input=script, text=True, timeout=60, check=True)
