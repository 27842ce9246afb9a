"""Code of the README and of the documentation runs, and its commands, configs and links exist."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import sys
import tomllib
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from torchsar import Outcome
from torchsar.cli import parser
from torchsar.reproduce import paper
from torchsar.study.commands.sweep import SweepTrial, sweep_grid
from torchsar.study.names.registry import stages
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("[a-z]*/*.md"))]
# files of the reader, which are not in the repository
THEIRS = {
    "my_strip.yaml": "stripmap_damaged",
    "my_radar.yaml": "recorded_strip",
    "my_flight.yaml": "drone_stripmap",
    "CONFIG": "isal_snr",
}


# smaller scenes than those that a page shows, whose results are not looked at here
SMALLER = {
    "docs/tutorials/geo_ocean.md": {"world.pulses=1440": "world.pulses=540", "world.samples=192": "world.samples=128"},
    "docs/how_to/own_stage.md": {"trials=20": "trials=4"},
    "docs/how_to/ok.md": {"range(4)": "range(1)", "batch=4": "batch=1"},
    "docs/how_to/own_method.md": {"small=True": "small=True, trials=1"},
    "docs/tutorials/isal.md": {"trials=2": "trials=1"},
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def block_with(page: Path, language: str, words: str) -> str:
    """The only block of a page that has these words."""
    (found,) = (block for block in blocks(page, language) if words in block)
    return found


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def with_blocks(language: str) -> list[Any]:
    return [pytest.param(page, id=name(page)) for page in PAGES if blocks(page, language)]


def scripts() -> set[str]:
    """Scripts, which have tests of their own."""
    return {path.read_text(encoding="utf-8") for path in (ROOT / "scripts").glob("*.py")}


def cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package for Slurm that starts nothing."""

    class SLURMCluster:
        scheduler_address = "tcp://head:8786"

        def __init__(self, **options: Any) -> None:
            assert options["processes"] == 1

        def scale(self, count: int) -> None:
            assert count > 0

    module = ModuleType("dask_jobqueue")
    module.SLURMCluster = SLURMCluster  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "dask_jobqueue", module)
    monkeypatch.setattr("subprocess.run", lambda words, check: parser().parse_args(words[1:]))


@pytest.mark.parametrize("page", with_blocks("python"))
def test_the_code_of_a_page_runs_in_order(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    cluster(monkeypatch)
    space: dict[str, Any] = {"__name__": name(page)}
    known = scripts()
    for block in blocks(page, "python"):
        for shown, smaller in SMALLER.get(name(page), {}).items():
            block = block.replace(shown, smaller)
        if block not in known:
            with contextlib.redirect_stdout(io.StringIO()) as text:
                exec(compile(block, name(page), "exec"), space)
            assert not re.search(r"\bnan\b|\binf\b", text.getvalue()), text.getvalue()


def commands() -> list[Any]:
    """Lines of the shell on all pages, without their comments."""
    found = []
    for page in PAGES:
        for block in blocks(page, "bash"):
            joined = re.sub(r"\\\n\s*", "", block)
            found += [
                pytest.param(line, id=f"{name(page)}: {line[:50]}") for line in joined.splitlines() if line.strip()
            ]
    return found


@pytest.mark.parametrize("line", commands())
def test_a_command_is_accepted(line: str, tmp_path: Path) -> None:
    (tmp_path / "data").touch()
    line = re.sub(r"/path/to/\w+\.(npz|cphd)", str(tmp_path / "data"), line)
    line = line.replace("$(python -c 'print([0.1 + 0.01 * i for i in range(64)])')", "[0.1, 0.2]")
    words = shlex.split(line.partition(" > ")[0], comments=True)
    program, *rest = [word for word in words if not re.match(r"[A-Z_]+=", word)]
    if program == "make":
        assert all(f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8") for target in rest)
    elif program == "python" and rest[0].startswith("scripts/"):
        text = (ROOT / rest[0]).read_text(encoding="utf-8")
        assert all(option in text for option in rest[1:] if option.startswith("--") and option != "--help")
    elif program == "torchsar":
        options, more = parser().parse_known_args(rest)
        if options.command in ("import", "export", "bench", "list", "config", "completion"):
            assert not more
        elif options.command == "reproduce":
            assert not more and (options.item is None or paper(options.paper).find(options.item))
        else:
            overrides = [*options.overrides, *more]
            assert not any(word.startswith("-") for word in overrides)
            load(THEIRS.get(options.config, options.config), overrides)
    else:
        assert program in ("pip", "python3"), line


def test_the_configs_are_accepted(tmp_path: Path) -> None:
    (whole,) = blocks(DOCS / "reference" / "config.md", "yaml")
    (swept,) = blocks(DOCS / "how_to" / "sweeps.md", "yaml")
    path = tmp_path / "mine.yaml"
    path.write_text(whole, encoding="utf-8")
    assert list(Bench(load(path)).chains) == ["recommended"]
    path.write_text(whole + swept, encoding="utf-8")
    loaded = load(path)
    assert sweep_grid(loaded, SweepTrial(loaded)).shape == (3, 2, 2)


def test_other_blocks_are_well_formed() -> None:
    for page in PAGES:
        for block in blocks(page, "json"):
            assert json.loads(block)
        for block in blocks(page, "toml"):
            assert tomllib.loads(block)
        languages = set(re.findall(r"^```([a-z]+)", page.read_text(encoding="utf-8"), re.MULTILINE))
        assert languages <= {"python", "bash", "yaml", "json", "toml", "text"}, name(page)


@pytest.mark.parametrize("section, columns", [("By modality", (1, 2)), ("By scene", (1,))])
def test_the_table_of_estimators_names_stages_and_outcomes(section: str, columns: tuple[int, ...]) -> None:
    text = (DOCS / "how_to" / "estimators.md").read_text(encoding="utf-8")
    part = text.partition(f"## {section}\n")[2].partition("\n## ")[0]
    rows = [line.strip("|").split("|") for line in part.splitlines() if line.startswith("| ") and "---" not in line]
    named = {name for row in rows for column in columns for name in re.findall(r"`([a-z_]+)`", row[column])}
    assert len(named) > 3 and not named - set(stages().entries) - {"scene"}
    assert set(re.findall(r"`([A-Z_]{4,})`", text)) <= {outcome.name for outcome in Outcome}


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_links_lead_to_files(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)\)", page.read_text(encoding="utf-8")):
        assert target.startswith("http") or (page.parent / target).exists(), target


def test_the_readme_is_short_and_leads_to_every_tutorial() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < 100
    assert all(f"docs/tutorials/{page.name}" in text for page in (DOCS / "tutorials").glob("*.md"))
    assert blocks(ROOT / "README.md", "python") == [(ROOT / "scripts" / "first_image.py").read_text(encoding="utf-8")]


def test_the_reference_has_every_public_name(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx.application", reason="the extra `docs` is not installed")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import importlib

    api = importlib.import_module("api")
    documented = {one for names in api.names().values() for one in names}
    for package in sorted(path.parent.name for path in (ROOT / "torchsar").glob("*/__init__.py")):
        missing = {f"torchsar.{package}.{one}" for one in api.public(package)} - documented
        assert not missing, missing
    listed = (DOCS / "reference" / "index.md").read_text(encoding="utf-8")
    assert all(f"api/{package}\n" in listed for package in api.PACKAGES)
    text = api.page("optim", api.names()["optim"])
    assert all(f":: {one}\n" in text and f"`~{one}`" in text for one in api.names()["optim"])


def test_docstrings_become_restructured_text(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx.application", reason="the extra `docs` is not installed")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import importlib

    api = importlib.import_module("api")
    lines = ["Of |a| and `a_`, b_:", "- one", "- two", "  more", "end", "", "    x = 1", "", "Args:", "    x: It."]
    made = ["Of \\|a\\| and `a_`, b\\_:", "", "- one", "- two", "  more", "", "end", "", ".. code-block:: python", ""]
    assert list(api.restructured(lines)) == [*made, "    x = 1", "", "Args:", "    x: It."]


def test_what_loads_from_a_network_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sphinx.application", reason="the extra `docs` is not installed")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import importlib

    loads = importlib.import_module("offline").loads
    bad = '<script src="https://a/b.js"></script><link rel="stylesheet" href="//c/d.css"/> @import url(http://e/f)'
    assert len(list(loads(bad))) == 3
    assert not list(loads('<a href="https://a">a</a><img src="b.png"><link rel="canonical" href="https://c">'))


def test_the_citation_names_every_paper() -> None:
    yaml = pytest.importorskip("yaml")
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert len(cited["references"]) == 5 and all(paper["authors"] and paper["year"] for paper in cited["references"])
    assert f'version = "{cited["version"]}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
