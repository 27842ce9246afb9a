"""A satellite with non-uniform rotation: figures 4 to 9 of Remote Sens. 2025, 17, 3447, with a
procedural satellite in place of the one that is not published.

    python scripts/rotation_satellite.py [--out rotation_satellite] [--target full] [--seed 1]
    [--snr-db 20] [--small]

The image without compensation, as a sum of chirplets (ACL), with the acceleration alone taken out
(SM), and with the recommended estimate of the whole rotation; entropy and contrast of each beside
expected ones, and the positions of both panel tips in the image that is scaled to metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import (
    EntropyObjective,
    ImageEntropy,
    autofocus,
    chirplet_clean,
    coarse_rotation,
    correct_pulse_phase,
    descend_rotation,
)
from torchsar.core import Axis, Estimate, Signal, Truth
from torchsar.focus import MatchedFourier, RangePhase
from torchsar.metrics import impulse_response
from torchsar.radar import InverseRadar
from torchsar.scene import PolynomialRotation

ROTATION = PolynomialRotation(0.02, (10.0, 1000.0))
TIP_M = 6.43
TARGETS = {
    "full": (500e3, 10000, 128, 0.06, 600),
    "mid": (500e3, 10000, 32, 0.24, 300),
    "tiny": (50e3, 1000, 32, 0.24, 60),
}  # pulse rate, pulses, cells, cell size, scatterers
# parts of an image: cross range in half widths of the target, range (m)
WHOLE = ((-1.09, 1.09), (-3.8, 3.8))
REGIONS = {"A, tip of a panel": ((-1.03, -0.81), (-1.6, 1.6)), "B, bus and dish": ((-0.11, 0.11), (-3.6, -0.4))}
EXPECTED = {
    "no compensation": (11.22, 4.5),
    "SM, order 2": (10.05, 9.4),
    "order 3, azimuth": (7.79, 25.0),
    "order 3, two-dimensional": (7.766, 25.3),
}  # from a separate simulation of this scene
FIGURES = {
    "no compensation": "figure_05.png",
    "chirplets (ACL)": "figure_06.png",
    "SM, order 2": "figure_07.png",
    "order 3, two-dimensional": "figure_08.png",
}


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
    uniform = correct_pulse_phase(signal.data, autofocus(signal.data)["phase_rad"])
    return {
        "no compensation": uncompensated,
        "chirplets (ACL)": uncompensated.with_data(chirplets),
        "uniform autofocus": focus(signal.with_data(uniform)),
        "SM, order 2": focus(signal, _second_order(signal, radar)["warp_k"]),
        "order 3, azimuth": focus(signal, rotation["warp_k"]),
        "order 3, two-dimensional": focus(flat(signal, **rotation), rotation["warp_k"]),
    }


def _scaled(image: Signal, radar: InverseRadar, rate_rad_s: Tensor) -> Signal:
    """Doppler at the mean rate as cross range (m)."""
    doppler, range_ = image.axes
    scale = radar.wavelength_m / (2 * float(rate_rad_s))
    return Signal(image.data, (Axis("azimuth", doppler.n, doppler.start * scale, doppler.step * scale, "m"), range_))


def _cropped(image: Signal, azimuth: tuple[float, float], range_m: tuple[float, float], half_width_m: float) -> Signal:
    edges_m = ([half_width_m * edge for edge in azimuth], range_m)
    bounds = {}
    for axis, edges in zip(image.axes, edges_m, strict=True):
        first, last = (round(float(axis.index_of(edge))) for edge in edges)
        bounds[axis.name] = (max(first, 0), min(last, axis.n))
    return image.crop(**bounds)


def _draw_target(truth: Truth, path: Path) -> None:
    """Figure 4: the scatterers."""
    x, y, a = (plot.array(truth.values[name]) for name in ("cross_range_m", "range_m", "amplitude"))
    plot.save(plot.scatterers(y, x, abs(a), "range (m)", "cross range (m)", f"{len(x)} scatterers"), path)


def _over_peak(image: Signal) -> Signal:
    return image.with_data(image.data / image.data.abs().max())


def _draw_images(shown: Mapping[str, Signal], half_width_m: float, out: Path) -> None:
    """Figures 5 to 8: every method and two regions of it, in dB of its peak.

    Figure 9: the best image alone, in metres. And all methods together, each over its peak.
    """
    for name, file in FIGURES.items():
        parts = {
            region: _cropped(shown[name], *edges, half_width_m) for region, edges in ({name: WHOLE} | REGIONS).items()
        }
        plot.save(plot.images(parts, 40, percentile=100), out / file, columns=3)
    compared = [
        _cropped(shown[name], *edges, half_width_m)
        for edges in (WHOLE, REGIONS["A, tip of a panel"])
        for name in FIGURES
    ]
    titles = [*FIGURES, *(f"{name}: tip of a panel" for name in FIGURES)]
    plot.save(
        plot.images(
            {title: _over_peak(image) for title, image in zip(titles, compared, strict=True)},
            40,
            percentile=100,
        ),
        out / "methods.png",
    )
    best = _cropped(shown["order 3, two-dimensional"], *WHOLE, half_width_m)
    plot.save(plot.image(best, 40, "scaled to metres", percentile=100), out / "figure_09.png")


def _tips(image: Signal, truth: Truth) -> dict[float, float]:
    """Cross range (m) at which the brightest scatterer of each tip is seen, by its true one."""
    x, y, level = (truth.values[name] for name in ("cross_range_m", "range_m", "amplitude"))
    found = {}
    for side in (-1, 1):
        which = int(torch.where(side * x > 0.999 * x.abs().max(), level.abs(), 0).argmax())
        found[float(x[which])] = float(
            impulse_response(image, (x[which], y[which]), search_m=0.1)["position_azimuth_m"]
        )
    return found
