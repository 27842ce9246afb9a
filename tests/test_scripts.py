"""Scripts and README: what they say runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_first_image_is_the_script_of_the_readme_and_runs(tmp_path: Path) -> None:
    script = ROOT / "scripts" / "first_image.py"
    assert script.read_text(encoding="utf-8") in (ROOT / "README.md").read_text(encoding="utf-8")
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-1000:]
    found = re.match(r"Doppler ([-\d.]+) Hz, true ([-\d.]+) Hz", done.stdout)
    assert found and abs(float(found[1]) - float(found[2])) < 5
    assert (tmp_path / "first_image.png").read_bytes().startswith(b"\x89PNG")


def test_the_config_of_the_readme_is_accepted(tmp_path: Path) -> None:
    from torchsar.study.config import load
    from torchsar.study.run import check

    blocks = re.findall(r"```yaml\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    assert blocks
    for block in blocks:
        path = tmp_path / "readme.yaml"
        path.write_text(block, encoding="utf-8")
        check(load(str(path)))


def test_readme_points_at_files_that_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert target.startswith("http") or (ROOT / target).exists(), target
