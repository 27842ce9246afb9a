"""Azimuth profiles of moving points rebuilt from several channels: their response, and the false
targets beside it.

Doppler bands that are told apart badly leave a point's spectrum k pulse rates from its place, where
it focuses as a replica k PRF lambda R0 v / V^2 away, a little further by the hyperbola. Source:
Remote Sens. 2020, 12, 1703, Table 4 and Figure 17 (MFTA); brief 001, Experiments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import linear_phasor, per_trial, refuse_non_finite
from torchsar.metrics.impulse import cut_figures, cut_offset
from torchsar.radar import BistaticRadar

_WINDOW = 512
_OVERSAMPLED = 8
_MARGIN_CELLS = 10
_ROWS = 33

Value = Tensor | float


def azimuth_response(
    profile: Tensor, step_m: float, start_m: float = 0.0, *, centre_turns: float | None = 0.0, sidelobe_nulls: int = 20
) -> dict[str, Tensor]:
    """Response of the strongest point of each complex profile (..., azimuth): irw_m, pslr_db,
    islr_db, position_m and the complex peak, (...,) each.

    step_m, start_m: of the axis, sample 0 at start_m. centre_turns: centre of the spectrum in turns
    per sample; 0 for images made from spectra about their Doppler centre, as this package makes
    them; None to estimate it, which a full band does not allow. sidelobe_nulls: extent of the side
    lobes to either side in null spacings of a rectangular band: a sinc has ISLR -10.17 dB with 10,
    -9.92 with 20 and -9.68 with all of them; the PSLR is -13.26 dB for any. A cut of 512 samples
    about the peak is analysed: widths beyond a quarter of it, and side lobes outside, are not seen.
    Profiles of zeros have the width of the cut and side lobes of -300 dB. Raises ValueError for
    real, empty or non-finite profiles.
    """
    _refuse_profile(profile, "azimuth_response")
    if sidelobe_nulls < 1 or not step_m > 0:
        raise ValueError(
            "azimuth_response needs sidelobe_nulls of 1 or more and a positive step_m, got "
            f"{sidelobe_nulls} and {step_m}"
        )
    data = profile.to(torch.complex128)
    best = data.abs().argmax(-1)
    cut = _cut(data, best, min(_WINDOW, data.shape[-1]))
    tone = _tone(cut) if centre_turns is None else torch.full_like(best, centre_turns, dtype=torch.float64)
    offset = cut_offset(cut, tone)
    figures, peak = cut_figures(cut, tone, offset, sidelobe_nulls)
    return {
        "irw_m": figures["irw"] * step_m,
        "pslr_db": figures["pslr"],
        "islr_db": figures["islr"],
        "position_m": start_m + step_m * (best + offset),
        "peak": peak,
    }


def _cut(data: Tensor, centre: Tensor, width: int) -> Tensor:
    """Samples (..., width) with `centre` at width // 2, zero outside of the profile."""
    n = data.shape[-1]
    index = centre[..., None] + torch.arange(width, device=data.device) - width // 2
    return data.gather(-1, index.clamp(0, n - 1)) * ((index >= 0) & (index < n))


def _tone(cut: Tensor) -> Tensor:
    return torch.angle((cut[..., 1:] * cut[..., :-1].conj()).sum(-1)) / (2 * math.pi)


def replica_level(profile: Tensor, step_m: float, zones_m: Tensor, *, centre_turns: float = 0.0) -> dict[str, Tensor]:
    """Largest false target of each complex profile (..., azimuth) against its peak: mfta_db,
    offset_m from the peak, and covered, the share of zones on the axis, (...,) each.

    zones_m: (..., zone, 2), first and last offset from the peak, see `replica_zones`. centre_turns:
    as for `azimuth_response`. Profiles are read eight times as finely as they are sampled, which
    misses 0.06 dB at most. The point's own side lobes count where they are higher: a sinc's fall to
    -68 dB at 800 cells. Zones off the axis do not count: record 4 PRF lambda R0 / v^2 or more to
    see two replicas on either side. Profiles of zeros have -300 dB. Raises ValueError for real or
    non-finite profiles, and where no zone of any trial lies on the axis.
    """
    _refuse_profile(profile, "replica_level")
    fine, step = _oversampled(profile.to(torch.complex128), centre_turns), step_m / _OVERSAMPLED
    power = fine.abs().square()
    peak, at = power.max(-1)
    offset = (torch.arange(power.shape[-1], device=power.device) - at[..., None]) * step
    inside = [(offset >= zone[..., :1]) & (offset <= zone[..., 1:]) for zone in zones_m.unbind(-2)]
    covered = torch.stack([one.any(-1) for one in inside], -1).to(torch.float64).mean(-1)
    if not bool((covered > 0).any()):
        reach = float(zones_m.abs().amin(-1).min())
        raise ValueError(
            f"replica_level: the nearest replica lies {reach:.4g} m from the peak, off a profile "
            f"of {profile.shape[-1] * step_m:.4g} m; record longer"
        )
    level, place = torch.where(torch.stack(inside).any(0), power, 0).max(-1)
    ratio = level / peak.clamp_min(torch.finfo(torch.float64).tiny)
    return {"mfta_db": 10 * torch.log10(ratio.clamp_min(1e-30)), "offset_m": (place - at) * step, "covered": covered}


def _oversampled(data: Tensor, centre_turns: float) -> Tensor:
    """The profile at _OVERSAMPLED points a sample, by zeros beyond its band, (..., n *
    _OVERSAMPLED).
    """
    n = data.shape[-1]
    turned = data * linear_phasor(
        torch.tensor(-centre_turns, dtype=torch.float64, device=data.device), 0.0, n, data.dtype
    )
    spectrum = torch.fft.fftshift(torch.fft.fft(turned), dim=-1)
    before = (_OVERSAMPLED * n) // 2 - n // 2
    return (
        torch.fft.ifft(
            torch.fft.ifftshift(torch.nn.functional.pad(spectrum, (before, (_OVERSAMPLED - 1) * n - before)), dim=-1)
        )
        * _OVERSAMPLED
    )


def _refuse_profile(profile: Tensor, what: str) -> None:
    if not profile.is_complex() or not profile.ndim or not profile.shape[-1]:
        raise ValueError(
            f"{what} reads complex profiles (..., azimuth), got {profile.dtype} of shape {tuple(profile.shape)}"
        )
    refuse_non_finite(profile, what)


@dataclass(frozen=True)
class _Hyperbola:
    """Spectrum of a point along a straight path: centre (Hz), image time t0 (s), and delay of each
    Doppler, values (..., 1).
    """

    wavelength_m: float
    centre_hz: Tensor
    image_s: Tensor
    closest_m: Tensor
    speed_m_s: Tensor
    along_m_s: Tensor

    @staticmethod
    def of(radar: BistaticRadar, u_r: Tensor, u_a: Tensor, y0: Tensor, range_m: Tensor) -> _Hyperbola:
        along = radar.speed_m_s - u_a
        speed = torch.hypot(along, u_r)
        image = (u_r * range_m + along * y0) / speed.square()
        return _Hyperbola(
            radar.wavelength_m, u_r / radar.wavelength_m, image, (along * range_m - u_r * y0) / speed, speed, along
        )

    def curvature_s(self, doppler_hz: Tensor) -> Tensor:
        """Delay against the image time that the curvature of the path makes, and its filter takes
        out (s).
        """
        sine = (self.wavelength_m * doppler_hz / self.speed_m_s).clamp(-0.99, 0.99)
        return -self.closest_m * sine / (self.speed_m_s * torch.sqrt(1 - sine.square()))


def replica_zones(
    radar: BistaticRadar,
    bands: int,
    u_r_m_s: Value = 0.0,
    u_a_m_s: Value = 0.0,
    y0_m: Value = 0.0,
    range_m: Value | None = None,
    *,
    integration_s: float | None = None,
    focused_at: tuple[Value, Value] | None = None,
    orders: Sequence[int] = (1, 2),
    axis_speed_m_s: Value | None = None,
) -> Tensor:
    """Where replicas of a point can lie, first and last offset (m) from its peak, float64 (..., 2 *
    orders, 2), rising k from -max to max.

    The exact hyperbola gives the place of each Doppler of the point that lies k pulse rates off in
    the rebuilt band, N PRF about the centre; a zone spans those places (a few metres at the
    parameters of the paper) and ten resolution cells to either side, the reach of side lobes of a
    replica above -30 dB of it. integration_s: of a rectangular gate, None for the main lobe of the
    elements' pattern. focused_at: (u_r, u_a) that the image was rebuilt and focused with, by
    default the point's: where they differ, peak and replicas blur, and zones widen by as much.
    axis_speed_m_s: x of the image over slow time, by default the receiver's speed. Raises
    ValueError for orders below 1 or no bands.
    """
    if bands < 1 or not orders or min(orders) < 1:
        raise ValueError(
            f"replica_zones needs bands of 1 or more and orders from 1 on, got {bands} and {tuple(orders)}"
        )
    like = next(
        (x for x in (u_r_m_s, u_a_m_s, y0_m, range_m, *(focused_at or ()), axis_speed_m_s) if isinstance(x, Tensor)),
        torch.zeros(()),
    )
    u_r, u_a, y0, r0 = (
        per_trial(x, 1, like) for x in (u_r_m_s, u_a_m_s, y0_m, radar.reference_range_m if range_m is None else range_m)
    )
    point = _Hyperbola.of(radar, u_r, u_a, y0, r0)
    assumed = (
        point
        if focused_at is None
        else _Hyperbola.of(radar, per_trial(focused_at[0], 1, like), per_trial(focused_at[1], 1, like), y0, r0)
    )
    half = _half_band_hz(radar, point, r0, integration_s)
    peak = _places_s(point, assumed, half, bands, radar.prf_hz, 0)
    zones = [
        _places_s(point, assumed, half, bands, radar.prf_hz, k) - peak.flip(-1)
        for k in sorted({sign * k for k in orders for sign in (-1, 1)})
    ]
    margin = (_MARGIN_CELLS / (2 * half)) * torch.tensor([-1.0, 1.0], dtype=torch.float64, device=half.device)
    scale = per_trial(radar.speed_m_s if axis_speed_m_s is None else axis_speed_m_s, 1, like)
    return torch.stack(torch.broadcast_tensors(*((zone + margin) * scale for zone in zones)), -2)


def _half_band_hz(radar: BistaticRadar, point: _Hyperbola, range_m: Tensor, integration_s: float | None) -> Tensor:
    if integration_s is None:
        return point.along_m_s / radar.element_m
    return point.speed_m_s.square() * integration_s / (2 * radar.wavelength_m * range_m)


def _places_s(point: _Hyperbola, assumed: _Hyperbola, half_hz: Tensor, bands: int, prf_hz: float, order: int) -> Tensor:
    """First and last image time (..., 2) of the part of the point's band that lies `order` pulse
    rates off, within the rebuilt band; its nearest edge where none does.
    """
    edge = bands * prf_hz / 2
    ends = [point.centre_hz + sign * half_hz for sign in (-1, 1)]
    window = [assumed.centre_hz + sign * edge - order * prf_hz for sign in (-1, 1)]
    first, last = (torch.minimum(torch.maximum(w, ends[0]), ends[1]) for w in window)
    doppler = first + (last - first) * torch.linspace(0, 1, _ROWS, dtype=torch.float64, device=half_hz.device)
    place = point.image_s + point.curvature_s(doppler) - assumed.curvature_s(doppler + order * prf_hz)
    return torch.stack([place.amin(-1), place.amax(-1)], -1)
