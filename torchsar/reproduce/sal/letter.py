"""A letter E of 62 points seen by a moving triangular-sweep ladar: figures 10 to 12 and Table 3 of
Remote Sens. 2024, 16, 793.

Entropies and contrasts depend on the size of the image and on the noise, which the paper does not
give; only their order is therefore compared. The phases of the points are random. With points of
equal phase on a regular grid, a wrong image would have less entropy than the true one. Methods are
also judged by the residual phase: 4 pi / lambda times the rms range error, without constant and
slope.
"""

from __future__ import annotations

from pathlib import Path

from torchsar import plot
from torchsar.compensate import SegmentedInterference, SpectrumCorrelation
from torchsar.core import Draws, Signal, Stage, Trace
from torchsar.echo import simulate_ladar
from torchsar.metrics import contrast, entropy
from torchsar.reproduce.item import Check, Item, falling, number, seeds_of
from torchsar.reproduce.sal.points import MOTION, RADAR, methods
from torchsar.scene import LadarWorld, LetterE, QuadraticInSweep
from torchsar.study.systems.sal.figures import in_milliseconds
from torchsar.study.systems.sal.judge import course_of, finer_in_range

# relative ranges of the letter (m), and SNR (dB) per sample of one point before compression
SCENE_M, SNR_DB = (-1.5, 1.5), 20.0
# methods in the order of the columns of Table 3, along which entropies fall and contrasts rise
SHOWN = ("uncompensated", "cross-correlation", "segmented, summed")


Traces = dict[str, Trace]
Rows = dict[str, list[list[float]]]


def _letter(small: bool) -> tuple[Traces, Rows]:
    """Results of every method for the first draw, and by method the entropies (nats), amplitude
    contrasts and residuals (rad) of all draws.
    """
    runs = [_run(256 if small else 512, seed) for seed in seeds_of(small)]
    numbers = {name: zip(*(of[name] for _, of in runs), strict=True) for name in runs[0][1]}
    return runs[0][0], {name: [list(each) for each in of] for name, of in numbers.items()}


def _run(n_period: int, seed: int) -> tuple[Traces, dict[str, tuple[float, float, float]]]:
    """Results and numbers of one draw. "ideal" is without motion."""
    world = LadarWorld(LetterE(), MOTION, snr_db=SNR_DB, fidelity=QuadraticInSweep())
    recording, truth = simulate_ladar(RADAR, world, n_period, Draws(seed))
    assert truth.clean is not None
    estimators: dict[str, Stage] = {
        "cross-correlation": SpectrumCorrelation(RADAR, upsampling=20),
        # points 5 cm apart are not resolved in half sweeps, whose range cell is 6 cm
        "segmented, at one peak": SegmentedInterference(RADAR),
        "segmented, summed": SegmentedInterference(RADAR, bins="sum", unwrap="per_pulse", window_m=SCENE_M),
    }
    chains = methods(estimators, (-2.5, 2.5), SCENE_M)
    traces, figures = {}, {}
    for name, chain in {**chains, "ideal": chains["uncompensated"]}.items():
        traces[name] = chain.trace(truth.clean if name == "ideal" else recording)
        left = course_of(chain, traces[name], truth.values, RADAR, clean=name == "ideal").metrics(RADAR)
        image = traces[name].signal
        of = (entropy(image), contrast(image, of="amplitude"), left["residual_phase_rms_rad"])
        figures[name] = (float(of[0]), float(of[1]), float(of[2]))
    return traces, figures


def _figure_10(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    points = LetterE().scatterers(Draws(0))
    x, y, level = (plot.array(value) for value in (points.azimuth_m, points.range_m, points.amplitude.abs()))
    plot.save(plot.scatterers(y, x, level, "range (m)", "azimuth (m)", "62 points", "auto"), path)
    return [number("points", 62, len(x), 0)]


def _figure_11(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    profiles = {name: in_milliseconds(_about_letter(seen[0][name].outputs["compress"])) for name in SHOWN}
    plot.save(plot.images(profiles, dynamic_range_db=40, percentile=100), path, columns=3)
    return [falling("residual phase (rad)", {name: seen[1][name][2] for name in SHOWN})]


def _figure_12(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    images = {
        name: _about_letter(finer_in_range(finer_in_range(seen[0][name].signal)))
        for name in [*SHOWN, "segmented, at one peak", "recommended", "ideal"]
    }
    plot.save(plot.images(images, dynamic_range_db=25, percentile=100, reference="ideal"), path, columns=3)
    return [falling("entropy (nats)", {name: seen[1][name][0] for name in SHOWN})]


def _table_3(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    entropies, contrasts = ({name: seen[1][name][which] for name in SHOWN} for which in (0, 1))
    return [
        falling("entropy (nats; published 11.4919, 11.4081, 11.3471)", entropies),
        falling("contrast (published 0.2375, 0.3146, 0.3433)", contrasts, rising=True),
    ]


def _about_letter(signal: Signal) -> Signal:
    """Part of a signal around the letter.

    It covers relative ranges of -0.7 to 0.9 m, with a margin for the shift of beat frequencies by
    the velocity, and azimuths around the letter.
    """
    part = signal.sel(range=slice(-0.7, 0.9))
    return part.sel(azimuth=slice(-0.12, 0.12)) if "azimuth" in part.names else part


ITEMS = (
    Item("Figure 10", "scene of 62 points", of=_letter, make=_figure_10),
    Item("Figure 11", "range profiles of three methods", of=_letter, make=_figure_11),
    Item("Figure 12", "images of three methods, and of the recommended one", of=_letter, make=_figure_12),
    Item("Table 3", "entropy and contrast of the images", _letter, _table_3),
)
