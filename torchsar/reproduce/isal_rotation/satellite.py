"""A satellite with non-uniform rotation: figures 4 to 9 and Table 1 of Remote Sens. 2025, 17, 3447,
with a procedural satellite in place of the one that is not published.

The image without compensation, as a sum of chirplets (ACL), with the acceleration alone taken out
(SM), and with the recommended estimate of the whole rotation; and the positions of both panel tips
in the image that is scaled to metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    chirplet_clean,
    coarse_rotation,
    descend_rotation,
    uneven_rotation,
)
from torchsar.core import Axis, Draws, Estimate, Signal, Truth
from torchsar.echo import simulate_turntable
from torchsar.focus import MatchedFourier, RangePhase, mean_rate
from torchsar.metrics import entropy, impulse_response
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.reproduce.isal_rotation.profiles import OMEGA_RAD_S, WARP_K
from torchsar.reproduce.item import Check, Item, falling, number, statement
from torchsar.scene import PolynomialRotation, Satellite, TurntableWorld

ROTATION = PolynomialRotation(OMEGA_RAD_S, WARP_K)
# cross range (m) of the tips, as in Table 4
TIP_M = 6.43
# chosen: pulse rate, pulses, cells, cell size, scatterers, chirplets, in the full and reduced forms
SIZES = {False: (500e3, 10000, 32, 0.24, 300, 16), True: (50e3, 1000, 32, 0.24, 60, 4)}
SNR_DB = 20.0
# estimates of the genetic algorithm in the text (rad/s, 1/s, 1/s2), and tolerances
PUBLISHED = {
    "omega_rad_s": (0.0202, 0.0004),
    "k1_per_s": (10.002, 0.02),
    "k2_per_s2": (999.6835, 2.0),
}
# half the size of an image over that of the target in cross range; range (m)
WHOLE = 1.09, (-3.8, 3.8)
# enlarged regions: middle in half widths of the target in cross range, range (m); half their height
# (m), at which single scatterers can be seen
TIP = "A, tip of a panel"
REGIONS = {TIP: (-0.98, (-1.6, 1.6)), "B, bus and dish": (0.04, (-3.6, -0.4))}
REGION_M = 0.15
# the methods of the paper
SHOWN = ("no compensation", "chirplets (ACL)", "SM, order 2", "order 3, two-dimensional")


@dataclass(frozen=True)
class _Seen:
    """Images in metres by method, the estimate, the truth and half the width of the target (m)."""

    shown: dict[str, Signal]
    estimate: Estimate
    truth: Truth
    half_width_m: float

    def entropies(self, *names: str) -> dict[str, float]:
        return {name: float(entropy(self.shown[name])) for name in names}

    def whole(self, name: str) -> Signal:
        """The target in the image of a method."""
        return _cut(self.shown[name], 0.0, WHOLE[0] * self.half_width_m, WHOLE[1])

    def region(self, name: str, which: str) -> Signal:
        """One of the enlarged regions."""
        middle, range_m = REGIONS[which]
        return _cut(self.shown[name], middle * self.half_width_m, REGION_M, range_m)

    def outlines(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Lines about the enlarged regions."""
        return {
            name: plot.boxes([((near + far) / 2, middle * self.half_width_m)], (far - near) / 2, REGION_M)
            for name, (middle, (near, far)) in REGIONS.items()
        }


def _satellite(small: bool) -> _Seen:
    prf_hz, n_pulse, n_range, cell_m, count, atoms = SIZES[small]
    radar = InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)
    half_width_m = TIP_M * prf_hz / 500e3
    world = TurntableWorld(Satellite(count, half_width_m), rotation=ROTATION, snr_db=SNR_DB)
    recording, truth = simulate_turntable(radar, world, n_pulse, n_range, Draws(1))
    estimate = uneven_rotation(recording.signal.data, **_known_of(recording.signal, radar))
    rate = mean_rate(estimate["omega_rad_s"], estimate["warp_k"], n_pulse / prf_hz)
    made = _images(recording.signal, radar, estimate, atoms)
    return _Seen({name: _scaled(x, radar, rate) for name, x in made.items()}, estimate, truth, half_width_m)


def _second_order(signal: Signal, radar: InverseRadar) -> Estimate:
    """The second-order method, azimuth only: its one number from short sections, then by least
    entropy. It is not k1 of the target but about k1 + k2 T / 2.
    """
    figure = ImageEntropy.of(signal, radar, EntropyObjective(order=2, range_term=False))
    start = coarse_rotation(signal.data, order=2, **_known_of(signal, radar))
    return descend_rotation(figure, figure.start(0.0, start["warp_k"]))


def _known_of(signal: Signal, radar: InverseRadar) -> dict:
    return {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "range_m": signal.axis("range").values()}


def _images(signal: Signal, radar: InverseRadar, estimate: Estimate, atoms: int) -> dict[str, Signal]:
    """The image of every method, on one Doppler axis (Hz)."""
    focus, flat = MatchedFourier(radar), RangePhase(radar)
    rotation = {name: estimate[name] for name in ("omega_rad_s", "warp_k", "yc_m")}
    chirplets = chirplet_clean(signal.data, radar.prf_hz, atoms=atoms).image
    uncompensated = focus(signal)
    return {
        "no compensation": uncompensated,
        "chirplets (ACL)": uncompensated.with_data(chirplets),
        "SM, order 2": focus(signal, _second_order(signal, radar)["warp_k"]),
        "order 3, azimuth": focus(signal, rotation["warp_k"]),
        "order 3, two-dimensional": focus(flat(signal, **rotation), rotation["warp_k"]),
    }


def _scaled(image: Signal, radar: InverseRadar, rate_rad_s: Tensor) -> Signal:
    """Doppler at the mean rate as cross range (m)."""
    doppler, range_ = image.axes
    scale = radar.wavelength_m / (2 * float(rate_rad_s))
    return Signal(image.data, (Axis("azimuth", doppler.n, doppler.start * scale, doppler.step * scale, "m"), range_))


def _cut(image: Signal, middle_m: float, half_m: float, range_m: tuple[float, float]) -> Signal:
    return plot.within(image, {"azimuth": (middle_m - half_m, middle_m + half_m), "range": range_m})


def _figure_4(seen: _Seen, path: Path) -> list[Check]:
    """Nothing is published to compare it with."""
    x, y, level = (plot.array(seen.truth.values[name]) for name in ("cross_range_m", "range_m", "amplitude"))
    title = f"{len(x)} scatterers, with areas as their amplitudes"
    plot.save(plot.scatterers(y, x, abs(level), "range (m)", "cross range (m)", title), path)
    return []


def _draw(seen: _Seen, name: str, path: Path) -> None:
    """An image and two regions of it, in dB of its peak."""
    parts = {name: seen.whole(name)} | {which: seen.region(name, which) for which in REGIONS}
    plot.save(plot.images(parts, 40, percentile=100, lines={name: seen.outlines()}), path, columns=3)


def _figure_5(seen: _Seen, path: Path) -> list[Check]:
    _draw(seen, "no compensation", path)
    return [falling("entropy (nats)", seen.entropies("no compensation", "order 3, two-dimensional"))]


def _figure_6(seen: _Seen, path: Path) -> list[Check]:
    """Samples above -30 dB of the peak."""
    _draw(seen, "chirplets (ACL)", path)
    level = {name: seen.shown[name].data.abs() for name in ("chirplets (ACL)", "order 3, two-dimensional")}
    bright = {name: int((x > 10**-1.5 * x.max()).sum()) for name, x in level.items()}
    few, all_ = bright.values()
    ours = f"{few} samples above -30 dB, {all_} in the compensated image"
    return [statement("chirplets", "leave out weak parts of the target", few < all_, ours)]


def _figure_7(seen: _Seen, path: Path) -> list[Check]:
    _draw(seen, "SM, order 2", path)
    return [falling("entropy (nats)", seen.entropies("no compensation", "SM, order 2", "order 3, two-dimensional"))]


def _figure_8(seen: _Seen, path: Path) -> list[Check]:
    """The recommended estimator, which gets the data alone; and all methods in one picture."""
    _draw(seen, "order 3, two-dimensional", path)
    shown = {name: seen.whole(name) for name in SHOWN} | {f"{name}, A": seen.region(name, TIP) for name in SHOWN}
    peaks = {name: image.data.abs().max() for name, image in shown.items()}
    # each in dB of the peak of its whole image
    shown = {name: image.with_data(image.data / peaks[name.removesuffix(", A")]) for name, image in shown.items()}
    lines = {name: {TIP: seen.outlines()[TIP]} for name in SHOWN}
    plot.save(plot.images(shown, 40, percentile=100, lines=lines), path.with_stem(f"{path.stem}_methods"))
    return [
        falling("entropy (nats)", seen.entropies("SM, order 2", "order 3, azimuth", "order 3, two-dimensional")),
        *(
            number(name, published, float(seen.estimate[name]), within, std=float(seen.estimate.std[name]))
            for name, (published, within) in PUBLISHED.items()
        ),
    ]


def _figure_9(seen: _Seen, path: Path) -> list[Check]:
    """Both tips are enlarged, with the true position of the brightest scatterer of each."""
    best = seen.shown["order 3, two-dimensional"]
    tips = _tips(best, seen.truth)
    shown, lines = {"scaled to metres": seen.whole("order 3, two-dimensional")}, {}
    for tip in tips:
        title = f"tip at {tip.true_m:.2f} m"
        shown[title] = _cut(best, tip.true_m, REGION_M, (tip.range_m - 1.6, tip.range_m + 1.6))
        lines[title] = {"true position": plot.boxes([(tip.range_m, tip.true_m)], 0.3, 0.1 * REGION_M)}
    plot.save(plot.images(shown, 40, percentile=100, lines=lines), path, columns=3)
    ours = ", ".join(f"{tip.seen_m:.3f} m for {tip.true_m:.3f} m" for tip in tips)
    close = all(abs(tip.seen_m / tip.true_m - 1) < 0.02 for tip in tips)
    return [statement("tips of the panels", "scaled consistently with the simulation", close, ours)]


def _table_1(seen: _Seen, path: Path) -> list[Check]:
    """What the text says of it."""
    return [
        number("rate (rad/s)", 0.002, OMEGA_RAD_S, 1e-6),
        number("acceleration (rad/s2)", 0.2, OMEGA_RAD_S * WARP_K[0], 1e-6),
        number("jerk (rad/s3)", 20.0, OMEGA_RAD_S * WARP_K[1], 1e-6),
    ]


@dataclass(frozen=True)
class _Tip:
    """True cross range and range of the brightest scatterer of a tip, and the cross range at which
    it is seen (m).
    """

    true_m: float
    range_m: float
    seen_m: float


def _tips(image: Signal, truth: Truth) -> list[_Tip]:
    """The tips of both panels."""
    x, y, level = (truth.values[name] for name in ("cross_range_m", "range_m", "amplitude"))
    found = []
    for side in (-1, 1):
        which = int(torch.where(side * x > 0.999 * x.abs().max(), level.abs(), 0).argmax())
        at = float(x[which]), float(y[which])
        found.append(_Tip(*at, float(impulse_response(image, at, search_m=0.1)["position_azimuth_m"])))
    return found


ITEMS = (
    Item(
        "Figure 4",
        "model of the target",
        of=_satellite,
        make=_figure_4,
        why="the model is not published; the picture shows the procedural satellite that stands in for it",
    ),
    Item("Figure 5", "image without compensation", of=_satellite, make=_figure_5),
    Item("Figure 6", "image by adaptive chirplets (ACL)", of=_satellite, make=_figure_6),
    Item("Figure 7", "image with compensation of second order (SM)", of=_satellite, make=_figure_7),
    Item("Figure 8", "image with two-dimensional compensation of third order", of=_satellite, make=_figure_8),
    Item("Figure 9", "the same, scaled to metres", of=_satellite, make=_figure_9),
    Item(
        "Table 1",
        "parameters of the simulation",
        "table",
        _satellite,
        _table_1,
        "the rate of 2 mrad/s in the text contradicts the estimates of 10 1/s and 1000 1/s2, which 20 mrad/s gives",
    ),
)
