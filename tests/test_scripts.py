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
    from torchsar.study.stripmap.run import check
    from torchsar.study.sweeping import sweep_grid

    whole, swept = readme_blocks("yaml")
    path = tmp_path / "readme.yaml"
    path.write_text(whole, encoding="utf-8")
    check(load(str(path)))
    path.write_text(whole + swept, encoding="utf-8")
    assert sweep_grid(load(str(path))).shape == (3, 2, 2)


def readme_blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)


def test_the_sweep_of_the_readme_runs(tmp_path: Path) -> None:
    script = next(block for block in readme_blocks("python") if "def trial(" in block)
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-1000:]
    assert (tmp_path / "out" / "mean" / "results.zarr").is_dir()
    rmse = [float(x) for x in re.findall(r"\d\.\d+(?:e-\d+)?", done.stdout)]
    # the median of Gaussian noise is worse than the mean
    assert rmse[0] < 0.15 and rmse[3] > rmse[0]


def test_the_benchmark_of_sweeps_runs(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "scripts" / "sweep_speed.py"),
        "stripmap_doppler",
        "--trials",
        "4",
        "--rounds",
        "1",
        "processor.recommended.stages.velocity.lines=16",
        "world.lines=384",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-1000:]
    for name in ("one by one", "one batch", "automatic ", "automatic, 2 workers"):
        assert re.search(rf"^{name} +\d+ +\d+\.\d+", done.stdout, re.MULTILINE), done.stdout


def test_autofocus_is_composed(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "scripts" / "compose_autofocus.py"),
        "--trials",
        "2",
        "--candidates",
        "2",
        "--pulses",
        "64",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-1000:]
    rows = {
        line[:32].strip(): [float(x) for x in line[32:].split()]
        for line in done.stdout.splitlines()
        if re.search(r"\d\.\d{3}$", line)
    }
    assert all(len(row) == 6 for row in rows.values()) and len(rows) == 6
    middle = {name: sorted(row)[2] for name, row in rows.items()}
    assert middle["polynomial, region"] < 0.1 < middle["polynomial, whole image"]
    assert (tmp_path / "compose_autofocus.png").read_bytes().startswith(b"\x89PNG")


def test_the_benchmark_of_ladar_estimators_runs(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "scripts" / "ladar_speed.py"),
        "--trials",
        "2",
        "--rounds",
        "1",
        "--periods",
        "32",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-1000:]
    for precision in ("complex64", "complex128"):
        assert re.search(rf"^{precision}: 2 trials of 32 periods x 2 x 512 samples", done.stdout, re.MULTILINE), (
            done.stdout
        )
    over = [float(x) for x in re.findall(r"^radial_motion(?: +[\d.]+){3} +([\d.]+)", done.stdout, re.MULTILINE)]
    # of the bound with unknown phases; known ones halve it
    assert len(over) == 2 and all(0.4 < x < 0.7 for x in over)


def test_readme_points_at_files_that_exist() -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text(encoding="utf-8")):
        assert target.startswith("http") or (ROOT / target).exists(), target
