"""Azimuth response and false targets of moving points in images from several channels.

Each channel is aliased in azimuth, and its Doppler bands are separated by combining the channels.
If this reconstruction is not exact, part of the spectrum of a point appears k pulse rates from its
true Doppler frequency, with k = +-1, +-2, ... It focuses as a false target (replica) about k PRF
lambda R0 v / V^2 away in azimuth, where R0 is the slant range, v the along-track speed of the
receiver relative to the point, and V the modulus of their relative velocity.

Reference:
    Remote Sens. 2020, 12, 1703, Table 4 and Figure 17 (maximum false target amplitude, MFTA).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import checked_samples, linear_phasor, per_trial
from torchsar.metrics.bounds import range_of_point
from torchsar.metrics.impulse import cut_figures, cut_offset
from torchsar.radar import BistaticRadar

# length in samples of the cut about the peak that `azimuth_response` measures, by choice
_WINDOW = 512
# points per sample in the search for the largest value, which is at most 0.06 dB below the true
# peak
_OVERSAMPLED = 8
# resolution cells added on both sides of a zone; beyond them the side lobes of a replica are more
# than 30 dB below its peak
_MARGIN_CELLS = 10
# number of Doppler frequencies in a band at which the positions in a zone are computed, by choice
_ROWS = 33

Value = Tensor | float


def azimuth_response(
    profile: Tensor, step_m: float, start_m: float = 0.0, *, centre_turns: float | None = 0.0, sidelobe_nulls: int = 20
) -> dict[str, Tensor]:
    """Measure the response of the strongest point of each azimuth profile.

    >>> import torch
    >>> from torchsar import metrics
    >>> point = torch.sinc(torch.arange(-32.0, 32.0) / 2) + 0j
    >>> found = metrics.azimuth_response(point, step_m=0.5, start_m=84.0)
    >>> {name: round(float(found[name]), 2) for name in ("irw_m", "pslr_db", "position_m")}
    {'irw_m': 0.89, 'pslr_db': -13.26, 'position_m': 100.0}

    A cut of 512 samples about the peak is analysed: widths of more than a quarter of the cut, and
    side lobes outside the cut, are not measured. For all-zero profiles the width is that of the cut
    and the side-lobe levels are -300 dB.

    Args:
        profile: Azimuth profiles, shape (..., azimuth), complex.
        step_m: Step of the axis in metres.
        start_m: Coordinate of sample 0 in metres.
        centre_turns: Centre of the spectrum in turns per sample; 0 for images formed about their
            Doppler centre, as in this package. With None it is estimated, which is not possible if
            the spectrum fills the whole sampled band.
        sidelobe_nulls: Distance from the peak up to which side lobes are measured, in null spacings
            of a sinc of the same -3 dB width. A sinc has an ISLR of -10.17 dB with 10, -9.92 dB
            with 20 and -9.68 dB with all side lobes; its PSLR is always -13.26 dB.

    Returns:
        A dict with `irw_m` (-3 dB width), `pslr_db`, `islr_db`, `position_m` and the complex
        `peak`, shape (...,) each.

    Raises:
        ValueError: If profiles are real, empty or not finite, `sidelobe_nulls` is below 1, or
            `step_m` is not positive.
    """
    _check_profile(profile, "azimuth_response")
    if sidelobe_nulls < 1 or not step_m > 0:
        raise ValueError(
            "azimuth_response needs sidelobe_nulls of 1 or more and a positive step_m, got "
            f"{sidelobe_nulls} nulls and step_m={step_m}"
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
    """Samples (..., width) with `centre` at index width // 2; samples outside the profile
    are zero.
    """
    n = data.shape[-1]
    index = centre[..., None] + torch.arange(width, device=data.device) - width // 2
    return data.gather(-1, index.clamp(0, n - 1)) * ((index >= 0) & (index < n))


def _tone(cut: Tensor) -> Tensor:
    """Centre of the spectrum in cycles per sample, from the phase of products of adjacent
    samples.
    """
    return torch.angle((cut[..., 1:] * cut[..., :-1].conj()).sum(-1)) / (2 * math.pi)


def replica_level(profile: Tensor, step_m: float, zones_m: Tensor, *, centre_turns: float = 0.0) -> dict[str, Tensor]:
    """Measure the largest false target of each azimuth profile relative to its peak.

    >>> import torch
    >>> from torchsar import metrics
    >>> profile = torch.zeros(64, dtype=torch.complex64)
    >>> profile[20], profile[50] = 1, 0.1  # the point and, 30 m behind it, a replica
    >>> found = metrics.replica_level(profile, 1.0, torch.tensor([[25.5, 34.5]]))
    >>> round(float(found["mfta_db"]), 1), float(found["offset_m"])
    (-20.0, 30.0)

    The false targets are replicas of the point, whose possible positions (`zones_m`) come from
    `replica_zones`. Profiles are interpolated by eight, which misses at most 0.06 dB of a peak.
    Where side lobes of the point are higher than a replica, their level is measured instead; those
    of a sinc fall to -68 dB at 800 resolution cells. Zones outside the profile are left out. A
    record of 4 PRF lambda R0 / v^2 seconds or more (R0: range, v: along-track speed of the receiver
    relative to the point) contains two replicas on either side.

    Args:
        profile: Azimuth profiles, shape (..., azimuth), complex.
        step_m: Step of the axis in metres.
        zones_m: First and last offset from the peak in metres of each zone in which a replica may
            lie, shape (..., zone, 2).
        centre_turns: Centre of the spectrum in turns per sample.

    Returns:
        A dict with `mfta_db` (maximum false target amplitude relative to the peak; -300 for
        all-zero profiles, and 0 where no zone lies on the axis, so that nothing is known), its
        offset from the peak in metres, `offset_m`, and the share of zones that lie on the axis,
        `covered`, shape (...,) each.

    Raises:
        ValueError: If profiles are real, empty or not finite, or if all zones are farther from
            the peak than the profile is long.
    """
    _check_profile(profile, "replica_level")
    fine, step = _oversampled(profile.to(torch.complex128), centre_turns), step_m / _OVERSAMPLED
    power = fine.abs().square()
    peak, at = power.max(-1)
    offset = (torch.arange(power.shape[-1], device=power.device) - at[..., None]) * step
    inside = [(offset >= zone[..., :1]) & (offset <= zone[..., 1:]) for zone in zones_m.unbind(-2)]
    covered = torch.stack([one.any(-1) for one in inside], -1).to(torch.float64).mean(-1)
    reach = float(zones_m.abs().amin(-1).min())
    if reach > profile.shape[-1] * step_m:
        raise ValueError(
            f"replica_level needs a profile that contains a replica, but the nearest lies {reach:.4g} m from "
            f"the peak, outside the profile of {profile.shape[-1] * step_m:.4g} m; record longer"
        )
    level, index = torch.where(torch.stack(inside).any(0), power, 0).max(-1)
    ratio = level / peak.clamp_min(torch.finfo(torch.float64).tiny)
    level_db = torch.where(covered > 0, 10 * torch.log10(ratio.clamp_min(1e-30)), 0.0)
    return {"mfta_db": level_db, "offset_m": (index - at) * step, "covered": covered}


def _oversampled(data: Tensor, centre_turns: float) -> Tensor:
    """Interpolate the profile to _OVERSAMPLED points per sample, (..., n * _OVERSAMPLED).

    Its spectrum is centred at zero before it is padded with zeros.
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


def _check_profile(profile: Tensor, what: str) -> None:
    """Raise TypeError or ValueError for real, empty or non-finite profiles."""
    checked_samples(profile, what, "azimuth")


@dataclass(frozen=True)
class _Hyperbola:
    """Doppler spectrum of a point on a straight path; values have the shape (..., 1).

    It gives the centre of the spectrum (Hz), the time at which the point appears in the image (s),
    and the delay of each Doppler frequency.
    """

    wavelength_m: float
    centre_hz: Tensor
    image_s: Tensor
    closest_m: Tensor
    speed_m_s: Tensor
    along_m_s: Tensor

    @staticmethod
    def of(radar: BistaticRadar, u_r: Tensor, u_a: Tensor, y0: Tensor, range_m: Tensor) -> _Hyperbola:
        """Compute the Doppler spectrum of a point with the given velocities, position and range."""
        along = radar.speed_m_s - u_a
        speed = torch.hypot(along, u_r)
        image = (u_r * range_m + along * y0) / speed.square()
        return _Hyperbola(
            radar.wavelength_m, u_r / radar.wavelength_m, image, (along * range_m - u_r * y0) / speed, speed, along
        )

    def curvature_s(self, doppler_hz: Tensor) -> Tensor:
        """Delay (s) of a Doppler frequency relative to the zero-Doppler time.

        It is due to the curvature of the range history; the azimuth filter removes it.
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
    integration_s: Value | None = None,
    focused_at: tuple[Value, Value] | None = None,
    orders: Sequence[int] = (1, 2),
    axis_speed_m_s: Value | None = None,
) -> Tensor:
    """Compute the azimuth offsets from the peak at which replicas of a moving point can appear.

    >>> from torchsar import metrics, radar
    >>> pulse = radar.LinearFM(bandwidth_hz=50e6, duration_s=1e-6)
    >>> receiver = radar.BistaticRadar(5e9, pulse, 60e6, 180.0, 300.0, 6500.0)
    >>> zones = metrics.replica_zones(receiver, bands=2, integration_s=2.0)
    >>> zones.mean(-1).round().tolist()  # PRF lambda R0 / v = 234 m for the first order
    [-468.0, -234.0, 234.0, 468.0]

    A replica of order k is the part of the point's spectrum that appears k pulse rates from its
    true Doppler frequency. The zone of an order covers the positions at which the frequencies of
    this part are focused. It is computed from the exact range hyperbola, and is a few metres wide
    for the parameters of the Reference. Ten resolution cells are added on either side; beyond them
    the side lobes of a replica lie below -30 dB relative to the replica.

    Args:
        radar: Radar with pulse rate, wavelength and speed.
        bands: Number of Doppler bands of one PRF that are reconstructed.
        u_r_m_s: Slant-range speed of the point in m/s, closing positive.
        u_a_m_s: Along-track speed of the point in m/s.
        y0_m: Along-track position of the point at t = 0 in metres.
        range_m: Range from the track to the position of the point at t = 0, across the track, in
            metres; None for the reference range of the radar.
        integration_s: Length in seconds of a rectangular gate in which the point is illuminated, a
            number or shape (...,); None for the main lobe of the pattern of the elements.
        focused_at: Speeds (slant-range, along-track) in m/s for which the image was reconstructed
            and focused; None for the speeds of the point. With other speeds than those of the
            point, peak and replicas blur, and the zones are wider.
        orders: Orders k of the replicas to either side, 1 or more.
        axis_speed_m_s: Speed in m/s that converts slow time into position on the image axis; None
            for the speed of the receiver.

    Returns:
        First and last offset of each zone from the peak in metres, shape (..., zone, 2), float64.
        There are two zones for each order, in the order of rising k from negative to positive.

    Raises:
        ValueError: If `bands` or an order is below 1, or `range_m` is not positive and finite.

    Reference:
        Remote Sens. 2020, 12, 1703, Figure 17.
    """
    if bands < 1 or not orders or min(orders) < 1:
        raise ValueError(
            f"replica_zones needs bands of 1 or more and orders from 1 on, got bands={bands} and orders={tuple(orders)}"
        )
    like = next(
        (x for x in (u_r_m_s, u_a_m_s, y0_m, range_m, *(focused_at or ()), axis_speed_m_s) if isinstance(x, Tensor)),
        torch.zeros(()),
    )
    u_r, u_a, y0, r0 = (per_trial(x, 1, like) for x in (u_r_m_s, u_a_m_s, y0_m, range_of_point(radar, range_m)))
    point = _Hyperbola.of(radar, u_r, u_a, y0, r0)
    assumed = (
        point
        if focused_at is None
        else _Hyperbola.of(radar, per_trial(focused_at[0], 1, like), per_trial(focused_at[1], 1, like), y0, r0)
    )
    half = _half_band_hz(radar, point, r0, integration_s)
    peak = _positions_s(point, assumed, half, bands, radar.prf_hz, 0)
    zones = [
        _positions_s(point, assumed, half, bands, radar.prf_hz, k) - peak.flip(-1)
        for k in sorted({sign * k for k in orders for sign in (-1, 1)})
    ]
    margin = (_MARGIN_CELLS / (2 * half)) * torch.tensor([-1.0, 1.0], dtype=torch.float64, device=half.device)
    scale = per_trial(radar.speed_m_s if axis_speed_m_s is None else axis_speed_m_s, 1, like)
    return torch.stack(torch.broadcast_tensors(*((zone + margin) * scale for zone in zones)), -2)


def _half_band_hz(radar: BistaticRadar, point: _Hyperbola, range_m: Tensor, integration_s: Value | None) -> Tensor:
    """Half width of the Doppler band of the point (Hz)."""
    if integration_s is None:
        return point.along_m_s / radar.element_m
    return point.speed_m_s.square() * per_trial(integration_s, 1, range_m) / (2 * radar.wavelength_m * range_m)


def _positions_s(
    point: _Hyperbola, assumed: _Hyperbola, half_hz: Tensor, bands: int, prf_hz: float, order: int
) -> Tensor:
    """Interval of image times in which the replica of one order appears, (..., 2).

    The replica comes from the part of the point's band that is `order` pulse rates away from its
    true Doppler frequency but within the reconstructed band. If there is no such part, the nearest
    edge of the band is used.
    """
    edge = bands * prf_hz / 2
    ends = [point.centre_hz + sign * half_hz for sign in (-1, 1)]
    window = [assumed.centre_hz + sign * edge - order * prf_hz for sign in (-1, 1)]
    first, last = (torch.minimum(torch.maximum(w, ends[0]), ends[1]) for w in window)
    doppler = first + (last - first) * torch.linspace(0, 1, _ROWS, dtype=torch.float64, device=half_hz.device)
    position = point.image_s + point.curvature_s(doppler) - assumed.curvature_s(doppler + order * prf_hz)
    return torch.stack([position.amin(-1), position.amax(-1)], -1)
