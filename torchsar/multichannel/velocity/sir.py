"""Slant-range velocity by the signal intensity ratio: a spectrum rebuilt with the right velocity
gathers inside the processed band.

Source: Remote Sens. 2020, 12, 1703, Eqs. (37)-(39). Data are demodulated by the Doppler centre of
each candidate before they are rebuilt (see `reconstruct`), so that the band edges do not jump from
bin to bin, and the ratio is continuous in the velocity. A stationary scene beside the target, which
gathers at u_r = 0, misleads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, take
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.reconstruct import mind_condition, reconstruct_lines
from torchsar.multichannel.response import LeastSquares, Rebuild, doppler_offsets
from torchsar.multichannel.velocity.ambiguity import warned_of_ambiguity
from torchsar.multichannel.velocity.aperture import Dwell
from torchsar.optim.scalar import grid_minimum, parabola_minimum
from torchsar.radar import BistaticRadar

_TOLERANCE_M_S = 1e-4
_CURVE_M_S = 0.5
_GROUPS = 16


@dataclass(frozen=True)
class Intensity:
    """Energies and summed amplitudes of a rebuilt spectrum inside and outside of the processed
    band, (...,) each, and how many samples either has.
    """

    energy_in: Tensor
    energy_out: Tensor
    amplitude_in: Tensor
    amplitude_out: Tensor
    bins_in: int
    bins_out: int

    @property
    def total(self) -> Intensity:
        """Summed over the last dim."""
        return self._each(lambda x: x.sum(-1))

    def summed(self, weight: Tensor) -> Intensity:
        """Summed over the last dim with weights (last, group): (..., group)."""
        return self._each(lambda x: x @ weight)

    def _each(self, change: Callable[[Tensor], Tensor]) -> Intensity:
        return Intensity(
            change(self.energy_in),
            change(self.energy_out),
            change(self.amplitude_in),
            change(self.amplitude_out),
            self.bins_in,
            self.bins_out,
        )

    @property
    def power_ratio(self) -> Tensor:
        """Gamma 1, Eq. (37); 0 for no data."""
        return self.energy_in / self.energy_out.clamp_min(torch.finfo(self.energy_out.dtype).tiny)

    @property
    def amplitude_ratio(self) -> Tensor:
        """Gamma 2, Eq. (38): mean amplitude inside over mean amplitude outside; 0 for no data."""
        outside = self.amplitude_out.clamp_min(torch.finfo(self.amplitude_out.dtype).tiny)
        return self.bins_out / self.bins_in * self.amplitude_in / outside

    @property
    def ratio(self) -> Tensor:
        """Gamma, the product."""
        return self.power_ratio * self.amplitude_ratio


def signal_intensity(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, bandwidth_hz: float
) -> Intensity:
    """Inside and outside of bandwidth_hz about the Doppler centre of the motion that the spectrum
    is rebuilt with, (...,).

    data: complex (..., channel, pulse, range), lines of a target together, transmit range removed.
    Differentiable in data and motion. Raises ValueError where the rebuilt band does not exceed
    bandwidth_hz, or the bands cannot be told apart by so many channels.
    """
    return _intensity_of_bins(data, radar, motion, rebuild, bandwidth_hz).total


def _intensity_of_bins(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, bandwidth_hz: float
) -> Intensity:
    """As `signal_intensity`, of each alias frequency: (..., pulse)."""
    refuse_full_band(radar, rebuild, bandwidth_hz)
    n = data.shape[-2]
    spectrum = reconstruct_lines(data, radar, motion, rebuild)
    inside = doppler_offsets(n, rebuild.bands, radar.prf_hz, data.device).abs() <= bandwidth_hz / 2
    amplitude = spectrum.abs().to(torch.float64)
    lines = [line.sum(-1).unflatten(-1, (rebuild.bands, n)) for line in (amplitude.square(), amplitude)]
    within, without = ([(line * mask.view(rebuild.bands, n)).sum(-2) for line in lines] for mask in (inside, ~inside))
    samples = int(inside.sum()) * data.shape[-1]
    return Intensity(within[0], without[0], within[1], without[1], samples, inside.numel() * data.shape[-1] - samples)


def refuse_full_band(radar: BistaticRadar, rebuild: Rebuild, bandwidth_hz: float) -> None:
    """Raise ValueError where nothing of the rebuilt band lies outside of the processed one."""
    if not 0 < bandwidth_hz < rebuild.bands * radar.prf_hz:
        band = f"{rebuild.bands} bands of {radar.prf_hz:g} Hz"
        raise ValueError(
            "the intensity ratio compares what lies inside bandwidth_hz with what lies outside, "
            f"but {band} leave nothing outside {bandwidth_hz:g} Hz; rebuild more bands, or "
            "integrate less"
        )


class SignalIntensityRatio(Stage):
    """u_r_m_s that maximises Gamma over search_m_s, per trial, from a grid and parabolas about its
    best point: axes (channel, pulse[, range]).

    bandwidth_hz: processed Doppler bandwidth V^2 T / (lambda R0). rebuild: LeastSquares(3) by
    default, since two bands leave little outside. search_m_s: least and largest velocity, None for
    all that is unambiguous, +-lambda PRF / 2. step_m_s: of the grid. Values of forward: u_a_m_s and
    y0_m, what is known of the rest of the motion.

    std: of noise, from how the maximum moves as parts of the spectrum are left out. quality: 1 -
    median / largest Gamma over the grid. Not ok: trials without data, whose value is the middle of
    the search, with the best point at an end of it, and of a quality below `least_quality`. Its
    threshold lies at about 0 to +7 dB a sample, 15 dB above interferometry between the channels;
    below it estimates are biased by more than std says. Without noise it errs by up to 0.06 m/s:
    what a gate leaves beyond the rebuilt bands aliases into them. Records that end inside the
    target's gate disturb it. Raises ValueError as `signal_intensity`.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    provides = ("u_r_m_s",)

    def __init__(
        self,
        radar: BistaticRadar,
        bandwidth_hz: float,
        rebuild: Rebuild | None = None,
        search_m_s: tuple[float, float] | None = None,
        step_m_s: float = 0.5,
        range_m: float | None = None,
        least_quality: float = 0.2,
    ) -> None:
        super().__init__()
        half = radar.ambiguous_velocity_m_s / 2
        self.radar, self.bandwidth_hz, self.rebuild, self.range_m = (
            radar,
            bandwidth_hz,
            rebuild or LeastSquares(3),
            range_m,
        )
        self.search_m_s, self.step_m_s, self.least_quality = search_m_s or (-half, half), step_m_s, least_quality
        low, high = self.search_m_s
        if not (low < high and 0 < step_m_s <= (high - low) / 2):
            raise ValueError(
                "search_m_s is (least, largest) velocity with two steps of step_m_s between, got "
                f"{self.search_m_s} and {step_m_s}"
            )
        why = self.rebuild.refusal(radar.channels)
        if why is not None:
            raise ValueError(why)
        refuse_full_band(radar, self.rebuild, bandwidth_hz)

    def forward(self, signal: Signal, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        lines = signal.data if "range" in signal.names else signal.data[..., None]
        middle = sum(self.search_m_s) / 2
        start = torch.full(signal.trials, middle, dtype=torch.float64, device=lines.device)
        mind_condition(self.radar, self._motion(lines, start, u_a_m_s, y0_m), self.rebuild, lines.dtype)

        def intensity(u_r_m_s: Tensor) -> Intensity:
            return _intensity_of_bins(
                lines, self.radar, self._motion(lines, u_r_m_s, u_a_m_s, y0_m), self.rebuild, self.bandwidth_hz
            )

        def cost(u_r_m_s: Tensor) -> Tensor:
            return -torch.log(intensity(u_r_m_s).total.ratio.clamp_min(torch.finfo(torch.float64).tiny))

        reach = (self.search_m_s[1] - self.search_m_s[0]) / 2
        coarse, costs = grid_minimum(cost, start, reach, 2 * round(reach / self.step_m_s) + 1)
        fine, _ = parabola_minimum(cost, coarse, self.step_m_s / 2, _TOLERANCE_M_S)
        found = self._estimate(fine, coarse, costs, lines, _deviation(intensity, fine))
        return self._minding_ambiguity(found, lines, u_a_m_s, y0_m)

    def _minding_ambiguity(self, found: Estimate, lines: Tensor, u_a_m_s: Number, y0_m: Number) -> Estimate:
        """Not ok, with a warning, where the strongest line shows that the velocity lies whole pulse
        rates off.
        """
        motion = self._motion(lines, found["u_r_m_s"], u_a_m_s, y0_m)
        line = take(lines.movedim(-1, -3), lines.detach().abs().square().sum((-3, -2)).argmax(-1), -3)
        dwell_s = self.bandwidth_hz * self.radar.wavelength_m * self.radar.reference_range_m / self.radar.speed_m_s**2
        return warned_of_ambiguity(found, line, self.radar, motion, Dwell(dwell_s))

    def _motion(self, lines: Tensor, u_r_m_s: Tensor, u_a_m_s: Number, y0_m: Number) -> PointMotion:
        return PointMotion.of(self.radar, lines, u_r_m_s, u_a_m_s, y0_m, self.range_m)

    def _estimate(self, fine: Tensor, coarse: Tensor, costs: Tensor, lines: Tensor, std: Tensor) -> Estimate:
        low, high = self.search_m_s
        there = lines.detach().abs().amax((-3, -2, -1)) > 0
        value = torch.where(there, fine.clamp(low, high), (low + high) / 2)
        quality = torch.where(there, 1 - torch.exp(costs.amin(-1) - costs.median(-1).values), 0.0).clamp(0, 1)
        inside = (coarse - low).abs().minimum((coarse - high).abs()) > self.step_m_s / 2
        return Estimate(
            {"u_r_m_s": value},
            quality,
            there & inside & (quality >= self.least_quality),
            {"u_r_m_s": std},
            {"log_ratio": -costs},
        )


def _deviation(intensity: Callable[[Tensor], Intensity], value: Tensor) -> Tensor:
    """Deviation (...,) of the maximum of log Gamma from how much it moves as each of _GROUPS
    interleaved groups of alias frequencies, of independent noise, is left out (jackknife).
    """
    low, middle, high = (_left_out(intensity(value + shift)) for shift in (-_CURVE_M_S, 0.0, _CURVE_M_S))
    slope, bend = (high - low) / (2 * _CURVE_M_S), (low - 2 * middle + high).mean(-1) / _CURVE_M_S**2
    spread = (slope - slope.mean(-1, keepdim=True)).square().sum(-1) * (_GROUPS - 1) / _GROUPS
    return torch.where(bend < 0, spread.sqrt() / torch.where(bend < 0, -bend, 1), torch.inf)


def _left_out(bins: Intensity) -> Tensor:
    """log Gamma (..., group) of all alias frequencies but those of one group."""
    n = bins.energy_in.shape[-1]
    group = torch.arange(n, device=bins.energy_in.device) % _GROUPS
    kept = (group[:, None] != torch.arange(_GROUPS, device=group.device)).to(torch.float64)
    return torch.log(bins.summed(kept).ratio.clamp_min(torch.finfo(torch.float64).tiny))
