"""What may import what, and what the package needs."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

import torchsar

PACKAGE = Path(torchsar.__file__).parent
PROCESSING = ("repair", "compensate", "focus", "metrics", "multichannel", "optim")
CORE = [
    path
    for folder in ("core", "radar", "scene", "echo", "io", *PROCESSING)
    for path in sorted((PACKAGE / folder).rglob("*.py"))
]

_ONLY_TORCH_AND_NUMPY = """
import sys
# torch and numpy, and what torch itself needs
allowed = set(sys.stdlib_module_names) | {"torch", "torchgen", "numpy", "torchsar"}
allowed |= set("typing_extensions sympy mpmath networkx filelock fsspec jinja2 markupsafe".split())
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in allowed:
            raise ModuleNotFoundError(f"{name} is blocked by the test", name=name)
sys.meta_path.insert(0, Block())
import importlib
for name in sys.argv[1:]:
    importlib.import_module(name)
"""


def _module(path: Path) -> str:
    parts = ("torchsar", *path.relative_to(PACKAGE).with_suffix("").parts)
    return ".".join(part for part in parts if part != "__init__")


@cache
def _nodes(path: Path) -> list[ast.AST]:
    return list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide what is imported"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module or ""}
    return found


# study/ from the ground up: a floor imports itself and what stands below it
FLOORS = ("memory", "settings", "bench", "names", "output", "montecarlo", "trials", "systems", "commands", "table")
# a system that builds on another one, by name
SHARED = {"isal_rotation": {"isal"}, "geo_ocean": {"geo"}, "path": {"isal"}}


def test_core_and_stages_need_only_torch_and_numpy() -> None:
    # torch._dynamo, which only a program of torch.compile imports, looks for further packages
    of_compile = PACKAGE / "core" / "compiled.py"
    modules = ["torchsar", "torchsar.data", *(_module(path) for path in CORE if path != of_compile)]
    done = subprocess.run(
        [sys.executable, "-c", _ONLY_TORCH_AND_NUMPY, *modules], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]


def test_core_and_stages_name_only_torch_and_numpy() -> None:
    for path in CORE:
        outside = {name.partition(".")[0] for name in _imports(path)} - set(sys.stdlib_module_names)
        assert outside <= {"torch", "numpy", "torchsar"}, f"{path} imports {outside}"


@pytest.mark.parametrize("package", PROCESSING)
def test_processing_never_sees_the_world(package: str) -> None:
    for path in sorted((PACKAGE / package).rglob("*.py")):
        for name in _imports(path):
            assert not name.startswith(("torchsar.scene", "torchsar.echo", "torchsar.study")), (
                f"{path.name} imports {name}"
            )
            assert not name.endswith(".Truth"), f"{path.name} imports {name}"
            assert not name.startswith("torchsar.io"), f"{path.name} imports {name}"


def test_imports_go_downward() -> None:
    may = {
        "core": {"core"},
        "radar": {"core", "radar"},
        "scene": {"core", "radar", "scene"},
        "echo": {"core", "radar", "scene", "echo"},
    }
    for package, allowed in may.items():
        for path in sorted((PACKAGE / package).rglob("*.py")):
            used = {name.split(".")[1] for name in _imports(path) if name.startswith("torchsar.")}
            assert used <= allowed, f"{path} imports {used - allowed}"


def test_only_plot_imports_matplotlib() -> None:
    for path in PACKAGE.rglob("*.py"):
        if PACKAGE / "plot" not in path.parents:
            assert not any(name.startswith("matplotlib") for name in _imports(path)), path


@pytest.mark.parametrize("package", [*PROCESSING, "core", "radar", "scene", "echo", "io", "plot", "study"])
def test_completion_shows_the_public_names(package: str) -> None:
    module = importlib.import_module(f"torchsar.{package}")
    assert sorted(dir(module)) == sorted(module.__all__)
    assert package in dir(torchsar)


class _Study:
    """The modules of `study` with what each of them imports, lazily in functions or for types alone
    included.
    """

    def __init__(self) -> None:
        self.paths = {_module(path): path for path in sorted((PACKAGE / "study").rglob("*.py"))}
        self.imports = {name: self._of(name) for name in self.paths}

    def _of(self, name: str) -> set[str]:
        """A package that only hands out its own submodules is not itself imported by them."""
        found = set()
        for node in _nodes(self.paths[name]):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                below = {f"{node.module}.{alias.name}" for alias in node.names}
                modules = below & set(self.paths)
                found |= modules if modules == below else {*modules, node.module or ""}
        return {module for module in found if module.startswith("torchsar.")} - {name}

    def circle(self) -> list[str]:
        """Modules that import each other around, empty where there are none."""
        done: set[str] = set()

        def walk(name: str, way: list[str]) -> list[str]:
            if name in way:
                return [*way[way.index(name) :], name]
            if name in done:
                return []
            found = (walk(other, [*way, name]) for other in sorted(self.imports[name] & set(self.paths)))
            circle = next((circle for circle in found if circle), [])
            done.add(name)
            return circle

        return next((circle for circle in (walk(name, []) for name in self.paths) if circle), [])


@pytest.fixture(scope="module")
def study() -> _Study:
    return _Study()


def _floor(module: str) -> str:
    return module.split(".")[2] if module.count(".") > 1 else "face"


def test_study_has_no_import_circle(study: _Study) -> None:
    assert not study.circle(), " -> ".join(study.circle())


def test_a_circle_would_be_found(monkeypatch: pytest.MonkeyPatch, study: _Study) -> None:
    imports = dict(study.imports)
    imports["torchsar.study.settings.errors"] = {"torchsar.study.table"}
    monkeypatch.setattr(study, "imports", imports)
    assert study.circle()[0] == study.circle()[-1] and "torchsar.study.settings.errors" in study.circle()


def test_study_imports_go_downward(study: _Study) -> None:
    """The face, `torchsar.study` itself, hands out names of `montecarlo` and stands on top."""
    order = {floor: i for i, floor in enumerate((*FLOORS, "face"))}
    for name, imports in study.imports.items():
        for other in imports:
            assert not other.startswith("torchsar.cli"), f"{name} imports the command line"
            if other.startswith("torchsar.study"):
                assert order[_floor(other)] <= order[_floor(name)], f"{name} imports {other}, which stands above it"


def test_only_the_table_names_the_systems(study: _Study) -> None:
    for name, imports in study.imports.items():
        for other in (one for one in imports if _floor(one) == "systems"):
            system, used = (one.split(".")[3] for one in (name, other)) if _floor(name) == "systems" else ("", other)
            assert used in {system} | SHARED.get(system, set()), f"{name} imports {other}"
    shown = {floor: {name for name in study.paths if _floor(name) == floor} for floor in FLOORS}
    for name in set().union(*shown.values()) - shown["table"] - shown["systems"]:
        assert "torchsar.study.systems." not in study.paths[name].read_text(encoding="utf-8"), name


def test_the_monte_carlo_loop_knows_no_physics(study: _Study) -> None:
    for name, imports in study.imports.items():
        if _floor(name) == "montecarlo":
            general = ("torchsar.study", "torchsar.core", "torchsar.io", "torchsar.plot", "torchsar.metrics.intervals")
            outside = {one for one in imports if not one.startswith(general)}
            assert not outside and "torchsar.study.names" not in {one.rpartition(".")[0] for one in imports}, name


def test_types_come_by_plain_imports(study: _Study) -> None:
    """An import for types alone would hide a circle; the face needs one to stay lazy."""
    for name, path in study.paths.items():
        assert ("TYPE_CHECKING" in path.read_text(encoding="utf-8")) == (name == "torchsar.study"), name
