"""Entropy of the image as a function of the assumed rotation: position, width and orientation of
its minimum.

    python scripts/rotation_landscape.py [--out rotation_landscape] [--seed 1] [--snr-db 20]
    [--small]

Cuts through the truth over k1, k2, the Legendre coefficients q2 and q3 of the warp, and the rate,
for image lines of 1, 1/2 and 1/4 of a Doppler cell; a map over k1 and k2;
and the gradient of automatic differentiation beside differences. A satellite of 300 scatterers.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import EntropyObjective, ImageEntropy
from torchsar.core import Draws, Signal
from torchsar.echo import simulate_turntable
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

OMEGA_RAD_S, WARP_K = 0.02, torch.tensor([10.0, 1000.0], dtype=torch.float64)
OVERSAMPLINGS = (1.0, 2.0, 4.0)
SIZES = {  # pulse rate, pulses, range cells and their size, scatterers, half width
    "mid": (500e3, 10000, 32, 0.24, 300, 6.43),
    "tiny": (50e3, 1000, 32, 0.24, 60, 0.643),
}
CUTS = {
    "k1": ("raw", 1, 0.1),
    "k2": ("raw", 2, 0.1),
    "q2": ("shape", 1, 0.1),
    "q3": ("shape", 2, 0.3),
    "Om": ("raw", 0, 0.5),
}  # variables, entry, relative reach


@dataclass(frozen=True)
class Cut:
    """Entropy (value,) along one unknown, given as its ratio to the truth."""

    ratio: Tensor
    entropy: Tensor

    @staticmethod
    def through(figure: ImageEntropy, entry: int, reach: float, points: int) -> Cut:
        """Through the truth. The middle of an odd number of points is the truth itself."""
        ratio = torch.linspace(1 - reach, 1 + reach, points, dtype=torch.float64)
        x = figure.start(OMEGA_RAD_S, WARP_K).repeat(points, 1)
        x[:, entry] = x[:, entry] * ratio
        with torch.no_grad():
            return Cut(ratio, figure(x))

    @property
    def minimum(self) -> float:
        """Ratio at the vertex of the parabola through the least value and its neighbours, or the
        end of the cut where that is least.
        """
        i = int(self.entropy.argmin())
        if i in (0, len(self.ratio) - 1):
            return float(self.ratio[i])
        below, here, above = (float(e) for e in self.entropy[i - 1 : i + 2])
        return float(self.ratio[i]) + 0.5 * (below - above) / (below - 2 * here + above) * float(
            self.ratio[1] - self.ratio[0]
        )

    @property
    def minima(self) -> int:
        """How many local minima lie inside the cut."""
        inner = self.entropy[1:-1]
        return int(((inner < self.entropy[:-2]) & (inner < self.entropy[2:])).sum())


def simulated(size: str, seed: int, snr_db: float) -> tuple[Signal, InverseRadar]:
    prf_hz, n_pulse, n_range, cell_m, count, half_width_m = SIZES[size]
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)
    world = TurntableWorld(
        Satellite(count, half_width_m), rotation=PolynomialRotation(OMEGA_RAD_S, WARP_K), snr_db=snr_db
    )
    return simulate_turntable(radar, world, n_pulse, n_range, Draws(seed))[0].signal, radar


def cuts(signal: Signal, radar: InverseRadar, points: int) -> dict[tuple[str, float], Cut]:
    """Every cut with every oversampling of the image lines."""
    found = {}
    for name, (variables, entry, reach) in CUTS.items():
        for oversampling in OVERSAMPLINGS:
            figure = ImageEntropy.of(signal, radar, EntropyObjective(variables=variables, oversampling=oversampling))
            found[name, oversampling] = Cut.through(figure, entry, reach, points)
    return found


def valley(figure: ImageEntropy, points: int) -> tuple[Tensor, Tensor, Tensor]:
    """Relative k1 and k2 (value,), and entropy (k2, k1) at the true rate."""
    ratio = torch.linspace(0.95, 1.05, points, dtype=torch.float64)
    k2, k1 = torch.meshgrid(ratio, ratio, indexing="ij")
    x = figure.start(OMEGA_RAD_S, WARP_K).repeat(points * points, 1)
    x[:, 1], x[:, 2] = x[:, 1] * k1.flatten(), x[:, 2] * k2.flatten()
    with torch.no_grad():
        return ratio, ratio, figure(x).reshape(points, points)


def gradients(figure: ImageEntropy, ratio: float) -> tuple[Tensor, Tensor]:
    """Slope of the entropy per relative change of each unknown, at `ratio` times the truth: by
    automatic differentiation, and by central differences.
    """
    x = ratio * figure.start(OMEGA_RAD_S, WARP_K)
    _, slope = figure.with_gradient(x)
    step = 1e-6 * torch.diag(x)
    with torch.no_grad():
        differences = (figure(x + step) - figure(x - step)) / 2e-6
    return slope * x, differences


def draw(found: dict[tuple[str, float], Cut], ratio: Tensor, grid: Tensor, out: Path) -> None:
    parts = []
    for name in CUTS:
        series = {
            f"os {o:g}": (
                plot.array(found[name, o].ratio),
                plot.array(found[name, o].entropy - found[name, o].entropy.min()),
            )
            for o in OVERSAMPLINGS
        }
        parts.append(
            {
                "series": series,
                "xlabel": f"{name} over its true value",
                "ylabel": "entropy above the least (nats)",
                "title": name,
                "marks": {"truth": 1.0},
            }
        )
    plot.save(plot.panels(parts), out / "cuts.png", columns=3)
    part = {
        "title": "image lines half a Doppler cell apart",
        "x": plot.array(ratio),
        "y": plot.array(ratio),
        "z": plot.array(grid),
    }
    plot.save(
        plot.heat_map([part], "k1 over its true value", "k2 over its true value", "entropy (nats)"), out / "valley.png"
    )


def lean(ratio: Tensor, grid: Tensor) -> float:
    """dk1 / dk2 (s) along the valley, by least squares on where each row of constant k2 is
    least.
    """
    lowest = ratio[grid.argmin(-1)]
    inside = (lowest > ratio[0]) & (lowest < ratio[-1])
    x, y = 1000 * (ratio[inside] - ratio[inside].mean()), 10 * (lowest[inside] - lowest[inside].mean())
    return float((x * y).sum() / (x * x).sum())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("rotation_landscape"), help="folder of the figures")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--snr-db", type=float, default=20.0)
    parser.add_argument("--small", action="store_true", help="a tiny target, few points")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    signal, radar = simulated("tiny" if options.small else "mid", options.seed, options.snr_db)
    found = cuts(signal, radar, 11 if options.small else 41)
    print(
        f"{'minimum of the entropy (%)':32}"
        + "".join(f"{f'os {o:g}':>10}" for o in OVERSAMPLINGS)
        + f"{'minima inside the cut':>26}"
    )
    for name in CUTS:
        line = [found[name, o] for o in OVERSAMPLINGS]
        print(
            f"{name:32}"
            + "".join(f"{100 * (cut.minimum - 1):>10.2f}" for cut in line)
            + f"{' '.join(str(cut.minima) for cut in line):>26}"
        )
    figure = ImageEntropy.of(signal, radar)
    ratio, _, grid = valley(figure, 11 if options.small else 25)
    print(
        f"\nalong the valley dk1 / dk2 is {1e3 * lean(ratio, grid):.2f} ms, -T / 2 is "
        f"{-5e2 * signal.axis('pulse').n / radar.prf_hz:.2f} ms"
    )
    fine = ImageEntropy.of(signal.with_data(signal.data.to(torch.complex128)), radar, EntropyObjective(taps=12))
    for x in (0.99, 1.01):
        for name, auto, difference in zip(("Om", "k1", "k2"), *gradients(fine, x), strict=True):
            print(
                f"slope over {name} at {x:g} x the truth: {float(auto):.6f} by autograd, "
                f"{float(difference):.6f} by differences"
            )
    draw(found, ratio, grid, options.out)


if __name__ == "__main__":
    main()
