"""Use an installed wheel of torchsar as a user does: every command, and one experiment per system.

Called by .ci/package, from an empty folder, with the folder of the repository and the sdist.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
import tarfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import torchsar
from torchsar import cli, datasets
from torchsar.study.settings.text import dump, packaged_configs, read_tree
from torchsar.study.table import SYSTEMS

# a packaged config of each system, and what makes it small
RUNS = {
    "stripmap": (
        "stripmap_damaged",
        *("world.lines=384", "world.samples=1024", "world.beam.dwell_s=0.06", "radar.integration_s=0.06"),
        "world.scene.field.count=20",
    ),
    "isal": ("isal_table1", "world.trials=1"),
    "isal_rotation": ("isal_corner_cubes", "world.trials=1"),
    "sal": ("sal_letter_e", "world.periods=128"),
    "geo": ("geo_velocity_scnr",),
    "geo_ocean": (
        *("geo_ocean", "world.pulses=810", "world.samples=112", "world.targets.ship1.range_m=-200"),
        *("world.targets.ship2.range_m=0", "world.targets.ship3.range_m=150"),
    ),
    "path": ("path_autofocus",),
}
SWEEP = ("isal_snr", "sweep.trials=2", "sweep.world.noise.snr_db=[10]")
# methods that take the place of the recommended one, which takes long
QUICK = {"geo_ocean": "conventional"}
SIDECAR = """system: isal
samples: {key: profiles, dtype: complex64, shape: [64, 32], dims: [pulse, range]}
radar: {f0_hz: 10 GHz, bandwidth_hz: 500 MHz, prf_hz: 200, range_step_m: 0.3}
"""


def command(*words: str) -> str:
    """Run a command of the program and return what it prints."""
    began, out = time.perf_counter(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()) as said:
        status = cli.main(words)
    if status:
        sys.exit(f"torchsar {' '.join(words)} ended with status {status}:\n{said.getvalue()}")
    print(f"{time.perf_counter() - began:6.1f} s  torchsar {' '.join(words)}"[:120], flush=True)
    return out.getvalue()


def own_config(name: str) -> str:
    """Write a packaged config to a file, with its best method and first case alone."""
    path = Path(f"own_{name}.yaml")
    path.write_text(command("config", "show", name), encoding="utf-8")
    tree = read_tree(path)
    reference = tree.get("metrics", {}).get("reference", "recommended")
    kept = {method: tree["processor"][method] for method in {reference: 0, "recommended": 0}}
    kept["recommended"] = tree["processor"][QUICK.get(name, "recommended")]
    cases = dict(list(tree.get("cases", {}).items())[:1])
    metrics = {key: value for key, value in tree.get("metrics", {}).items() if key != "published"}
    limits = [method for method in tree.get("beyond_limits", ()) if method in kept]
    path.write_text(
        dump({**tree, "processor": kept, "cases": cases, "metrics": metrics, "beyond_limits": limits}), encoding="utf-8"
    )
    return str(path)


def main(repository: Path, sdist: Path) -> None:
    """Use everything that the wheel installs; ends with a message if something fails."""
    package = Path(torchsar.__file__).parent
    assert package.is_relative_to(sys.prefix), package
    assert not any(Path(entry).is_relative_to(repository) for entry in sys.path if Path(entry).name != "site-packages")
    configs = packaged_configs()
    assert all(path.is_relative_to(package) for path in configs.values()), configs
    assert {path.name for path in configs.values()} == {path.name for path in (repository / "configs").rglob("*.yaml")}
    for name in ("py.typed", "CITATION.cff"):
        assert (package / name).is_file(), name
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    wanted = ("LICENSE", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "Makefile", "constraints.txt", "docs/conf.py")
    assert {*wanted, "tests/conftest.py", "docs/index.md", "scripts/first_image.py"} <= packed, packed

    assert "omega_k" in command("list")
    assert json.loads(command("config", "schema"))["definitions"]
    assert command("config", "show", "spotlight").startswith("# yaml-language-server")
    assert all(command("completion", shell) for shell in ("bash", "zsh", "fish"))
    for system in SYSTEMS:
        recording, _ = datasets.example(system)
        assert bool(recording.signal.data.abs().isfinite().all())
        name, *small = RUNS[system]
        command("run", own_config(name), *small, "--out", f"run_{system}")
        assert (Path(f"run_{system}") / "report.html").is_file()
    name, *small = SWEEP
    command("sweep", own_config(name), *small, "--out", "sweep")
    command("reproduce", "geo", "figure17", "--small", "--out", "papers")
    command("requires", "stripmap_damaged", "--out", "requires")
    if find_spec("h5py"):
        command("export", "run_stripmap", "--to", "netcdf", "--out", "images")
    Path("radar.yaml").write_text(SIDECAR, encoding="utf-8")
    np.ones((64, 32), np.complex64).tofile("raw.bin")
    command("import", "raw.bin", "--sidecar", "radar.yaml", "--out", "recording.npz")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
