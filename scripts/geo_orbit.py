"""Range from a GEO satellite to the point that it sees, as a Taylor series in time.

    python scripts/geo_orbit.py [--out geo_orbit] [--small]

The orbit is that of Remote Sens. 2020, 12, 1703. The paper states that |k2| is at most about 0.03
m/s2 and that the phase of k3 stays below 1e-4 pi within the integration time.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.radar import range_coefficients, seen_point
from torchsar.radar.orbit import EARTH_GRAVITY_M3_S2
from torchsar.reproduce.geo.sensor import INTEGRATION_S, OFF_NADIR_DEG, ORBIT, RADAR


def coefficients(n: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Times of an orbit (s) and k1..k4 there (time, order), by the direction of the look: across
    the path, ahead, and between.
    """
    time = torch.linspace(
        0, 2 * math.pi * math.sqrt(float(ORBIT.semi_major_m) ** 3 / EARTH_GRAVITY_M3_S2), n, dtype=torch.float64
    )
    looks = {
        f"squint {squint:g} deg": seen_point(*ORBIT.state(time), OFF_NADIR_DEG, squint) for squint in (0.0, 45.0, 90.0)
    }
    return time, {name: range_coefficients(ORBIT, point, time) for name, point in looks.items()}


def draw_coefficients(time: Tensor, found: dict[str, Tensor], out: Path) -> None:
    parts = []
    limits = ((-400.0, 250.0), None, (-7e-7, 15e-7), None)  # room for the legend
    for i, (unit, ylim) in enumerate(zip(("m/s", "m/s2", "m/s3", "m/s4"), limits, strict=True)):
        series = {name: (plot.array(time / 3600), plot.array(k[:, i])) for name, k in found.items()}
        parts.append(
            {
                "series": series,
                "xlabel": "time along the orbit (h)",
                "ylabel": f"k{i + 1} ({unit})",
                "title": f"k{i + 1}",
                "ylim": ylim,
            }
        )
    plot.save(plot.panels(parts), out / "coefficients.png")


def show_orbit(found: dict[str, Tensor]) -> None:
    print(f"{'transmit range':34}{'k1 (m/s)':>12}{'k2 (m/s2)':>12}{'k3 (m/s3)':>12}{'k4 (m/s4)':>12}")
    for name, k in found.items():
        print(f"{f'largest, {name}':34}" + "".join(f"{float(x):>12.4g}" for x in k.abs().amax(0)))
    every = torch.stack(list(found.values()))
    half, to_rad = INTEGRATION_S / 2, 2 * math.pi / RADAR.wavelength_m
    phases = [to_rad * float(every[..., i].abs().max()) * half ** (i + 1) for i in range(4)]
    print(f"{'phase at 2.25 s (rad)':34}" + "".join(f"{phase:>12.3g}" for phase in phases))
    print(
        "published: |k2| at most about 0.03, phase of k3 below 1e-4 pi = 3.1e-4 rad; expected: "
        "|k1| to 376, k2 -0.0146 to 0.0208, phase of k3 2.7e-4 rad"
    )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("geo_orbit"), help="folder of the figures")
    parser.add_argument("--small", action="store_true", help="coarser grids")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    time, found = coefficients(37 if options.small else 361)
    show_orbit(found)
    draw_coefficients(time, found, options.out)


if __name__ == "__main__":
    main()
