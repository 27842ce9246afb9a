"""Shells complete commands, options, their values and the names of configs."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from torchsar.cli import main, parser
from torchsar.completion import completion
from torchsar.study.settings.text import packaged_configs

BASH, FISH = shutil.which("bash"), shutil.which("fish")
# lines whose last word is completed, and what is offered
LINES = [
    ("torchsar sw", ["sweep"]),
    ("torchsar --threads 2 sw", ["sweep"]),
    ("torchsar --threads 2 sweep stripmap_do", ["stripmap_doppler"]),
    ("torchsar run isal_table1 --o", ["--out"]),
    ("torchsar export out/strip --to ge", ["geotiff"]),
    ("torchsar run isal_table1 --out isal", []),  # a folder, which the shell completes by itself
    ("torchsar config sche", ["schema"]),
    ("torchsar config show radar", ["radarsat1"]),
    ("torchsar completion z", ["zsh"]),
    ("torchsar sweep isal_snr --res", ["--resume"]),
]


def completed(*words: str) -> list[str]:
    """What bash offers for the last of some words."""
    script = completion("bash", parser(), packaged_configs())
    call = f'COMP_WORDS=("$@"); COMP_CWORD={len(words) - 1}; _torchsar_words; echo "${{COMPREPLY[*]}}"'
    done = subprocess.run(
        [BASH or "", "-c", f"{script}\n{call}", "bash", *words], capture_output=True, text=True, timeout=60, check=True
    )
    assert not done.stderr
    return done.stdout.split()


@pytest.mark.skipif(BASH is None, reason="bash is not installed")
@pytest.mark.parametrize(("line", "offered"), LINES)
def test_bash_completes(line: str, offered: list[str]) -> None:
    assert completed(*line.split(" ")) == offered


@pytest.mark.skipif(FISH is None, reason="fish is not installed")
@pytest.mark.parametrize(("line", "offered"), LINES)
def test_fish_completes(line: str, offered: list[str], tmp_path: Path) -> None:
    """In an empty folder, so that it offers no files."""
    script = completion("fish", parser(), packaged_configs())
    call = [FISH or "", "--no-config", "-c", f"{script}\ncomplete -C '{line}'"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True)
    assert not done.stderr
    assert [row.split("\t")[0] for row in done.stdout.splitlines()] == offered


@pytest.mark.skipif(BASH is None, reason="bash is not installed")
def test_bash_offers_every_command() -> None:
    assert {"run", "sweep", "trade", "requires", "import", "export", "list", "config", "completion"} <= set(
        completed("torchsar", "")
    )


def test_the_command_prints_a_script_for_each_shell(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
        shown[shell] = capsys.readouterr().out
    assert shown["zsh"].startswith("#compdef torchsar\n") and shown["bash"] in shown["zsh"]
    # a help text may hold an apostrophe
    assert all(len(re.findall(r"(?<!\\)'", line)) % 2 == 0 for line in shown["fish"].splitlines())
    assert "-l to -r -a 'netcdf sicd geotiff cphd'\n" in shown["fish"] and '-a "$configs"\n' in shown["fish"]
    with pytest.raises(SystemExit):
        main(["completion", "tcsh"])
