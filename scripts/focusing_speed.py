"""Focusing: time as a multiple of bare FFTs, peak memory, and what each form loses against the
exact one.

    python scripts/focusing_speed.py [--sizes 2048 4096] [--threads 1 2] [--trials 1] [--memory]

`floor` is torch.fft.ifft2(torch.fft.fft2(x)) of the same array in the same process. The loss is
that of a point target at the edge of the swath: image error against Stolt in complex128 at full
accuracy, range and azimuth width and side lobes of the response. `peak arrays` (--memory) is the
peak memory above the process before the raw matrix exists, in raw matrices, measured in a process
of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from torchsar import keep_freed_memory
from torchsar.core import Axis, Draws, Signal
from torchsar.echo import simulate
from torchsar.focus import OmegaK, OmegaKStolt, RangeDoppler, StoredOmegaK
from torchsar.metrics import error_db, impulse_response
from torchsar.radar import LinearFM, StripmapRadar
from torchsar.scene import Dwell, Points, StripmapWorld

Form = Callable[[Signal], Signal]
FORMS: dict[str, Callable[[StripmapRadar, tuple[Axis, ...]], Form]] = {
    "stored bulk + refocus": lambda radar, axes: StoredOmegaK(OmegaK(radar, "flat"), axes),
    "bulk + refocus": lambda radar, axes: OmegaK(radar, "flat"),
    "Stolt": lambda radar, axes: OmegaKStolt(radar, "flat"),
    "range-Doppler": lambda radar, axes: RangeDoppler(radar, "flat"),
}


@dataclass(frozen=True)
class Row:
    """One form at one size: times over the floor, loss of a target at the edge of the swath."""

    form: str
    size: int
    threads: int
    seconds: float
    ratio: float
    loss_db: float
    irw_range_m: float
    pslr_range_db: float
    irw_azimuth_m: float
    pslr_azimuth_db: float


def sensor(size: int) -> StripmapRadar:
    """A Kondor-like radar whose pulse fits a line of `size` samples."""
    return StripmapRadar(
        3.2e9, LinearFM(200e6, min(2e-6, size / 8 / 250e6)), 250e6, 4000.0, 7000.0, 700e3, pointing_doppler_hz=0.0
    )


def best_seconds(work: Callable[[], object], repeats: int) -> float:
    """Least wall time of `repeats` runs after one that warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def edge_target(size: int) -> tuple[Signal, tuple[float, float]]:
    """Raw matrix (complex64) of one target at a tenth from the far edge of the swath, and its
    position in the image.
    """
    radar = sensor(size)
    usable_m = (size - radar.pulse_samples) * radar.range_step_m
    dwell = 0.5 * size / radar.prf_hz
    recording, _ = simulate(radar, StripmapWorld(Points([0.0], [0.4 * usable_m]), Dwell(dwell)), size, size, Draws(0))
    signal = recording.signal
    return signal, (size // 2 / radar.prf_hz * radar.velocity_m_s, radar.near_range_m + 0.9 * usable_m)


def measure(sizes: list[int], threads: list[int], trials: int = 1, repeats: int = 5) -> list[Row]:
    """Every form at every size and thread count.

    trials > 1: a batch of random matrices instead of a single one.
    """
    rows, before = [], torch.get_num_threads()
    for size in sizes:
        radar, (target, position) = sensor(size), edge_target(size)
        flat = Signal(target.data.reshape(size, size), target.axes)
        exact = OmegaKStolt.form(
            flat.data.to(torch.complex128),
            radar,
            doppler_hz=0.0,
            reference=OmegaK(radar, "flat").spectrum(size),
            eps=1e-12,
        )
        raw = Signal(
            torch.randn((trials, size, size) if trials > 1 else (size, size), dtype=torch.complex64), target.axes
        )
        quality = {name: quality_of(build(radar, raw.axes)(flat), exact, position) for name, build in FORMS.items()}
        for count in threads:
            torch.set_num_threads(count)
            floor = best_seconds(lambda: torch.fft.ifft2(torch.fft.fft2(raw.data)), repeats)  # noqa: B023
            rows.append(Row("floor: fft2 + ifft2", size, count, floor, 1.0, *[float("nan")] * 5))
            for name, build in FORMS.items():
                form = build(radar, raw.axes)
                seconds = best_seconds(lambda: form(raw), repeats)  # noqa: B023
                rows.append(Row(name, size, count, seconds, seconds / floor, *quality[name]))
    torch.set_num_threads(before)
    return rows


def quality_of(
    image: Signal, exact: torch.Tensor, position: tuple[float, float]
) -> tuple[float, float, float, float, float]:
    """Image error in dB; -3 dB width and highest side lobe in range and in azimuth."""
    response = impulse_response(image, position)
    keys = ("irw_range_m", "pslr_range_db", "irw_azimuth_m", "pslr_azimuth_db")
    range_width, range_lobe, azimuth_width, azimuth_lobe = (float(response[key]) for key in keys)
    return float(error_db(image.data.to(torch.complex128), exact)), range_width, range_lobe, azimuth_width, azimuth_lobe


def peak_arrays(form: str, size: int) -> float:
    """Peak memory of focusing one matrix in a fresh process, above that process before the matrix
    exists, in raw matrices.
    """
    done = subprocess.run(
        [sys.executable, __file__, "--child", form, "--sizes", str(size)], check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout)["arrays"]


def peak_bytes() -> int:
    """Peak resident memory of this process.

    Linux counts the parent's in ru_maxrss, so its own figure is read where there is one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        return next(int(line.split()[1]) * 1024 for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _child(form: str, size: int) -> None:
    torch.set_num_threads(1)
    keep_freed_memory()  # as the commands do
    radar = sensor(size)
    small = radar.raw_axes(256, 512)
    # loads the libraries
    FORMS[form](radar, small)(Signal(torch.zeros(256, 512, dtype=torch.complex64), small))
    before = peak_bytes()
    axes = radar.raw_axes(size, size)
    raw = Signal(torch.randn(size, size, dtype=torch.complex64), axes)
    FORMS[form](radar, axes)(raw)
    print(json.dumps({"arrays": (peak_bytes() - before) / raw.data.nbytes}))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[2048, 4096])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.child:
        _child(options.child, options.sizes[0])
        return
    print(
        f"{'form':24}{'size':>6}{'threads':>8}{'ms':>9}{'x floor':>9}{'loss dB':>9}"
        f"{'IRW rg m':>10}{'PSLR':>8}{'IRW az m':>10}{'PSLR':>8}"
    )
    for row in measure(options.sizes, options.threads, options.trials):
        quality = (
            f"{row.loss_db:9.1f}{row.irw_range_m:10.3f}{row.pslr_range_db:8.2f}"
            f"{row.irw_azimuth_m:10.3f}{row.pslr_azimuth_db:8.2f}"
        )
        print(
            f"{row.form:24}{row.size:6}{row.threads:8}{row.seconds * 1e3:9.1f}{row.ratio:9.2f}"
            + (quality if row.form in FORMS else "")
        )
    if options.memory:
        print("\npeak arrays (raw matrix included):")
        for size in options.sizes:
            for form in FORMS:
                print(f"{form:24}{size:6}{peak_arrays(form, size):8.2f}")


if __name__ == "__main__":
    main()
