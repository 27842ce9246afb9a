"""Tutorials as notebooks: their cells are short, and they run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [page for page in sorted((ROOT / "docs" / "tutorials").glob("*.md")) if page.stem != "index"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_cell_is_short(page: Path) -> None:
    cells = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), flags=re.S)
    assert cells and max(len(cell.strip().splitlines()) for cell in cells) <= 20


@pytest.mark.slow
@pytest.mark.parametrize("name", ["steps", "isal"])
def test_a_notebook_holds_the_page_and_what_it_prints(name: str, tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="the extra `notebooks` is not installed")
    pytest.importorskip("nbclient", reason="the extra `notebooks` is not installed")
    script = [sys.executable, str(ROOT / "scripts" / "notebooks.py"), name, "--out", str(tmp_path)]
    done = subprocess.run(script, capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    made = nbformat.read(tmp_path / f"{name}.ipynb", as_version=4)
    nbformat.validate(made)
    code = [cell for cell in made.cells if cell.cell_type == "code"]
    assert len(code) == (ROOT / "docs" / "tutorials" / f"{name}.md").read_text(encoding="utf-8").count("```python")
    assert all(cell.execution_count for cell in code) and any(cell.outputs for cell in code)
    text = "".join(cell.source for cell in made.cells if cell.cell_type == "markdown")
    assert made.cells[0].source.startswith("# ") and "{py:" not in text and "```{" not in text
    held = [picture for cell in made.cells for picture in cell.get("attachments", {})]
    assert held and sorted(re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)) == sorted(f"attachment:{one}" for one in held)
