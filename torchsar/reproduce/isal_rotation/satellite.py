"""A satellite with non-uniform rotation: figures 4 to 12 and Tables 1 and 2 of Remote Sens. 2025,
17, 3447, with a procedural satellite in place of the one that is not published.

The module computes four images: without compensation, as a sum of chirplets (ACL), with only the
acceleration removed (SM), and with the recommended estimate of the whole rotation. It computes the
positions of both panel tips in the image that is scaled to metres. It also applies Newton's method,
which the paper calls Gauss-Newton, to images of 8 lines per Doppler cell, beginning at 0.9, 1 and
1.1 times the truth. With fewer lines the least entropy lies farther from the truth (see
`EntropyObjective`). Numbers are means over scenes, each with noise of its own; pictures show the
first scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from torchsar import plot
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    chirplet_clean,
    entropy_rotation,
    uneven_rotation,
)
from torchsar.core import Axis, Draws, Estimate, Signal, Truth
from torchsar.echo import simulate_turntable
from torchsar.focus import MatchedFourier
from torchsar.focus.image_lines import mean_rate
from torchsar.metrics import entropy, impulse_response
from torchsar.radar import InverseRadar
from torchsar.reproduce.isal_rotation.profiles import (
    OMEGA_RAD_S,
    SNR_DB,
    WARP_K,
    focused,
    in_metres,
    known_of,
    ladar,
    second_order,
)
from torchsar.reproduce.item import Check, Item, falling, misprint, number, seeds_of, statement
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

ROTATION = PolynomialRotation(OMEGA_RAD_S, WARP_K)
# cross range (m) of the tips, as in Table 4
TIP_M = 6.43
# pulse rate, pulses, cells, cell size, scatterers and chirplets in the full and the reduced form,
# by choice
SIZES = {False: (500e3, 10000, 32, 0.24, 300, 16), True: (50e3, 1000, 32, 0.24, 60, 4)}
# lines per Doppler cell of the images that Newton's method uses
LINES_PER_CELL = 8.0
# estimates of the genetic algorithm in the text (rad/s, 1/s, 1/s2), and tolerances
PUBLISHED = {
    "omega_rad_s": (0.0202, 0.0004),
    "k1_per_s": (10.002, 0.02),
    "k2_per_s2": (999.6835, 2.0),
}
# Enlarged regions.
# REGIONS: middle in cross range in half widths of the target, and range (m).
# REGION_M: half their height (m), at which single scatterers are visible.
TIP = "A, tip of a panel"
REGIONS = {TIP: (-0.98, (-1.6, 1.6)), "B, bus and dish": (0.04, (-3.6, -0.4))}
REGION_M = 0.15
# names of the methods of the paper
SHOWN = ("no compensation", "chirplets (ACL)", "SM, order 2", "order 3, two-dimensional")


@dataclass(frozen=True)
class _Imaged:
    """Images in metres by method, the estimate, the truth and half the width of the target (m)."""

    shown: dict[str, Signal]
    estimate: Estimate
    truth: Truth
    half_width_m: float

    def whole(self, name: str) -> Signal:
        """Target in the image of a method, within 1.09 times its cross range."""
        return _cut(self.shown[name], 0.0, 1.09 * self.half_width_m, (-3.8, 3.8))

    def region(self, name: str, which: str) -> Signal:
        """One of the enlarged regions in the image of a method."""
        middle, range_m = REGIONS[which]
        return _cut(self.shown[name], middle * self.half_width_m, REGION_M, range_m)

    def outlines(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Outlines of the enlarged regions."""
        return {
            name: plot.boxes([((near + far) / 2, middle * self.half_width_m)], (far - near) / 2, REGION_M)
            for name, (middle, (near, far)) in REGIONS.items()
        }


def simulated(small: bool, seed: int) -> tuple[Signal, Truth, InverseRadar]:
    """Simulate a scene.

    Args:
        small: Whether to take the tiny satellite.
        seed: Seed of scene and noise.

    Returns:
        Range-compressed pulses, truth and ladar.
    """
    prf_hz, n_pulse, n_range, cell_m, count, _ = SIZES[small]
    radar = ladar(cell_m, prf_hz)
    world = TurntableWorld(Satellite(count, TIP_M * prf_hz / 500e3), rotation=ROTATION, snr_db=SNR_DB)
    recording, truth = simulate_turntable(radar, world, n_pulse, n_range, Draws(seed))
    return recording.signal, truth, radar


def _satellite(small: bool) -> list[_Imaged]:
    return [_imaged(small, seed) for seed in seeds_of(small)]


def _entropies(seen: list[_Imaged], *names: str) -> dict[str, list[float]]:
    return {name: [float(entropy(one.shown[name])) for one in seen] for name in names}


def _imaged(small: bool, seed: int) -> _Imaged:
    signal, truth, radar = simulated(small, seed)
    prf_hz, n_pulse, atoms, focus = radar.prf_hz, signal.axis("pulse").n, SIZES[small][-1], MatchedFourier(radar)
    estimate, uncompensated = uneven_rotation(signal.data, **known_of(signal, radar)), focus(signal)
    made = {
        "no compensation": uncompensated,
        "chirplets (ACL)": uncompensated.with_data(chirplet_clean(signal.data, prf_hz, atoms=atoms).image),
        "SM, order 2": focus(signal, second_order(signal, radar)["warp_k"]),
        "order 3, azimuth": focus(signal, estimate["warp_k"]),
        "order 3, two-dimensional": focused(signal, radar, estimate.value),
    }
    rate = mean_rate(estimate["omega_rad_s"], estimate["warp_k"], n_pulse / prf_hz)
    shown = {name: in_metres(x, radar, rate) for name, x in made.items()}
    return _Imaged(shown, estimate, truth, TIP_M * prf_hz / 500e3)


def _cut(image: Signal, middle_m: float, half_m: float, range_m: tuple[float, float]) -> Signal:
    return plot.within(image, {"azimuth": (middle_m - half_m, middle_m + half_m), "range": range_m})


def _figure_4(seen: list[_Imaged], path: Path) -> list[Check]:
    """Draw Figure 4, for which there are no published numbers."""
    x, y, level = (plot.array(seen[0].truth.values[name]) for name in ("cross_range_m", "range_m", "amplitude"))
    title = f"{len(x)} scatterers, with areas as their amplitudes"
    plot.save(plot.scatterers(y, x, abs(level), "range (m)", "cross range (m)", title), path)
    return []


def _draw(seen: _Imaged, name: str, path: Path) -> None:
    """Draw an image and two regions of it, in dB relative to its peak."""
    parts = {name: seen.whole(name)} | {which: seen.region(name, which) for which in REGIONS}
    plot.save(plot.images(parts, 40, percentile=100, lines={name: seen.outlines()}), path, columns=3)


def _figure_5(seen: list[_Imaged], path: Path) -> list[Check]:
    _draw(seen[0], "no compensation", path)
    return [falling("entropy (nats)", _entropies(seen, "no compensation", "order 3, two-dimensional"))]


def _figure_6(seen: list[_Imaged], path: Path) -> list[Check]:
    """Compare the numbers of samples above -30 dB relative to the peak."""
    _draw(seen[0], "chirplets (ACL)", path)
    names = ("chirplets (ACL)", "order 3, two-dimensional")
    levels = [[one.shown[name].data.abs() for one in seen] for name in names]
    few, all_ = ([int((x > 10**-1.5 * x.max()).sum()) for x in row] for row in levels)
    ours = f"{sum(few) / len(few):.0f} samples above -30 dB, {sum(all_) / len(all_):.0f} in the compensated image"
    holds = all(a < b for a, b in zip(few, all_, strict=True))
    return [statement("chirplets", "leave out weak parts of the target", holds, ours, len(seen))]


def _figure_7(seen: list[_Imaged], path: Path) -> list[Check]:
    _draw(seen[0], "SM, order 2", path)
    return [falling("entropy (nats)", _entropies(seen, "no compensation", "SM, order 2", "order 3, two-dimensional"))]


def _figure_8(seen: list[_Imaged], path: Path) -> list[Check]:
    """Draw the image of the recommended estimator, which uses only the data, and all methods in one
    picture.
    """
    _draw(seen[0], "order 3, two-dimensional", path)
    first = seen[0]
    shown = {name: first.whole(name) for name in SHOWN} | {f"{name}, A": first.region(name, TIP) for name in SHOWN}
    peaks = {name: image.data.abs().max() for name, image in shown.items()}
    # each image in dB relative to the peak of its whole image
    shown = {name: image.with_data(image.data / peaks[name.removesuffix(", A")]) for name, image in shown.items()}
    lines = {name: {TIP: first.outlines()[TIP]} for name in SHOWN}
    plot.save(plot.images(shown, 40, percentile=100, lines=lines), path.with_stem(f"{path.stem}_methods"))
    return [
        falling("entropy (nats)", _entropies(seen, "SM, order 2", "order 3, azimuth", "order 3, two-dimensional")),
        *(
            number(name, published, [float(one.estimate[name]) for one in seen], within)
            for name, (published, within) in PUBLISHED.items()
        ),
    ]


def _figure_9(seen: list[_Imaged], path: Path) -> list[Check]:
    """Draw both tips enlarged, with the true position of the brightest scatterer of each."""
    tips, best = _tips(seen[0]), seen[0].shown["order 3, two-dimensional"]
    shown, lines = {"scaled to metres": seen[0].whole("order 3, two-dimensional")}, {}
    for true_m, range_m, _ in tips:
        title = f"tip at {true_m:.2f} m"
        shown[title] = _cut(best, true_m, REGION_M, (range_m - 1.6, range_m + 1.6))
        lines[title] = {"true position": plot.boxes([(range_m, true_m)], 0.3, 0.1 * REGION_M)}
    plot.save(plot.images(shown, 40, percentile=100, lines=lines), path, columns=3)
    ours = ", ".join(f"{seen_m:.3f} m for {true_m:.3f} m" for true_m, _, seen_m in tips)
    worst = max(abs(seen_m / true_m - 1) for one in seen for true_m, _, seen_m in _tips(one))
    ours += f"; at most {100 * worst:.2f} % off in all scenes"
    return [statement("tips of the panels", "scaled consistently with the simulation", worst < 0.02, ours, len(seen))]


def _tips(one: _Imaged) -> list[tuple[float, float, float]]:
    """True cross range, range and measured cross range (m) of both tips."""
    best = one.shown["order 3, two-dimensional"]
    x, y, level = (one.truth.values[name] for name in ("cross_range_m", "range_m", "amplitude"))
    tips = []
    for side in (-1, 1):
        which = int(torch.where(side * x > 0.999 * x.abs().max(), level.abs(), 0).argmax())
        at = float(x[which]), float(y[which])
        tips.append((*at, float(impulse_response(best, at, search_m=0.1)["position_azimuth_m"])))
    return tips


# rate, k1 and k2 of the text (rad/s, 1/s, 1/s2)
TRUTH = torch.tensor([0.02, 10.0, 1000.0], dtype=torch.float64)
NAMES = ("omega_rad_s", "k1_per_s", "k2_per_s2")
# BEGINNINGS: starting values relative to the truth.
# CLOSE: largest relative error of an estimate that counts as close to the truth.
BEGINNINGS = {0.9: "from 0.9 times the truth", 1.0: "from the truth", 1.1: "from 1.1 times the truth"}
FACTORS, CLOSE = tuple(BEGINNINGS), 0.05
# enlarged part of a picture, relative to its largest Doppler
PART = (0.35, 0.45)


@dataclass(frozen=True)
class _Seen:
    """The first scene, and relative errors of the rate, k1 and k2 of every scene (scene, 3) for
    each start.

    The key None stands for the recommended estimator, which needs no start.
    """

    signal: Signal
    radar: InverseRadar
    first: dict[float | None, Estimate]
    error: dict[float | None, torch.Tensor]


def _starts(small: bool) -> _Seen:
    """Estimates from every start. The reduced form has a tiny satellite, 2 lines per cell and one
    step.
    """
    scenes = [simulated(small, seed) for seed in seeds_of(small)]
    found = [{factor: _started(*scene, factor, small) for factor in (*FACTORS, None)} for scene in scenes]
    error = {
        factor: torch.stack([torch.stack([one[factor][name] for name in NAMES]) / TRUTH - 1 for one in found])
        for factor in found[0]
    }
    signal, _, radar = scenes[0]
    return _Seen(signal, radar, found[0], error)


def _started(signal: Signal, truth: Truth, radar: InverseRadar, factor: float | None, small: bool) -> Estimate:
    """Estimate by Newton's method from a factor times the truth, or by the recommended
    estimator.
    """
    if factor is None:
        return uneven_rotation(signal.data, **known_of(signal, radar))
    figure = ImageEntropy.of(signal, radar, EntropyObjective(oversampling=2.0 if small else LINES_PER_CELL))
    start = figure.start(factor * TRUTH[0], factor * TRUTH[1:])
    return entropy_rotation(figure, "newton", start, damped=False, steps=1 if small else 10)


def _compensated(seen: _Seen, factor: float | None) -> Signal:
    """Image on a Doppler axis, because a wrong rate would give a wrong scale in metres."""
    image = focused(seen.signal, seen.radar, seen.first[factor].value)
    doppler, range_ = image.axes
    return Signal(image.data, (Axis("Doppler", doppler.n, 1e-3 * doppler.start, 1e-3 * doppler.step, "kHz"), range_))


def _picture(factor: float, seen: _Seen, path: Path) -> list[Check]:
    """Make figure 10, 11 or 12: the middle of the image, a part of it, and the
    recommended image.
    """
    shown, lines = {}, {}
    for title, one in ((BEGINNINGS[factor], factor), ("recommended", None)):
        image = _compensated(seen, one)
        # half of the drawn Doppler interval: a quarter of the band
        half = -0.25 * image.axes[0].start
        shown[title] = plot.within(image, {"Doppler": (-half, half)})
        shown[f"{title}, part"] = plot.within(image, {"Doppler": (PART[0] * half, PART[1] * half)})
        range_m = image.axis("range")
        middle_m, half_m = range_m.start + range_m.step * (range_m.n - 1) / 2, range_m.step * range_m.n / 2
        middle, height = half * sum(PART) / 2, half * (PART[1] - PART[0]) / 2
        lines[title] = {"part": plot.boxes([(middle_m, middle)], half_m, height)}
    plot.save(plot.images(shown, 40, percentile=100, lines=lines), path)
    return _outcome(seen, factor)


def _outcome(seen: _Seen, factor: float | None) -> list[Check]:
    """Checks of one start. From the truth, or without a start, the mean error of each parameter
    must be within 5 %.

    From other starts, the largest error must exceed 5 % in every scene.
    """
    title = f"Newton's method {BEGINNINGS[factor]}" if factor else "recommended, without a start"
    percent, errors = 100 * CLOSE, 100 * seen.error[factor]
    if factor in (1.0, None):
        rows = zip(("rate", "k1", "k2"), errors.T.tolist(), strict=True)
        return [number(f"{title}: error of {name} (%)", 0.0, row, percent) for name, row in rows]
    worst = errors.abs().amax(-1)
    ours = f"largest error of the three {float(worst.min()):.3g} % or more in {len(worst)} scenes"
    return [statement(title, "far from the truth, defocused", bool((worst > percent).all()), ours, len(worst))]


def _table_2(seen: _Seen, path: Path) -> list[Check]:
    return [check for factor in (*FACTORS, None) for check in _outcome(seen, factor)]


def _table_1(seen: list[_Imaged], path: Path) -> list[Check]:
    """Compare the printed rate, acceleration and jerk with the printed estimates. The printed rate
    is a misprint.
    """
    shown = OMEGA_RAD_S * WARP_K[0] == 0.2 and OMEGA_RAD_S * WARP_K[1] == 20.0
    ours = (
        f"0.2 rad/s2 and 20 rad/s3 over the printed estimates {WARP_K[0]:g} 1/s and {WARP_K[1]:g} 1/s2 are "
        f"{1e3 * OMEGA_RAD_S:g} mrad/s"
    )
    return [
        misprint("rate", "2 mrad/s", shown, ours),
        number("acceleration (rad/s2)", 0.2, OMEGA_RAD_S * WARP_K[0], 1e-6),
        number("jerk (rad/s3)", 20.0, OMEGA_RAD_S * WARP_K[1], 1e-6),
    ]


# figures and tables by their numbers
ITEMS = (
    Item(
        "Figure 4",
        "model of the target; the picture shows the procedural satellite that stands in for it",
        _satellite,
        _figure_4,
        "the model is not published",
        "unpublished",
    ),
    Item("Figure 5", "image without compensation", _satellite, _figure_5),
    Item("Figure 6", "image by adaptive chirplets (ACL)", _satellite, _figure_6),
    Item("Figure 7", "image with compensation of second order (SM)", _satellite, _figure_7),
    Item("Figure 8", "image with two-dimensional compensation of third order", _satellite, _figure_8),
    Item("Figure 9", "the same, scaled to metres", _satellite, _figure_9),
    *(
        Item(f"Figure {label}", f"image by Newton's method {BEGINNINGS[factor]}", _starts, partial(_picture, factor))
        for label, factor in zip((10, 11, 12), FACTORS, strict=True)
    ),
    Item("Table 1", "parameters of the simulation", _satellite, _table_1),
    Item("Table 2", "estimates by Newton's method from three starts", _starts, _table_2),
)
