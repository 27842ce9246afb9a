"""A letter E of 62 points seen by a moving triangular-sweep ladar: figures 10 to 12 and Table 3 of
Remote Sens. 2024, 16, 793.

    python scripts/ladar_letter.py [--out ladar_letter] [--seed 1] [--snr-db 20] [--small]

Two tables: one with random phases of the points, and one with equal phases. With equal phases on a
regular grid, a wrong image has less entropy than the true one. Compare methods by the residual
phase: 4 pi / lambda times the rms range error, without constant and slope.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

import torch

from torchsar import plot
from torchsar.compensate import (
    CompensateMotion,
    CorrectPulsePhase,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
)
from torchsar.core import Axis, Chain, Draws, Signal, Trace, use
from torchsar.echo import simulate_ladar
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.metrics import contrast, entropy
from torchsar.metrics.radial_motion import course_of, finer_in_range
from torchsar.radar import LIGHT_M_S, TriangularLadar
from torchsar.scene import LadarWorld, LetterE, Polynomial, QuadraticInSweep, Sinusoid

RADAR = TriangularLadar(
    LIGHT_M_S / 1.55e-6, bandwidth_hz=5e9, period_s=16e-6, sample_rate_hz=64e6, speed_m_s=60.0, reference_range_m=3000.0
)
MOTION = (
    Polynomial((0.35, 10.0)),
    Sinusoid(160e-6, 100.0, 17.19),
    Sinusoid(10e-6, 330.0, 57.30),
)  # 0.35 m/s and 20 m/s^2; phases of 0.3 and 1 rad
SCENE_M = (-1.5, 1.5)
PUBLISHED = {
    "uncompensated": (11.4919, 0.2375),
    "cross-correlation": (11.4081, 0.3146),
    "segmented, summed": (11.3471, 0.3433),
}


def methods() -> dict[str, Chain]:
    """Chains by name; all but the last differ in the estimator alone.

    "ideal" is for the recording without motion.
    """
    compress, deramp, image = (
        CompressSweeps(RADAR, window_m=SCENE_M),
        DerampAzimuth(RADAR),
        AzimuthMatchedFilter(RADAR, beam_rad=114e-6),
    )
    compensate = use(CompensateMotion(RADAR), velocity_m_s="motion")
    estimators = {
        "cross-correlation": SpectrumCorrelation(RADAR, upsampling=20),
        "segmented, at one peak": SegmentedInterference(
            RADAR
        ),  # points 5 cm apart merge in half sweeps, whose cell is 6 cm
        "segmented, summed": SegmentedInterference(RADAR, bins="sum", unwrap="per_pulse", window_m=SCENE_M),
    }
    return {
        "uncompensated": Chain(compress=compress, deramp=deramp, image=image),
        **{
            name: Chain(motion=motion, compensate=compensate, compress=compress, deramp=deramp, image=image)
            for name, motion in estimators.items()
        },
        "recommended": Chain(
            motion=RadialMotion(RADAR, window_m=(-2.5, 2.5)),
            compensate=compensate,
            compress=compress,
            deramp=deramp,
            correct=use(CorrectPulsePhase(), phase_rad="motion"),
            image=image,
        ),
        "ideal": Chain(compress=compress, deramp=deramp, image=image),
    }


def run(
    scene: LetterE, n_period: int, seed: int, snr_db: float
) -> tuple[dict[str, Trace], dict[str, tuple[float, ...]]]:
    """What every method made of one letter, and its figures: entropy (nats), contrast of the
    amplitude, residual (rad).
    """
    world = LadarWorld(scene, MOTION, snr_db=snr_db, fidelity=QuadraticInSweep())
    recording, truth = simulate_ladar(RADAR, world, n_period, Draws(seed))
    assert truth.clean is not None
    traces, figures = {}, {}
    for name, chain in methods().items():
        traces[name] = chain.trace(truth.clean if name == "ideal" else recording)
        left = course_of(chain, traces[name], truth.values, RADAR, clean=name == "ideal").metrics(RADAR)
        image = traces[name].signal
        figures[name] = (
            float(entropy(image)),
            float(contrast(image, of="amplitude")),
            float(left["residual_phase_rms_rad"]),
        )
    return traces, figures


def show(title: str, figures: Mapping[str, tuple[float, ...]], published: Mapping[str, tuple[float, float]]) -> None:
    """Print a table, a row a method."""
    print(f"{title:26}{'entropy':>10}{'published':>11}{'contrast':>11}{'published':>11}{'residual (rad)':>16}")
    for name, (nats, spread, residual) in figures.items():
        theirs = [f"{x:.4f}" for x in published[name]] if name in published else ["-", "-"]
        print(f"{name:26}{nats:10.4f}{theirs[0]:>11}{spread:11.4f}{theirs[1]:>11}{residual:16.3f}")


def draw(traces: Mapping[str, Trace], scene: LetterE, out: Path) -> None:
    """Figure 10: the scene; figures 11 and 12: range profiles and images."""
    points = scene.scatterers(Draws(0))
    plot.save(
        plot.scatterers(
            plot.array(points.range_m),
            plot.array(points.azimuth_m),
            plot.array(points.amplitude.abs()),
            "range (m)",
            "azimuth (m)",
            "62 points",
            "auto",
        ),
        out / "figure_10.png",
    )
    names = ["uncompensated", "cross-correlation", "segmented, summed"]
    profiles = {name: in_milliseconds(about_letter(traces[name].outputs["compress"])) for name in names}
    plot.save(plot.images(profiles, dynamic_range_db=40, percentile=100), out / "figure_11.png", columns=3)
    images = {
        name: about_letter(finer_in_range(finer_in_range(traces[name].signal)))
        for name in [*names, "segmented, at one peak", "recommended", "ideal"]
    }
    plot.save(
        plot.images(images, dynamic_range_db=25, percentile=100, reference="ideal"), out / "figure_12.png", columns=3
    )


def about_letter(signal: Signal) -> Signal:
    """Relative ranges of -0.7 to 0.9 m, with room for the shift of beats by the velocity, and
    azimuths of an image about the letter.
    """
    bounds = {}
    for name, edges in {"range": (-0.7, 0.9), "azimuth": (-0.12, 0.12)}.items():
        if name in signal.names:
            first, last = (round(float(signal.axis(name).index_of(edge))) for edge in edges)
            bounds[name] = max(first, 0), min(last, signal.axis(name).n)
    return signal.crop(**bounds)


def in_milliseconds(profiles: Signal) -> Signal:
    pulse, range_ = profiles.axes
    return Signal(profiles.data, (Axis("slow time", pulse.n, 1e3 * pulse.start, 1e3 * pulse.step, "ms"), range_))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("ladar_letter"), help="folder of the figures")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--snr-db", type=float, default=20.0, help="per sample before compression, of one point")
    parser.add_argument("--small", action="store_true", help="half the aperture")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    n_period = 256 if options.small else 512
    with torch.no_grad():
        traces, figures = run(LetterE(), n_period, options.seed, options.snr_db)
        _, trapped = run(LetterE(random_phase=False), n_period, options.seed, options.snr_db)
    show("Table 3, random phases", figures, PUBLISHED)
    print("Published entropies belong to an image of another size and noise: only their order compares.\n")
    show("The trap: equal phases", trapped, {})
    draw(traces, LetterE(), options.out)


if __name__ == "__main__":
    main()
