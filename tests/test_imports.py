"""What may import what, and what the package needs."""

from __future__ import annotations

import ast
import subprocess
import sys
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


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide what is imported"
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module or ""}
    return found


def test_core_and_stages_need_only_torch_and_numpy() -> None:
    modules = ["torchsar", *(_module(path) for path in CORE)]
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
        if path.name != "plot.py":
            assert not any(name.startswith("matplotlib") for name in _imports(path)), path
