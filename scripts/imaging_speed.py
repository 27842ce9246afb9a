"""Images along any path: speed and error of tiles, the direct sum, polar format and the package
fastsar.

    python scripts/imaging_speed.py [--pulses 512] [--frequencies 1024] [--pixels 512]
        [--errors -72 -80 -90] [--threads 1] [--rounds 9] [--small] [--memory]

X band at 5 km and 45 deg depression, 600 MHz, a straight path over which the resolution in azimuth
equals that in range, pixels of 0.2 m. All forms run in turn in one process; the time is the median
of the rounds. `x fastsar` is the median of the time of fastsar's exact form over that of this form
in the same round: above 1 is faster. `kept` reuses the plan, `moved` also computes the tables of a
changed path, `new` plans anew. The direct sum forms a part of the pixels, and its time is scaled to
all. Errors are relative to sums over all samples in float64, at random pixels: of the image of
white noise, and of the image of points that lie next to some of these pixels. That of polar format
is mostly the neglected curvature of the wavefront. fastsar (extra `peer`; it needs a C++ compiler,
its factorised form also jax) is left out where it is not installed. `--memory` measures, in a
process of its own, the processor time and the peak memory of planning and imaging, above that of
the libraries and relative to history and image.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar import keep_freed_memory
from torchsar.core import Axis
from torchsar.focus import ImageGrid, PolarOperator, TilePlan, backproject, image_tiles
from torchsar.radar import LIGHT_M_S, Spotlight, range_profiles

CARRIER_HZ, BANDWIDTH_HZ, RANGE_M, STEP_M = 10e9, 600e6, 5e3, 0.2
# share of the pixels that the direct sum forms
_DIRECT_SHARE = 16
EXACT = "fastsar exact, upsample 8"
# name of a form, times of the rounds in s, errors of points and of noise in dB
Row = tuple[str, list[float], float, float]


@dataclass(frozen=True)
class Scene:
    """Frequencies, positions (pulse, 3), reference path (pulse,) and pixels."""

    frequency_hz: Tensor
    place_m: Tensor
    reference_m: Tensor
    grid: ImageGrid

    @classmethod
    def of(cls, pulses: int, frequencies: int, pixels: int) -> Scene:
        aperture = BANDWIDTH_HZ / CARRIER_HZ
        angle = (torch.arange(pulses, dtype=torch.float64) / pulses - 0.5) * aperture
        side = torch.full_like(angle, RANGE_M * math.sqrt(0.5))
        place = torch.stack([RANGE_M * torch.tan(angle), -side, side], -1)
        step = BANDWIDTH_HZ / frequencies
        frequency = CARRIER_HZ + step * (torch.arange(frequencies, dtype=torch.float64) - frequencies // 2)
        corner = torch.tensor([-(pixels // 2) * STEP_M] * 2 + [0.0], dtype=torch.float64)
        grid = ImageGrid(corner, torch.eye(3, dtype=torch.float64)[:2], (pixels, pixels), STEP_M)
        return cls(frequency, place, 2 * torch.linalg.vector_norm(place, dim=-1), grid)

    def turns(self, points_m: Tensor) -> Tensor:
        """Phase of points (point, 3) in turns, float64 (point, pulse, frequency)."""
        path = 2 * torch.linalg.vector_norm(points_m[:, None] - self.place_m, dim=-1) - self.reference_m
        turns = path[..., None] * (self.frequency_hz / LIGHT_M_S)
        return turns - turns.round()

    def echo(self, points_m: Tensor) -> Tensor:
        """History of unit points, complex64 (pulse, frequency)."""
        return sum(torch.exp(-2j * math.pi * self.turns(part)).sum(0) for part in points_m.split(8)).to(torch.complex64)

    def direct(self, history: Tensor, i: Tensor, j: Tensor) -> Tensor:
        """Pixels (i, j) by the sum over all samples, complex128 (pixel,)."""
        pixels = self.grid.origin_m + self.grid.step_m * (
            i[:, None] * self.grid.axes[0] + j[:, None] * self.grid.axes[1]
        )
        exact = history.to(torch.complex128)
        return torch.cat(
            [(exact * torch.exp(2j * math.pi * self.turns(part))).sum((-2, -1)) for part in pixels.split(8)]
        )


def error_db(image: Tensor, truth: Tensor, i: Tensor, j: Tensor) -> float:
    """Rms error of pixels (i, j) relative to their rms, in dB."""
    found = image[i, j].to(torch.complex128)
    return 10 * math.log10(float((found - truth).abs().square().sum() / truth.abs().square().sum()))


def tile_forms(scene: Scene, errors: list[float]) -> dict[str, Callable[[Tensor], Tensor]]:
    """Forms of the tile imager."""
    forms: dict[str, Callable[[Tensor], Tensor]] = {}
    path = scene.place_m, None, scene.reference_m
    for wanted in errors:
        plan = TilePlan(scene.frequency_hz, *path, scene.grid, wanted)
        name = f"tiles {wanted:g} dB"
        forms[f"{name}, kept"] = plan.image
        forms[f"{name}, moved"] = lambda history, plan=plan: plan.moved(*path).image(history)
        forms[f"{name}, new"] = lambda history, wanted=wanted: image_tiles(
            history, scene.frequency_hz, *path, scene.grid, wanted
        )
    return forms


def polar_form(scene: Scene) -> Callable[[Tensor], Tensor]:
    """Polar format with the plane waves of the middle of the scene, a kernel of -60 dB."""
    n, start = scene.grid.counts[0], float(scene.grid.origin_m[0])
    waves = Spotlight(scene.frequency_hz, scene.place_m[:, [1, 0, 2]], scene.reference_m / 2).far_field()
    axes = [Axis(name, n, start, STEP_M, "m") for name in ("azimuth", "range")]
    operator = PolarOperator(waves, *axes, eps=1e-3)
    return lambda history: operator.image(range_profiles(history))


def peer_forms(scene: Scene) -> dict[str, Callable[[Tensor], Tensor]]:
    """Forms of the package fastsar, none where it is not installed."""
    try:
        import fastsar
    except ImportError:
        return {}
    grid, f = scene.grid, scene.frequency_hz
    axes = [axis.numpy() for axis in grid.axes]
    size = scene.place_m.numpy(), float(f[0]), float(f[1] - f[0]), len(f), *grid.counts, grid.step_m, grid.step_m, *axes
    given = {"backend": "cpu", "window": False, "ref": scene.reference_m.numpy() / 2}
    forms = {
        EXACT: fastsar.ExactFormer(*size, **given),
        "fastsar exact, upsample 16": fastsar.ExactFormer(*size, upsample=16, **given),
    }
    try:
        forms["fastsar factorised"] = fastsar.ImageFormer(*size, **given)
    except (ImportError, ValueError) as why:  # no jax, or a size that it does not divide
        print(f"fastsar factorised: left out, {why}")
    return {name: lambda history, form=form: torch.as_tensor(form(history.numpy())) for name, form in forms.items()}


def measure(scene: Scene, errors: list[float], rounds: int, checked: int = 100) -> list[Row]:
    """Times and errors of every form."""
    source = torch.Generator().manual_seed(0)
    size = len(scene.place_m), len(scene.frequency_hz)
    noise = torch.randn(*size, generator=source, dtype=torch.complex64)
    i, j = (torch.randint(0, n, (checked,), generator=source) for n in scene.grid.counts)
    near = torch.stack([i, j], -1)[: min(25, checked)]
    shift = torch.rand(len(near), 2, generator=source, dtype=torch.float64) - 0.5
    targets = scene.grid.origin_m + STEP_M * (near + shift) @ scene.grid.axes
    points = scene.echo(targets)
    truth = [scene.direct(history, i, j) for history in (points, noise)]
    forms = {**peer_forms(scene), **tile_forms(scene, errors), "polar format": polar_form(scene)}
    quality = {
        name: [error_db(form(history), exact, i, j) for history, exact in zip((points, noise), truth, strict=True)]
        for name, form in forms.items()
    }
    path = scene.place_m, None, scene.reference_m
    some = scene.grid.pixels_m(slice(0, max(1, scene.grid.counts[0] // _DIRECT_SHARE)))

    def direct(history: Tensor, pixels: Tensor = some) -> Tensor:
        return backproject(history, scene.frequency_hz, *path, pixels, eps=1e-5)

    at = scene.grid.pixels_m()[i, j]
    quality["direct sum"] = [
        error_db(direct(history, at)[:, None], exact, torch.arange(checked), torch.zeros(checked, dtype=torch.int64))
        for history, exact in zip((points, noise), truth, strict=True)
    ]
    forms["direct sum"] = direct
    times: dict[str, list[float]] = {name: [] for name in forms}
    for _ in range(rounds):
        for name, form in forms.items():
            start = time.perf_counter()
            form(noise)
            times[name].append(time.perf_counter() - start)
    return [(name, times[name], *quality[name]) for name in forms]


def report(scene: Scene, rows: list[Row]) -> None:
    """Print a table."""
    print(f"{'form':28}{'ms':>9}{'G pulse*pixel/s':>17}{'x fastsar':>11}{'points dB':>11}{'noise dB':>10}")
    exact = next((times for name, times, *_ in rows if name == EXACT), None)
    pixels = math.prod(scene.grid.counts)
    for name, times, points, noise in rows:
        part = max(1, scene.grid.counts[0] // _DIRECT_SHARE) / scene.grid.counts[0] if name == "direct sum" else 1.0
        whole = [seconds / part for seconds in times]
        middle = statistics.median(whole)
        ratio = "" if exact is None else f"{statistics.median(a / b for a, b in zip(exact, whole, strict=True)):.2f}"
        rate = len(scene.place_m) * pixels / middle / 1e9
        print(f"{name:28}{1e3 * middle:9.1f}{rate:17.3f}{ratio:>11}{points:11.1f}{noise:10.1f}")


def peak_bytes() -> int:
    """Peak resident memory of this process, from the system where it says so."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return next(int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM"))


def _child(scene: Scene, wanted: float) -> None:
    """Print time and peak memory of one image, planned anew."""
    small = Scene.of(32, 32, 32)
    image_tiles(torch.zeros(32, 32, dtype=torch.complex64), small.frequency_hz, small.place_m, None, small.reference_m,
                small.grid, wanted)  # fmt: skip
    before = peak_bytes()
    history = torch.randn(len(scene.place_m), len(scene.frequency_hz), dtype=torch.complex64)
    start = time.process_time()
    image = image_tiles(history, scene.frequency_hz, scene.place_m, None, scene.reference_m, scene.grid, wanted)
    seconds, peak = time.process_time() - start, peak_bytes() - before
    i, j = (torch.randint(0, n, (20,)) for n in scene.grid.counts)
    error = error_db(image, scene.direct(history, i, j), i, j)
    print(json.dumps({"seconds": seconds, "times": peak / (history.nbytes + image.nbytes), "error_db": error}))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pulses", type=int, default=512)
    parser.add_argument("--frequencies", type=int, default=1024)
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--errors", type=float, nargs="+", default=[-72.0, -80.0, -90.0])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--small", action="store_true", help="64 pulses, frequencies and pixels, one round")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    size = (64, 64, 64) if options.small else (options.pulses, options.frequencies, options.pixels)
    torch.set_num_threads(options.threads)
    scene = Scene.of(*size)
    if options.child:
        _child(scene, options.errors[0])
        return
    if options.memory:
        own = [sys.executable, __file__, "--child", "--threads", str(options.threads)]
        for name, n in zip(("pulses", "frequencies", "pixels"), size, strict=True):
            own += [f"--{name}", str(n)]
        for wanted in options.errors:
            done = subprocess.run([*own, "--errors", str(wanted)], check=True, capture_output=True, text=True)
            found = json.loads(done.stdout)
            seconds, times, error = (found[key] for key in ("seconds", "times", "error_db"))
            print(f"tiles {wanted:g} dB, new: {seconds:.1f} s of processor time, error {error:.1f} dB")
            print(f"peak memory {times:.2f} x history and image")
        return
    keep_freed_memory()
    report(scene, measure(scene, options.errors, 1 if options.small else options.rounds))


if __name__ == "__main__":
    main()
