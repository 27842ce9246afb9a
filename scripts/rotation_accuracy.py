"""The matched Fourier transform by accuracy and time: kernels of 2 to 8 taps, two grids, both
precisions, beside interpolation and a compiled library.

    python scripts/rotation_accuracy.py [--out rotation_accuracy] [--rounds 5] [--small]

A satellite of 300 scatterers at 20 dB (its Doppler at 93 % of the pulse rate),
one thread. Errors against the sum itself: of the image, rms over rms; of the entropy, nats. Times
are the best of the rounds, in turn: of the transform, and of the whole objective of a search (range
phase, transform, entropy).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import keep_freed_memory, plot
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_turntable
from torchsar.focus import CompiledNufft, DopplerLines, ExplicitSum, Gridding, Resampling, matched_fourier, range_phase
from torchsar.focus.transforms import Transform
from torchsar.metrics import entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

OMEGA_RAD_S, WARP_K = 0.02, torch.tensor([10.0, 1000.0], dtype=torch.float64)
TAPS, GRIDS = (2, 3, 4, 5, 6, 7, 8), (1.25, 2.0)
SIZES = {  # pulse rate, pulses, range cells and their size, scatterers, half width
    "mid": (500e3, 10000, 32, 0.24, 300, 6.43),
    "tiny": (50e3, 1000, 32, 0.24, 60, 0.643),
}
EXPECTED = {
    (4, 1.25): 4e-3,
    (4, 2.0): 4e-4,
    (6, 1.25): 2e-4,
    (6, 2.0): 4e-6,
    (8, 2.0): 4e-8,
}  # error of the image, from a separate program


@dataclass(frozen=True)
class Method:
    """A method to compute the image."""

    name: str
    transform: Transform


@dataclass
class Cost:
    """Errors of image and entropy, best seconds of transform and objective."""

    image: float = math.nan
    entropy: float = math.nan
    transform_s: float = math.inf
    objective_s: float = math.inf


def methods() -> list[Method]:
    kernels = [
        Method(f"{taps} taps, grid {grid:g}", Gridding(taps, oversampling=grid)) for grid in GRIDS for taps in TAPS
    ]
    others = [
        Method("linear resampling + FFT", Resampling("linear")),
        Method("spline resampling + FFT", Resampling("spline")),
    ]
    return [*kernels, *others, *compiled()]


def compiled() -> list[Method]:
    """The compiled library at the accuracies of 4 and 6 taps, where it is installed."""
    try:
        import finufft  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        print("finufft is not installed (pip install 'torchsar-lab[nufft]'): no comparison with the compiled library")
        return []
    return [Method(f"finufft, eps {eps:g}", CompiledNufft(eps)) for eps in (1e-3, 1e-6)]


@dataclass(frozen=True)
class Objective:
    """What a search evaluates, step by step so that each can be timed."""

    signal: Signal
    radar: InverseRadar

    def flat(self) -> Tensor:
        return range_phase(
            self.signal.data,
            self.signal.axis("range").values(),
            self.radar.wavelength_m,
            self.radar.prf_hz,
            OMEGA_RAD_S,
            WARP_K,
        )

    def image(self, flat: Tensor, method: Method) -> Tensor:
        return matched_fourier(flat, WARP_K, self.radar.prf_hz, lines=DopplerLines(1.0), transform=method.transform)

    def value(self, method: Method) -> Tensor:
        return entropy(self.image(self.flat(), method))


def simulated(size: str) -> Objective:
    """In double precision."""
    prf_hz, n_pulse, n_range, cell_m, count, half_width_m = SIZES[size]
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)
    world = TurntableWorld(
        Satellite(count, half_width_m), rotation=PolynomialRotation(OMEGA_RAD_S, WARP_K), snr_db=20.0
    )
    return Objective(
        simulate_turntable(radar, world, n_pulse, n_range, Draws(1), dtype=torch.complex128)[0].signal, radar
    )


def seconds(work: Callable[[], object]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def measured(objective: Objective, choices: Sequence[Method], exact: Tensor, rounds: int) -> dict[str, Cost]:
    """Errors and times of every method."""
    table, flat = {}, objective.flat()
    for method in choices:
        image = objective.image(flat, method).to(exact.dtype)
        error = (image - exact).abs().square().mean().sqrt() / exact.abs().square().mean().sqrt()
        table[method.name] = Cost(float(error), abs(float(entropy(image) - entropy(exact))))
    for _ in range(rounds):
        for method in choices:
            cost = table[method.name]
            cost.transform_s = min(cost.transform_s, seconds(lambda method=method: objective.image(flat, method)))
            cost.objective_s = min(cost.objective_s, seconds(lambda method=method: objective.value(method)))
    return table


def show(table: Mapping[str, Cost], title: str) -> None:
    expected = {f"{taps} taps, grid {grid:g}": value for (taps, grid), value in EXPECTED.items()}
    print(
        f"{title:28}{'image error':>13}{'entropy error':>15}{'transform (ms)':>16}{'objective (ms)':>16}"
        f"{'expected':>10}"
    )
    for name, cost in table.items():
        known = f"{expected[name]:.0e}" if name in expected else "-"
        print(
            f"{name:28}{cost.image:>13.1e}{cost.entropy:>15.1e}{1e3 * cost.transform_s:>16.2f}"
            f"{1e3 * cost.objective_s:>16.2f}{known:>10}"
        )


def beside_compiled(table: Mapping[str, Cost]) -> None:
    """Time of the cheapest objective that is as accurate as the compiled library, over that of the
    library's.
    """
    for name, cost in table.items():
        if name.startswith("finufft"):
            rivals = {rival: c for rival, c in table.items() if "taps" in rival and c.image <= cost.image}
            best = min(rivals, key=lambda rival: rivals[rival].objective_s, default=None)
            if best is not None:
                print(
                    f"{best} takes {rivals[best].objective_s / cost.objective_s:.2f} times the objective "
                    f"of {name}, at errors of {rivals[best].image:.0e} and {cost.image:.0e}"
                )


def draw(tables: Mapping[str, Mapping[str, Cost]], out: Path) -> None:
    """Error of the image and of the entropy against time, one line for each grid and precision."""
    parts = []
    for what in ("image", "entropy"):
        series = {}
        for precision, table in tables.items():
            for grid in GRIDS:
                costs = [table[f"{taps} taps, grid {grid:g}"] for taps in TAPS]
                levels = [math.log10(max(getattr(cost, what), 1e-12)) for cost in costs]
                series[f"{precision}, grid {grid:g}"] = (
                    np.array([1e3 * cost.transform_s for cost in costs]),
                    np.array(levels),
                )
        parts.append(
            {
                "series": series,
                "xlabel": "time of a transform (ms)",
                "ylabel": f"lg of the error of the {what}",
                "title": f"2 to 8 taps: {what}",
            }
        )
    plot.save(plot.panels(parts), out / "accuracy.png")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("rotation_accuracy"), help="folder of the figure")
    parser.add_argument("--rounds", type=int, default=5, help="of timing")
    parser.add_argument("--small", action="store_true", help="a tiny target, one round")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    torch.set_num_threads(1)
    keep_freed_memory()  # as the commands do
    double, choices = simulated("tiny" if options.small else "mid"), methods()
    exact = double.image(double.flat(), Method("exact", ExplicitSum()))
    tables = {}
    for precision, dtype in (("float32", torch.complex64), ("float64", torch.complex128)):
        objective = Objective(double.signal.to(dtype), double.radar)
        tables[precision] = measured(objective, choices, exact, 1 if options.small else options.rounds)
        show(tables[precision], precision)
        beside_compiled(tables[precision])
        print()
    draw(tables, options.out)


if __name__ == "__main__":
    main()
