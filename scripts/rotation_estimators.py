"""Every estimator of uneven rotation on the same data: evaluations, CPU time and error.

The times are beside those of Remote Sens. 2025, 17, 3447.

    python scripts/rotation_estimators.py [--out rotation_estimators] [--seed 1] [--snr-db 20]
    [--genetic-seeds 5] [--small]

A satellite of 300 scatterers, complex64, one thread. Searches get what the
paper gives them: a box of +-10 % about the truth, or a start at 0.9, 1.0 or 1.1 times it. The grid
is searched on a part of its points; its time in full is that of a point times their number. The
coarse stage, the phase fit and the recommended estimator get nothing but the data, and estimate the
range centre deviation as well; the coarse stage gives no rate.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch

from torchsar import plot
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    coarse_rotation,
    entropy_rotation,
    uneven_rotation,
)
from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_turntable
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

TRUTH = torch.tensor([0.02, 10.0, 1000.0], dtype=torch.float64)
LOW, HIGH = 0.9 * TRUTH, 1.1 * TRUTH
GRID = (5, 21, 201)  # points of the paper's grid, 21105 in all, and of the part that is searched
PART = (3, 5, 7)
PUBLISHED_S = {"grid": 156177.0, "genetic": 1202.0, "newton": 172.0}
SIZES = {  # pulse rate, pulses, range cells and their size, scatterers, half width
    "mid": (500e3, 10000, 32, 0.24, 300, 6.43),
    "tiny": (50e3, 1000, 32, 0.24, 60, 0.643),
}


@dataclass(frozen=True)
class Run:
    """What an estimator cost and how far it is from the truth, in % of (Om, k1, k2)."""

    evaluations: float
    seconds: float
    error: tuple[float, float, float]
    ok: bool
    found: Estimate


def timed(find: Callable[[], Estimate], rounds: int) -> Run:
    """Median CPU time of so many calls."""
    seconds = []
    for _ in range(rounds):
        began = time.process_time()
        found = find()
        seconds.append(time.process_time() - began)
    values = torch.stack([found[name] for name in ("omega_rad_s", "k1_per_s", "k2_per_s2")])
    error = 100 * (values / TRUTH - 1)
    return Run(
        float(found.info.get("evaluations", torch.tensor(math.nan))),
        statistics.median(seconds),
        tuple(error.tolist()),
        bool(found.ok),
        found,
    )


@dataclass
class Bench:
    """The data, their objectives, and the table as it grows."""

    signal: Signal
    radar: InverseRadar
    runs: dict[str, Run] = field(default_factory=dict)

    def figure(self, oversampling: float, variables: str = "raw") -> ImageEntropy:
        return ImageEntropy.of(
            self.signal, self.radar, EntropyObjective(oversampling=oversampling, variables=variables)
        )

    def add(self, name: str, find: Callable[[], Estimate], rounds: int = 1) -> None:
        """Run, keep and print."""
        run = self.runs[name] = timed(find, rounds)
        count = "-" if math.isnan(run.evaluations) else f"{run.evaluations:.0f}"
        print(
            f"{name:34}{count:>8}{run.seconds:>10.2f}"
            + "".join(f"{e:>11.4f}" for e in run.error)
            + f"{'yes' if run.ok else 'no':>5}",
            flush=True,
        )

    @property
    def known(self) -> dict:
        return {
            "wavelength_m": self.radar.wavelength_m,
            "prf_hz": self.radar.prf_hz,
            "range_m": self.signal.axis("range").values(),
        }


def simulated(size: str, seed: int, snr_db: float) -> Bench:
    prf_hz, n_pulse, n_range, cell_m, count, half_width_m = SIZES[size]
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)
    world = TurntableWorld(
        Satellite(count, half_width_m), rotation=PolynomialRotation(0.02, (10.0, 1000.0)), snr_db=snr_db
    )
    return Bench(simulate_turntable(radar, world, n_pulse, n_range, Draws(seed))[0].signal, radar)


def without_box(bench: Bench, rounds: int) -> None:
    """What needs the data alone, short enough to be timed several times; the first call in a
    process is slower.
    """
    bench.add("coarse", lambda: coarse_rotation(bench.signal.data, **bench.known), rounds)
    bench.add("coarse + phase fit", lambda: coarse_rotation(bench.signal.data, **bench.known, fits=4), rounds)
    bench.add("recommended", lambda: uneven_rotation(bench.signal.data, **bench.known), rounds)


def from_starts(bench: Bench, steps: int, forms: tuple[str, ...], oversamplings: tuple[float, ...]) -> None:
    """Newton's method in each form of the variables, which is what the paper calls Gauss-Newton,
    and the quasi-Newton method with a line search.
    """
    for factor, variables in itertools.product((0.9, 1.0, 1.1), forms):
        for damped in (False, True):
            name = f"Newton{' damped' if damped else ''} x{factor:g} {variables}"
            figure = bench.figure(2.0, variables)
            bench.add(
                name,
                lambda f=figure, x=factor, d=damped: entropy_rotation(
                    f, "newton", f.start(x * TRUTH[0], x * TRUTH[1:]), damped=d, steps=steps
                ),
            )
    for oversampling in oversamplings:
        for factor in (0.9, 1.1):
            figure = bench.figure(oversampling, "shape")
            bench.add(
                f"quasi-Newton x{factor:g} shape, os {oversampling:g}",
                lambda f=figure, x=factor: entropy_rotation(f, "descent", f.start(x * TRUTH[0], x * TRUTH[1:])),
            )


def in_box(bench: Bench, seeds: int, generations: tuple[int, int, int]) -> None:
    """The genetic algorithm with as many evaluations as the paper's time allows and with many more,
    and differential evolution.
    """
    few, many, evolved = generations
    for oversampling in (1.0, 2.0):
        figure = bench.figure(oversampling)
        for seed in range(1, seeds + 1):
            bench.add(
                f"GA 6 x {few}, os {oversampling:g}, seed {seed}",
                lambda f=figure, s=seed: entropy_rotation(
                    f, "genetic", (LOW, HIGH), draws=Draws(s), population=6, generations=few
                ),
            )
        bench.add(
            f"GA 30 x {many}, os {oversampling:g}",
            lambda f=figure: entropy_rotation(f, "genetic", (LOW, HIGH), draws=Draws(1), generations=many),
        )
    bench.add(
        f"differential evolution 24 x {evolved}",
        lambda: entropy_rotation(bench.figure(2.0), "evolution", (LOW, HIGH), draws=Draws(1), generations=evolved),
    )


def on_grid(bench: Bench, counts: tuple[int, ...]) -> float:
    """A part of the paper's grid, of the same extent.

    Returns the seconds that all of it would take.
    """
    axes = [
        torch.linspace(float(low), float(high), n, dtype=torch.float64)
        for low, high, n in zip(LOW, HIGH, counts, strict=True)
    ]
    name = f"grid {' x '.join(map(str, counts))}"
    bench.add(name, lambda: entropy_rotation(bench.figure(2.0), "grid", axes))
    whole = bench.runs[name].seconds * math.prod(GRID) / math.prod(counts)
    print(
        f"{f'grid {GRID[0]} x {GRID[1]} x {GRID[2]}, extrapolated':34}{math.prod(GRID):>8}"
        f"{whole:>10.0f}{'half a step of the grid: 2.5, 0.5, 0.05':>40}"
    )
    return whole


def ratios(bench: Bench, grid_s: float) -> None:
    """CPU time over that of the recommended estimator, beside what the paper measured against its
    own genetic algorithm.
    """
    own = bench.runs["recommended"]
    print(f"\n{'over the recommended estimator':34}{'time':>8}{'|Om|':>10}{'|k1|':>10}{'|k2|':>10}")
    for name, run in bench.runs.items():
        if name.startswith("GA"):
            worse = [abs(theirs) / max(abs(ours), 1e-12) for theirs, ours in zip(run.error, own.error, strict=True)]
            print(f"{name:34}{run.seconds / own.seconds:>8.1f}" + "".join(f"{ratio:>10.3g}" for ratio in worse))
    print(f"{'grid, extrapolated':34}{grid_s / own.seconds:>8.0f}")
    print(
        f"published: grid {PUBLISHED_S['grid']:.0f} s, genetic {PUBLISHED_S['genetic']:.0f} "
        f"s, Gauss-Newton {PUBLISHED_S['newton']:.0f} s"
    )


def draw(bench: Bench, path: Path) -> None:
    """Time against error, of one run of each kind."""
    kinds = (
        "phase fit",
        "recommended",
        "Newton damped x1 raw",
        "Newton damped x1.1 raw",
        "quasi-Newton x0.9",
        "seed 1",
        "GA 30",
        "evolution",
    )
    shown = {
        name.replace(", seed 1", ""): run for name, run in bench.runs.items() if any(kind in name for kind in kinds)
    }
    error = [20 * math.log10(max(math.sqrt(sum(e * e for e in run.error) / 3), 1e-4)) for run in shown.values()]
    plot.save(
        plot.trade(
            list(shown),
            [run.seconds for run in shown.values()],
            error,
            "rms error of (Om, k1, k2) (dB of 1 %)",
            "estimators of uneven rotation",
        ),
        path,
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("rotation_estimators"), help="folder of the figure")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--snr-db", type=float, default=20.0, help="mean power of all samples over the variance of the noise"
    )
    parser.add_argument("--genetic-seeds", type=int, default=5, help="runs of the short genetic algorithm")
    parser.add_argument("--small", action="store_true", help="a tiny target and short searches")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    torch.set_num_threads(1)
    bench = simulated("tiny" if options.small else "mid", options.seed, options.snr_db)
    print(f"{'estimator':34}{'evals':>8}{'CPU s':>10}{'Om (%)':>11}{'k1 (%)':>11}{'k2 (%)':>11}{'ok':>5}")
    without_box(bench, 1 if options.small else 5)
    if options.small:
        from_starts(bench, 1, ("raw",), (1.0,))
    else:
        from_starts(bench, 20, ("raw", "shape"), (1.0, 2.0, 4.0))
    in_box(
        bench, 1 if options.small else options.genetic_seeds, (3, 2, 2) if options.small else (39, 30, 36)
    )  # 162, 870 and 888 evaluations
    ratios(bench, on_grid(bench, (1, 2, 2) if options.small else PART))
    draw(bench, options.out / "time_and_error.png")


if __name__ == "__main__":
    main()
