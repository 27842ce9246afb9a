"""Timing diagram of a satellite: pulse rates that avoid transmitted pulses and nadir echoes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar.instrument import LIGHT_M_S
from torchsar.radar.orbit import EARTH_RADIUS_M


@dataclass(frozen=True)
class TimingDiagram:
    """Ground positions whose echo overlaps a transmitted pulse or the nadir echo, for each PRF.

    Args:
        prf_hz: Pulse repetition frequencies in Hz, shape (prf,).
        ground_m: Ground distance from the sub-satellite point in metres, evenly spaced, shape
            (ground,).
        transmit: True where the echo overlaps a transmitted pulse, bool (prf, ground).
        nadir: True where the echo overlaps the nadir echo, bool (prf, ground).

    Reference:
        Remote Sens. 2020, 12, 1703, Fig. 2.
    """

    prf_hz: Tensor
    ground_m: Tensor
    transmit: Tensor
    nadir: Tensor

    @property
    def clear(self) -> Tensor:
        """True where the echo overlaps neither a pulse nor the nadir echo, bool (prf, ground)."""
        return ~(self.transmit | self.nadir)

    def swath_fits(self, width_m: float) -> Tensor:
        """Test for each ground position whether a swath that starts there is received completely.

        Args:
            width_m: Width of the swath on the ground in metres.

        Returns:
            True where all echoes of the swath are received completely, bool (prf, ground); False
            where the swath extends beyond the end of `ground_m`.
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
    """Compute the timing diagram of a satellite that receives its own echoes.

    >>> import torch
    >>> from torchsar import radar
    >>> prf_hz = torch.tensor([1500.0, 2000.0]).double()
    >>> ground_m = torch.linspace(200e3, 300e3, 101).double()
    >>> diagram = radar.timing_diagram(600e3, prf_hz, ground_m, pulse_s=20e-6)
    >>> diagram.swath_fits(30e3).sum(-1).tolist()  # where a swath of 30 km may begin
    [71, 59]

    The Earth is spherical. The echo of a ground position begins at its two-way delay and lasts
    pulse_s. It must stay guard_s away from the transmitted pulses, which begin at k / PRF for whole
    numbers k, and from the nadir echoes, which begin at 2 height / c + k / PRF and last pulse_s +
    nadir_s.

    Args:
        height_m: Height of the satellite in metres.
        prf_hz: Pulse repetition frequencies in Hz, float64 (prf,).
        ground_m: Ground distance from the sub-satellite point in metres, float64 (ground,), evenly
            spaced and rising.
        pulse_s: Length of the pulse in seconds.
        guard_s: Guard time before and after each pulse and nadir echo in seconds.
        nadir_s: Length in seconds by which the nadir echo is longer than the pulse.

    Returns:
        The diagram over pulse repetition frequencies and ground positions.

    Raises:
        ValueError: If the height, the pulse or a guard time is out of range, a position lies beyond
            the horizon, or the pulses fill the period.

    Reference:
        Remote Sens. 2020, 12, 1703, Fig. 2.
    """
    if not (height_m > 0 and pulse_s > 0 and guard_s >= 0 and nadir_s >= 0):
        raise ValueError(
            "a timing diagram needs height_m and pulse_s above 0, and guard_s and nadir_s of 0 s or more, got "
            f"height_m={height_m}, pulse_s={pulse_s}, guard_s={guard_s}, nadir_s={nadir_s}"
        )
    if prf_hz.numel() == 0:
        raise ValueError("prf_hz of a timing diagram needs at least one pulse rate, got none")
    if not bool((prf_hz > 0).all()) or float(prf_hz.max()) * 2 * (pulse_s + guard_s) >= 1:
        raise ValueError(
            f"pulses of {pulse_s:g} s with guards of {guard_s:g} s leave nothing of the pulse period for reception at "
            f"prf_hz of {float(prf_hz.min()):g}..{float(prf_hz.max()):g} Hz; choose lower rates above 0 or a "
            "shorter pulse"
        )
    horizon = EARTH_RADIUS_M * math.acos(EARTH_RADIUS_M / (EARTH_RADIUS_M + height_m))
    if ground_m.numel() < 2:
        raise ValueError(f"ground_m of a timing diagram needs at least two positions, got {ground_m.numel()}")
    if not (float(ground_m.min()) >= 0 and float(ground_m.max()) <= horizon):
        raise ValueError(
            f"ground_m must lie from 0 m to the horizon at {horizon:.6g} m, got positions from "
            f"{float(ground_m.min()):g} to {float(ground_m.max()):g} m"
        )
    delay, below = 2 / LIGHT_M_S * ground_slant_m(height_m, ground_m), 2 / LIGHT_M_S * height_m
    period = 1 / prf_hz[:, None]
    transmit = _overlaps(delay, period, pulse_s + guard_s, pulse_s + guard_s)
    return TimingDiagram(
        prf_hz, ground_m, transmit, _overlaps(delay - below, period, pulse_s + nadir_s + guard_s, pulse_s + guard_s)
    )


def _overlaps(since_s: Tensor, period_s: Tensor, after_s: float, before_s: float) -> Tensor:
    """Test whether echoes at since_s meet an event of period period_s, (prf, ground)."""
    phase = torch.remainder(since_s, period_s)
    return (phase < after_s) | (phase > period_s - before_s)


def ground_slant_m(height_m: float, ground_m: Tensor) -> Tensor:
    """Return the slant range from a satellite to positions on a spherical Earth.

    Args:
        height_m: Height of the satellite in metres.
        ground_m: Ground distance from the sub-satellite point in metres, float64.

    Returns:
        Slant range in metres, float64, shape of `ground_m`.
    """
    orbit = EARTH_RADIUS_M + height_m
    return torch.sqrt(height_m**2 + 4 * orbit * EARTH_RADIUS_M * torch.sin(ground_m / (2 * EARTH_RADIUS_M)).square())


def off_nadir_ground_m(height_m: float, off_nadir_deg: float) -> float:
    """Return the ground distance from the nadir point to the point seen at an off-nadir angle.

    Args:
        height_m: Height of the satellite in metres.
        off_nadir_deg: Angle between the line of sight and the nadir in degrees.

    Returns:
        Distance along the ground from the nadir point in metres.

    Raises:
        ValueError: If the height is not positive, or the line of sight misses the Earth.
    """
    if not height_m > 0:
        raise ValueError(f"height_m must be positive, got {height_m}")
    sine = (1 + height_m / EARTH_RADIUS_M) * math.sin(math.radians(off_nadir_deg))
    if not 0 <= sine < 1:
        raise ValueError(
            "off_nadir_deg must lie in 0.."
            f"{math.degrees(math.asin(1 / (1 + height_m / EARTH_RADIUS_M))):.4g} degrees for a line of sight from a "
            f"height of {height_m / 1e3:g} km to the Earth, got {off_nadir_deg}"
        )
    return EARTH_RADIUS_M * (math.asin(sine) - math.radians(off_nadir_deg))
