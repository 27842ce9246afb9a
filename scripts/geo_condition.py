"""Condition of the reconstruction of a Doppler band from three channels, over the pulse rate.

    python scripts/geo_condition.py [--out geo_condition] [--small]

Channels at equal distances sample the same positions twice at some pulse rates, where N Doppler
bands cannot be separated; channels at unequal distances do not.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.multichannel import (
    LeastSquares,
    PointMotion,
    condition_number,
    noise_gain_db,
)
from torchsar.radar import BistaticRadar
from torchsar.reproduce.geo.sensor import RADAR

UNEVEN = replace(RADAR, channel_m=(-0.8, 0.0, 0.75))
EXPECTED_PRF = (125.0, 160.0, 170.0, 180.0, 185.0, 187.0, 190.0, 195.0, 200.0, 250.0)
EXPECTED_CONDITION = {  # at EXPECTED_PRF, condition number and noise gain (dB)
    3: ((1, 2.7, 4.3, 10.2, 30.6, 153, 30.6, 10.2, 6.1, 1), (0, 2.6, 5.5, 12.2, 21.6, 35.5, 21.6, 12.2, 8.0, 0)),
    2: ((1, 1.31, 1.37, 1.41, 1.41, 1.41, 1.41, 1.41, 1.39, 1), (0, 0.3, 0.4, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0)),
}


def conditions(radar: BistaticRadar, rates: Tensor, bands: int) -> tuple[Tensor, Tensor]:
    """Condition number and noise gain (dB) of least squares for points at rest over pulse rates."""
    radars = [replace(radar, prf_hz=float(prf)) for prf in rates]
    at_rest = PointMotion.of(radar, torch.zeros((), dtype=torch.float64))
    return torch.stack([condition_number(r, at_rest, bands) for r in radars]), torch.stack(
        [noise_gain_db(r, at_rest, LeastSquares(bands)) for r in radars]
    )


def show_conditions() -> None:
    rates = torch.tensor(EXPECTED_PRF, dtype=torch.float64)
    print(f"\n{'pulse rate (Hz)':30}" + "".join(f"{prf:>8g}" for prf in EXPECTED_PRF))
    for bands, known in EXPECTED_CONDITION.items():
        for name, values, expected in zip(
            ("condition", "noise gain (dB)"), conditions(RADAR, rates, bands), known, strict=True
        ):
            print(f"{f'N = {bands}, {name}':30}" + "".join(f"{float(x) + 0.0:>8.2f}" for x in values))
            print(f"{'  expected':30}" + "".join(f"{x:>8g}" for x in expected))
        print(
            f"{f'N = {bands}, uneven, condition':30}"
            + "".join(f"{float(x):>8.2f}" for x in conditions(UNEVEN, rates, bands)[0])
        )
    print(
        "uneven: channels at -0.8, 0, 0.75 m; expected at 180 Hz: 5.8 with N = 3, 1.39 with "
        "N = 2; their outer two sample the same positions at 300 / 1.55 = 193.5 Hz"
    )


def draw_conditions(rates: Tensor, out: Path) -> None:
    """Condition and noise gain over the pulse rate; even channels sample the same positions twice
    at 187.5 Hz.
    """
    cases = {
        f"N = {bands}, {name}": conditions(radar, rates, bands)
        for bands in (3, 2)
        for name, radar in (("even", RADAR), ("uneven", UNEVEN))
    }
    labels = (
        ("condition number (dB)", lambda pair: 20 * torch.log10(pair[0])),
        ("noise gain (dB)", lambda pair: pair[1]),
    )
    parts = []
    for label, of in labels:
        series = {name: (plot.array(rates), plot.array(of(pair))) for name, pair in cases.items()}
        parts.append({"series": series, "xlabel": "pulse rate (Hz)", "ylabel": label, "ylim": (-2.0, 60.0)})
    plot.save(plot.panels(parts), out / "condition.png")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("geo_condition"), help="folder of the figures")
    parser.add_argument("--small", action="store_true", help="few pulse rates")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    show_conditions()
    draw_conditions(torch.arange(120.0, 250.1, 5.0 if options.small else 0.5, dtype=torch.float64), options.out)


if __name__ == "__main__":
    main()
