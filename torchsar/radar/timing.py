"""Which pulse rates leave a swath free of transmitted pulses and of the echo from straight below:
the timing diagram of a satellite.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar.orbit import EARTH_RADIUS_M
from torchsar.radar.stripmap import LIGHT_M_S


@dataclass(frozen=True)
class TimingDiagram:
    """Where echoes of the ground meet a transmitted pulse or the nadir echo.

    prf_hz: (prf,); ground_m: distance from the point below the satellite, evenly spaced, (ground,);
    transmit, nadir: bool (prf, ground), True where the place is lost.
    """

    prf_hz: Tensor
    ground_m: Tensor
    transmit: Tensor
    nadir: Tensor

    @property
    def clear(self) -> Tensor:
        """Whether a place is received whole, bool (prf, ground)."""
        return ~(self.transmit | self.nadir)

    def swath_fits(self, width_m: float) -> Tensor:
        """Whether a swath of width_m that starts at each place is clear to its end, bool (prf,
        ground); False where it passes the end of ground_m.
        """
        cells = math.ceil(width_m / float(self.ground_m[1] - self.ground_m[0])) + 1
        lost = torch.nn.functional.pad((~self.clear).to(torch.int64).cumsum(-1), (1, 0))
        fits = torch.zeros_like(self.clear)
        if cells <= self.ground_m.numel():
            fits[:, : fits.shape[-1] - cells + 1] = lost[:, cells:] == lost[:, :-cells]
        return fits


def timing_diagram(
    height_m: float, prf_hz: Tensor, ground_m: Tensor, pulse_s: float, guard_s: float = 0.0, nadir_s: float = 0.0
) -> TimingDiagram:
    """Timing diagram of a satellite that receives its own echoes, height_m above a spherical Earth
    (Remote Sens. 2020, 12, 1703, Fig. 2).

    prf_hz: float64 (prf,); ground_m: float64 (ground,), evenly spaced, rising. The echo of a place
    lasts pulse_s from its two-way delay on; it must keep guard_s from the pulses at k / PRF and
    from the nadir echo, which lasts pulse_s + nadir_s from 2 height / c + k / PRF on. Raises
    ValueError for places beyond the horizon, or where pulses fill the period.
    """
    _refuse_impossible(height_m, prf_hz, ground_m, pulse_s, guard_s, nadir_s)
    delay, below = 2 / LIGHT_M_S * ground_slant_m(height_m, ground_m), 2 / LIGHT_M_S * height_m
    period = 1 / prf_hz[:, None]
    transmit = _overlaps(delay, period, pulse_s + guard_s, pulse_s + guard_s)
    return TimingDiagram(
        prf_hz, ground_m, transmit, _overlaps(delay - below, period, pulse_s + nadir_s + guard_s, pulse_s + guard_s)
    )


def _overlaps(since_s: Tensor, period_s: Tensor, after_s: float, before_s: float) -> Tensor:
    """Whether an event every period_s lies less than after_s before, or less than before_s behind,
    the times since_s, (prf, ground).
    """
    phase = torch.remainder(since_s, period_s)
    return (phase < after_s) | (phase > period_s - before_s)


def ground_slant_m(height_m: float, ground_m: Tensor) -> Tensor:
    """Range from a satellite to places ground_m along the spherical ground from the point below it,
    float64.
    """
    orbit = EARTH_RADIUS_M + height_m
    return torch.sqrt(height_m**2 + 4 * orbit * EARTH_RADIUS_M * torch.sin(ground_m / (2 * EARTH_RADIUS_M)).square())


def off_nadir_ground_m(height_m: float, off_nadir_deg: float) -> float:
    """Distance along the ground of the place that is seen off_nadir_deg from straight down.

    Raises ValueError where the look misses the Earth.
    """
    sine = (1 + height_m / EARTH_RADIUS_M) * math.sin(math.radians(off_nadir_deg))
    if not 0 <= sine < 1:
        raise ValueError(
            f"a look of {off_nadir_deg} degrees off nadir misses the Earth from "
            f"{height_m / 1e3:g} km; give "
            f"0..{math.degrees(math.asin(1 / (1 + height_m / EARTH_RADIUS_M))):.4g} degrees"
        )
    return EARTH_RADIUS_M * (math.asin(sine) - math.radians(off_nadir_deg))


def _refuse_impossible(
    height_m: float, prf_hz: Tensor, ground_m: Tensor, pulse_s: float, guard_s: float, nadir_s: float
) -> None:
    if not (height_m > 0 and pulse_s > 0 and guard_s >= 0 and nadir_s >= 0):
        raise ValueError(
            "a timing diagram needs a height and a pulse above 0 and guards of 0 s or more, got "
            f"height_m={height_m}, pulse_s={pulse_s}, guard_s={guard_s}, nadir_s={nadir_s}"
        )
    if not bool((prf_hz > 0).all()) or float(prf_hz.max()) * 2 * (pulse_s + guard_s) >= 1:
        raise ValueError(
            f"pulses of {pulse_s:g} s leave nothing of the period to receive in at rates of "
            f"{float(prf_hz.min()):g}..{float(prf_hz.max()):g} Hz; lower the rates or shorten the "
            "pulse"
        )
    horizon = EARTH_RADIUS_M * math.acos(EARTH_RADIUS_M / (EARTH_RADIUS_M + height_m))
    if ground_m.numel() < 2 or not (float(ground_m.min()) >= 0 and float(ground_m.max()) <= horizon):
        raise ValueError(
            f"ground_m needs at least two places within 0..{horizon:.6g} m, the horizon, got "
            f"{ground_m.numel()} from {float(ground_m.min()):g} to {float(ground_m.max()):g} m"
        )
