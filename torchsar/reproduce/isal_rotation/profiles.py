"""Three points of a target with non-uniform rotation: figures 1 to 3 of Remote Sens. 2025, 17,
3447.

The three points have cross ranges of -12, 0 and 12 m and are 12 m behind the centre of rotation.
Their profiles are shown for several parts of the phase that are removed from the echo. The module
also computes the error of the estimated rotation rate if a deviation of the range centre is
ignored. This is done for one range cell, as in the paper, and for a whole image.

Common parts of the figures of several targets with non-uniform rotation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import EntropyObjective, ImageEntropy, coarse_rotation, entropy_rotation, uneven_rotation
from torchsar.core import Axis, Draws, Estimate, Signal
from torchsar.echo import simulate_turntable
from torchsar.focus import DopplerLines, MatchedFourier, RangePhase, matched_fourier, range_phase
from torchsar.focus.image_lines import cross_range_of
from torchsar.radar import LIGHT_M_S, InverseRadar
from torchsar.reproduce.item import Check, Item, statement
from torchsar.scene import Points, PolynomialRotation, Satellite, TurntableWorld


def ladar(cell_m: float, prf_hz: float) -> InverseRadar:
    """Describe a ladar at 1.55 um.

    Args:
        cell_m: Size of a range cell in m.
        prf_hz: Pulse rate in Hz.

    Returns:
        The ladar.
    """
    return InverseRadar(LIGHT_M_S / 1.55e-6, LIGHT_M_S / (2 * cell_m), prf_hz)


def known_of(signal: Signal, radar: InverseRadar) -> dict[str, Any]:
    """Gather what estimators of the rotation take besides the data.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.

    Returns:
        Arguments by name.
    """
    return {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "range_m": signal.axis("range").values()}


def focused(signal: Signal, radar: InverseRadar, rotation: Mapping[str, Tensor]) -> Signal:
    """Form the image on a Doppler axis, with the effects of a given rotation removed.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.
        rotation: All parameters of the rotation, its warp alone, or nothing.

    Returns:
        The image, with the axes doppler and range.
    """
    if "omega_rad_s" in rotation:
        signal = RangePhase(radar)(signal, **{name: rotation[name] for name in ("omega_rad_s", "warp_k", "yc_m")})
    return MatchedFourier(radar)(signal, rotation.get("warp_k"))


def in_metres(image: Signal, radar: InverseRadar, rate_rad_s: Tensor) -> Signal:
    """Express the Doppler frequencies of an image as cross range.

    Args:
        image: Image with the axes doppler and range.
        radar: Ladar.
        rate_rad_s: Mean rotation rate in rad/s.

    Returns:
        The image with an azimuth axis in m.
    """
    doppler, range_ = image.axes
    scale = radar.wavelength_m / (2 * float(rate_rad_s))
    return Signal(image.data, (Axis("azimuth", doppler.n, doppler.start * scale, doppler.step * scale, "m"), range_))


def second_order(signal: Signal, radar: InverseRadar) -> Estimate:
    """Estimate by the second-order method (SM), azimuth only: its one number from short sections,
    then by least entropy. It is not k1 of the target but about k1 + k2 T / 2.

    Args:
        signal: Range-compressed pulses.
        radar: Ladar that recorded them.

    Returns:
        The estimate of the warp.
    """
    figure = ImageEntropy.of(signal, radar, EntropyObjective(order=2, range_term=False))
    return entropy_rotation(
        figure, "descent", figure.start(0.0, coarse_rotation(signal.data, order=2, **known_of(signal, radar))["warp_k"])
    )


# rotation of the text except for the rate: 10 and 1000 require 20 mrad/s (rad/s, 1/s, 1/s2)
OMEGA_RAD_S, WARP_K = 0.02, (10.0, 1000.0)
TRUE_K = torch.tensor(WARP_K, dtype=torch.float64)
# positions of the points (m)
PLACES_M, RANGE_M = (-12.0, 0.0, 12.0), 12.0
CELLS_M = (3.4, 6.0, 12.0)  # ranges of the single range cells of figure 1
FINE = 16  # number of lines of a profile per Doppler cell
# coefficient k1 of a second-order fit to the phase by least squares; least entropy gives 20.05
SECOND_K1 = 20.8
NAMES = {
    "none": "no compensation",
    "order 2": "order 2, azimuth",
    "true k1": "true k1, k2 = 0",
    "azimuth": "order 3, azimuth",
    "full": "order 3, two-dimensional",
}
# SNR of the satellite of figure 1
SNR_DB = 20.0


@dataclass(frozen=True)
class _Profile:
    """Cross range (m), and amplitude relative to that of an ideal point."""

    cross_range_m: Tensor
    amplitude: Tensor

    @staticmethod
    def of(line: Tensor, pulse: Axis, wavelength_m: float) -> _Profile:
        """Profile of one range cell (line,).

        The mean rate scales the line, whatever was compensated, because the angle of rotation is
        the same.
        """
        doppler = (torch.arange(len(line), dtype=torch.float64) - len(line) // 2) / (FINE * pulse.n * pulse.step)
        return _Profile(
            cross_range_of(doppler, OMEGA_RAD_S, TRUE_K, wavelength_m, pulse.n * pulse.step),
            line.abs() / math.sqrt(pulse.n),
        )

    def near(self, centre_m: float, reach_m: float) -> _Profile:
        inside = (self.cross_range_m - centre_m).abs() <= reach_m
        return _Profile(self.cross_range_m[inside], self.amplitude[inside])


def _compensated(signal: Signal, radar: InverseRadar) -> dict[str, _Profile]:
    """Range cell of the points after each compensation."""
    pulse, range_ = signal.axes
    flat = range_phase(signal.data, range_.values(), radar.wavelength_m, radar.prf_hz, OMEGA_RAD_S, TRUE_K)
    cell = int(range_.index_of(RANGE_M).round())

    def profile(pulses: Tensor, *k: float) -> _Profile:
        image = matched_fourier(
            pulses[:, cell, None], torch.tensor(k, dtype=torch.float64), radar.prf_hz, lines=DopplerLines(FINE)
        )
        return _Profile.of(image[:, 0], pulse, radar.wavelength_m)

    return {
        "none": profile(signal.data),
        "order 2": profile(signal.data, SECOND_K1),
        "true k1": profile(signal.data, WARP_K[0]),
        "azimuth": profile(signal.data, *WARP_K),
        "full": profile(flat, *WARP_K),
    }


def _draw_profiles(
    profiles: Mapping[str, _Profile], names: Sequence[str], reach_m: Sequence[float], path: Path
) -> None:
    """Draw profiles of the three points, each within its reach; 0 dB is an ideal point."""
    parts = []
    for centre, reach in zip(PLACES_M, reach_m, strict=True):
        near = {NAMES[name]: profiles[name].near(centre, reach) for name in names}
        series = {name: (plot.array(p.cross_range_m), plot.decibel(p.amplitude, 1.0)) for name, p in near.items()}
        parts.append(
            {
                "series": series,
                "xlabel": "cross range (m)",
                "ylabel": "level over an ideal one (dB)",
                "title": f"x = {centre:g} m",
                "ylim": (-50.0, 3.0),
            }
        )
    plot.save(plot.panels(parts), path, columns=3)


def _whole_image(
    yc_m: Tensor, radar: InverseRadar, n_pulse: int, n_range: int, scatterers: int, snr_db: float
) -> dict[str, Tensor]:
    """Ratio of estimated to true rate (yc,) for satellites on both sides of the centre, one for
    each deviation.

    The deviation is ignored in one result and estimated in the other.
    """
    target = Satellite(scatterers, half_width_m=6.43 * radar.prf_hz / 500e3)
    world = TurntableWorld(
        target, rotation=PolynomialRotation(OMEGA_RAD_S, WARP_K), centre_deviation_m=yc_m, snr_db=snr_db
    )
    signal = simulate_turntable(radar, world, n_pulse, n_range, Draws(1, trials=range(len(yc_m))))[0].signal
    return {
        name: uneven_rotation(signal.data, **known_of(signal, radar), yc_m=known)["omega_rad_s"] / OMEGA_RAD_S
        for name, known in (("ignored", 0.0), ("estimated", None))
    }


def _points(small: bool) -> dict[str, _Profile]:
    """Profiles of the three points after each compensation. The reduced form is the same."""
    radar = ladar(4.0, 1e6)
    points = Points(azimuth_m=PLACES_M, range_m=[RANGE_M] * 3)
    world = TurntableWorld(points, rotation=PolynomialRotation(OMEGA_RAD_S, WARP_K))
    return _compensated(simulate_turntable(radar, world, 20000, 8, Draws(1))[0].signal, radar)


def _shown(names: Sequence[str], reach_m: Sequence[float], profiles: dict[str, _Profile], path: Path) -> list[Check]:
    """Make figure 2 or 3, in which the peaks of the outer and of the middle point rise with every
    compensation.
    """
    _draw_profiles(profiles, names, reach_m, path)
    checks = []
    for x in (PLACES_M[-1], PLACES_M[1]):
        peaks = [20 * math.log10(profiles[name].near(x, 5.0).amplitude.max()) for name in names]
        rising = peaks == sorted(peaks) and abs(peaks[-1]) < 0.1
        claim = "focused best by the last of the compensations"
        words = "; ".join(f"{NAMES[name]}: peak {peak:.1f} dB" for name, peak in zip(names, peaks, strict=True))
        checks.append(statement(f"point at {x:g} m", claim, rising, words))
    return checks


def _deviations(small: bool) -> tuple[Tensor, dict[str, Tensor]]:
    """Range centre deviations (m), and ratio of estimated to true rate of a whole image.

    The reduced form has a tiny satellite and few deviations.
    """
    yc = torch.linspace(-3, 3, 2 if small else 6, dtype=torch.float64)
    size = (ladar(0.24, 50e3), 1000, 32, 60) if small else (ladar(0.24, 500e3), 10000, 32, 300)
    return yc, _whole_image(yc, *size, SNR_DB)


def _figure_1(seen: tuple[Tensor, dict[str, Tensor]], path: Path) -> list[Check]:
    yc_m, image = seen
    # In a single range cell whose centre deviation is ignored, the range term of y replaces that of
    # y + yc, Eq. (6). The rate, the acceleration and the jerk change by the same factor.
    fine_m = torch.linspace(float(yc_m[0]), float(yc_m[-1]), 61, dtype=torch.float64)
    cell = {f"y = {y:g} m": torch.sqrt((1 + fine_m / y).clamp_min(0)) for y in CELLS_M}
    parts = [
        {
            "series": {name: (plot.array(at), plot.array(ratio)) for name, ratio in ratios.items()},
            "xlabel": "range centre deviation yc (m)",
            "ylabel": "estimated over true rate",
            "title": title,
        }
        for title, at, ratios in (("one range cell, yc ignored", fine_m, cell), ("a whole image", yc_m, image))
    ]
    plot.save(plot.panels(parts), path)
    ignored, estimated = (float((image[name] - 1).abs().max()) for name in ("ignored", "estimated"))
    ours = f"rate off by up to {100 * ignored:.0f} % if ignored, {100 * estimated:.1f} % if estimated"
    holds = ignored > 0.1 > 5 * estimated
    return [statement("deviation", "ignored, it biases the rotation", holds, ours, len(yc_m))]


# figures and tables by their numbers
ITEMS = (
    Item("Figure 1", "estimated rotation over the range centre deviation", of=_deviations, make=_figure_1),
    Item(
        "Figure 2",
        "profiles without, with one- and with two-dimensional compensation",
        of=_points,
        make=partial(_shown, ("none", "azimuth", "full"), (0.025, 0.025, 0.025)),
    ),
    Item(
        "Figure 3",
        "profiles by the order of the compensation",
        of=_points,
        make=partial(_shown, ("none", "order 2", "full"), (1.0, 0.025, 1.0)),
    ),
)
