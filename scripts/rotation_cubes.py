"""Five corner cubes on a turntable, seen through turbulent air: figures 18 to 20 and Table 6 of
Remote Sens. 2025, 17, 3447.

    python scripts/rotation_cubes.py [--out rotation_cubes] [--seed 1] [--small]

A simulation in place of a recording that is not public: 10 degrees per second with a changing
rate, a random walk of phase of 0.15 rad per pulse, an SNR of 10 dB. A phase per pulse and the
rotation are estimated in turn. The error of each estimate biases the other one, so that one pass is
not enough.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    autofocus,
    coarse_rotation,
    correct_pulse_phase,
    descend_rotation,
    genetic_rotation,
    uneven_rotation,
)
from torchsar.core import Axis, Draws, Estimate, Signal, Truth
from torchsar.echo import simulate_turntable
from torchsar.focus import MatchedFourier, RangePhase, mean_rate
from torchsar.metrics import contrast, entropy
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.scene import Points, PolynomialRotation, TurntableWorld
from torchsar.study.names.factories import rotation_and_phase

RADAR = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * 0.015), 50e3)
CUBES = Points(azimuth_m=[-0.06, -0.03, 0.0, 0.03, 0.06], range_m=[0.09, -0.12, 0.0, 0.06, -0.06], random_phase=True)
ROTATION = PolynomialRotation(math.radians(10), (6.0, 1100.0))
PULSES, CELLS = 1000, 32
PUBLISHED = {
    "genetic": (0.2040, 6.1372, 1091.0),
    "search": (0.2, 6.0, 1200.0),
    "Gauss-Newton": (0.14, 5.998, 1570.0),
}  # of the paper's own recording
EXPECTED = {  # entropy and contrast, from a separate simulation of this scene
    "no compensation": (6.78, 13.9),
    "uniform autofocus": (6.39, 17.5),
    "autofocus + SM": (5.54, 24.5),
    "autofocus + third order": (5.14, 32.3),
    "alternation": (3.89, 53.0),
    "clean reference": (3.92, 53.0),
}


@dataclass(frozen=True)
class PhaseWalk:
    """A random walk of phase, step_rad (rms) a pulse."""

    step_rad: float

    def phase_rad(self, draws: Draws, n_pulse: int) -> Tensor:
        return self.step_rad * draws.normal("phase walk", (n_pulse,)).cumsum(-1)


def known_of(signal: Signal) -> dict:
    return {"wavelength_m": RADAR.wavelength_m, "prf_hz": RADAR.prf_hz, "range_m": signal.axis("range").values()}


def focused(signal: Signal, rotation: Mapping[str, Tensor] | None = None) -> Signal:
    """Image on a Doppler axis, with what is known of the rotation taken out: all of it, its warp
    alone, or nothing.
    """
    rotation = rotation or {}
    if "omega_rad_s" in rotation:
        signal = RangePhase(RADAR)(signal, **{name: rotation[name] for name in ("omega_rad_s", "warp_k", "yc_m")})
    return MatchedFourier(RADAR)(signal, rotation.get("warp_k"))


def second_order(signal: Signal) -> Estimate:
    """SM: one number, without a range term, by least entropy."""
    figure = ImageEntropy.of(signal, RADAR, EntropyObjective(order=2, range_term=False))
    return descend_rotation(
        figure, figure.start(0.0, coarse_rotation(signal.data, order=2, **known_of(signal))["warp_k"])
    )


def published(signal: Signal, generations: int) -> Estimate:
    """The genetic algorithm in a box of +-20 % about what the turntable was set to."""
    figure = ImageEntropy.of(signal, RADAR)
    centre = torch.tensor([math.radians(10), 6.0, 1100.0], dtype=torch.float64)
    return genetic_rotation(figure, 0.8 * centre, 1.2 * centre, draws=Draws(1), generations=generations)


@dataclass(frozen=True)
class Results:
    """Images on a Doppler axis, and estimates, by what was done."""

    images: dict[str, Signal]
    estimates: dict[str, Mapping[str, Tensor]]


def results(signal: Signal, truth: Truth, generations: int) -> Results:
    uniform = signal.with_data(correct_pulse_phase(signal.data, autofocus(signal.data)["phase_rad"]))
    second, genetic = second_order(uniform), published(uniform, generations)
    third = uneven_rotation(uniform.data, yc_m=0.0, **known_of(uniform))
    both = rotation_and_phase(RADAR)(signal)
    corrected = signal.with_data(correct_pulse_phase(signal.data, both["phase_rad"]))
    assert truth.clean is not None
    images = {
        "no compensation": focused(signal),
        "uniform autofocus": focused(uniform),
        "autofocus + SM": focused(uniform, {"warp_k": second["warp_k"]}),
        "autofocus + genetic": focused(uniform, genetic.value),
        "autofocus + third order": focused(uniform, third.value),
        "alternation": focused(corrected, both.value),
        "clean reference": focused(
            truth.clean.signal, {name: truth.values[name] for name in ("omega_rad_s", "warp_k", "yc_m")}
        ),
    }
    return Results(
        images,
        {"autofocus + genetic": genetic.value, "autofocus + third order": third.value, "alternation": both.value},
    )


def scale_m_hz(rotation: Mapping[str, Tensor]) -> float:
    """Metres of cross range per Hz of Doppler."""
    return RADAR.wavelength_m / (
        2 * float(mean_rate(rotation["omega_rad_s"], rotation["warp_k"], PULSES / RADAR.prf_hz))
    )


def scaled(image: Signal, rotation: Mapping[str, Tensor]) -> Signal:
    doppler, range_ = image.axes
    scale = scale_m_hz(rotation)
    return Signal(image.data, (Axis("azimuth", doppler.n, doppler.start * scale, doppler.step * scale, "m"), range_))


def close(image: Signal) -> Signal:
    """The middle of an image, which holds the cubes, over the peak."""
    over_peak = image.with_data(image.data / image.data.abs().max())
    return plot.within(over_peak, {"azimuth": (-0.09, 0.09), "range": (-0.15, 0.15)})


def table(found: Results, truth: Truth) -> None:
    """Table 6, and the estimates beside those of the paper's recording."""
    print(f"{'Table 6':26}{'entropy':>10}{'contrast':>10}{'expected':>10}{'expected':>10}")
    for name, image in found.images.items():
        known = EXPECTED.get(name, ("-", "-"))
        print(f"{name:26}{float(entropy(image)):>10.3f}{float(contrast(image)):>10.2f}{known[0]:>10}{known[1]:>10}")
    print(f"\n{'estimates':26}{'Om (rad/s)':>12}{'k1 (1/s)':>12}{'k2 (1/s2)':>12}")
    rows = {
        name: tuple(float(value[key]) for key in ("omega_rad_s", "k1_per_s", "k2_per_s2"))
        for name, value in found.estimates.items()
    }
    for name, row in (
        {"truth": (float(truth.values["omega_rad_s"]), 6.0, 1100.0)}
        | rows
        | {f"published, {name}": row for name, row in PUBLISHED.items()}
    ).items():
        print(f"{name:26}" + "".join(f"{value:>12.5g}" for value in row))


def draw_profiles(found: Results, truth: Truth, path: Path) -> None:
    """Figure 20: a profile through each of the cubes, every method, on the true scale; a random
    phase also shifts images, so that each is centred at its peak.
    """
    names = ("uniform autofocus", "autofocus + SM", "alternation", "clean reference")
    shown = {name: scaled(found.images[name], truth.values) for name in names}
    parts = []
    for number, (x, y) in enumerate(zip(CUBES.azimuth_m, CUBES.range_m, strict=True), start=1):
        series = {name: profile(image, float(y)) for name, image in shown.items()}
        parts.append(
            {
                "series": series,
                "xlabel": "cross range from the peak (m)",
                "ylabel": "amplitude (dB)",
                "title": f"cube {number}, x = {1e3 * x:g} mm",
                "ylim": (-40.0, 1.0),
            }
        )
    plot.save(plot.panels(parts), path, columns=3)


def profile(image: Signal, y_m: float, reach_m: float = 0.006) -> tuple:
    """Cross range from the peak (m) and amplitude (dB) of the range cell at y_m."""
    axis = image.axis("azimuth")
    line = image.data[:, int(image.axis("range").index_of(y_m).round())].abs()
    peak, half = int(line.argmax()), round(reach_m / axis.step)
    part = line[max(0, peak - half) : peak + half + 1]
    offset = (torch.arange(len(part)) + max(0, peak - half) - peak) * axis.step
    return plot.array(offset), plot.decibel(part)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("rotation_cubes"), help="folder of the figures")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="a genetic algorithm of two generations")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    world = TurntableWorld(CUBES, rotation=ROTATION, start_phase=[PhaseWalk(0.15)], snr_db=10.0)
    recording, truth = simulate_turntable(RADAR, world, PULSES, CELLS, Draws(options.seed))
    found = results(recording.signal, truth, 2 if options.small else 30)
    table(found, truth)
    x, y, level = (plot.array(truth.values[name]) for name in ("cross_range_m", "range_m", "amplitude"))
    plot.save(
        plot.scatterers(y, x, abs(level), "range (m)", "cross range (m)", "corner cubes"), options.out / "figure_18.png"
    )
    names = {
        "a: uniform autofocus": "uniform autofocus",
        "b: second order (SM)": "autofocus + SM",
        "c: third order": "autofocus + third order",
        "d: alternation": "alternation",
    }
    shown = {
        title: close(scaled(found.images[name], found.estimates.get(name, truth.values)))
        for title, name in names.items()
    }
    plot.save(plot.images(shown, 40, percentile=100), options.out / "figure_19.png")
    draw_profiles(found, truth, options.out / "figure_20.png")


if __name__ == "__main__":
    main()
