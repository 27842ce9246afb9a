"""Along-track velocity of a moving point by the power of its deramped tone.

Data are deramped with the phase history of each candidate velocity; the right velocity leaves the
strongest tone. This is azimuth autofocus with a known form of the phase history. The Doppler bands
are not reconstructed. The method therefore also works at speeds at which the channels sample the
same positions, so that a reconstruction is singular.

Reference:
    Remote Sens. 2020, 12, 1703, section 4.2, which prescribes autofocus for this velocity
    component.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome, unit_phasor
from torchsar.focus.nufft import smooth_length
from torchsar.multichannel.motion import PointMotion, checked_channels
from torchsar.multichannel.velocity.aperture import Aperture, Kept, seen_aperture
from torchsar.multichannel.velocity.assess import outcome_of_point
from torchsar.multichannel.velocity.interferometry import tone_frequency
from torchsar.multichannel.velocity.model import TINY, Found, noise_beside, point_phasor, quality_of
from torchsar.radar import BistaticRadar


def along_track_velocity(
    data: Tensor,
    radar: BistaticRadar,
    start: PointMotion,
    aperture: Aperture,
    half_m_s: float = 20.0,
    step_m_s: float = 0.5,
    fine: int = 3,
    *,
    assess: bool = True,
) -> Estimate:
    """Estimate the along-track speed u_a of a point of known slant-range speed and position.

    >>> import torch
    >>> from torchsar.multichannel import Dwell, PointMotion, along_track_velocity
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.zeros(3, 90, dtype=torch.complex64)
    >>> along_track_velocity(data, radar, PointMotion.of(radar, data.real), Dwell(0.5)).failed
    tensor(True)

    A grid with the step `step_m_s` is followed by `fine` grids of five points, each with 2/5 of the
    previous step. In every grid, a parabola through the maximum refines the speed.

    What is measured is the curvature of the phase. An acceleration along the line of sight
    therefore acts as a speed: 0.05 m/s^2 act as 0.42 m/s for a receiver at 300 m/s and a range of
    5 km.

    Args:
        data: Channels with the transmit range removed, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        start: Motion about which u_a is searched, shape (...,). Its slant-range speed and
            along-track position are kept.
        aperture: Expected amplitude over slow time.
        half_m_s: Half width of the search in m/s.
        step_m_s: Step of the first grid in m/s.
        fine: Number of finer grids.
        assess: Whether standard deviation and outcome are assessed.

    Returns:
        `u_a_m_s` of shape (...,), positive in the flight direction of the receiver. Where the point
        is lit in a part of the aperture only, this part is used, see `seen_aperture`. The
        assessment adds the standard deviation, which follows from the curvature of the likelihood,
        and `snr_db`, the SNR over all samples, in `info`. Outcomes: those of `outcome_of_point`,
        and `OUTSIDE_SEARCH` where the maximum lies at an end of the search.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, the channels are not those of the radar, or a sample is
            not finite, or if `half_m_s` is not positive, or the search reaches the speed of the
            receiver.
    """
    data = checked_channels(data, radar, "along_track_velocity")
    if not half_m_s > 0:
        raise ValueError(
            f"half_m_s of a search along track must be positive, got {half_m_s}; omit the stage where u_a_m_s is known"
        )
    # raises ValueError for a search up to the speed of the receiver
    PointMotion.of(radar, data, 0.0, start.u_a_m_s + half_m_s)
    data = data.to(torch.complex128)
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    centre = start.u_a_m_s.expand(data.shape[:-2])
    count = 2 * max(1, round(half_m_s / step_m_s)) + 1
    offsets = torch.linspace(-half_m_s, half_m_s, count, dtype=torch.float64, device=data.device)
    step = 2 * half_m_s / (count - 1)
    u_a, energy, curvature, ended = _best(data, radar, start, aperture, centre, offsets)
    aperture, uneven = seen_aperture(data, radar, replace(start, u_a_m_s=u_a), aperture)
    if bool(uneven.any()):
        u_a, energy, curvature, ended = _best(data, radar, start, aperture, centre, offsets)
    # the ends of the aperture move with u_a from pulse to pulse: they are kept from here on
    seen = Kept(aperture.weight(radar, replace(start, u_a_m_s=u_a), time_s))
    for _ in range(fine):
        step = 2 * step / 5
        offsets = step * torch.arange(-2, 3, dtype=torch.float64, device=data.device)
        u_a, energy, curvature, _ = _best(data, radar, start, seen, u_a, offsets)
    found = torch.where(energy > 0, u_a.clamp(centre - half_m_s, centre + half_m_s), centre)
    if not assess:
        return Estimate({"u_a_m_s": found})
    return _assessed(data, radar, replace(start, u_a_m_s=found), seen, energy, curvature, ended)


def _best(
    data: Tensor, radar: BistaticRadar, start: PointMotion, aperture: Aperture, centre: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the maximum over the grid centre + offsets, refined by a parabola.

    Returns its position, height and curvature, and whether it lies at an end of the grid.
    """
    power = torch.stack(
        [tone_power(data, radar, replace(start, u_a_m_s=centre + offset), aperture) for offset in offsets]
    )
    at, step = power.argmax(0), offsets[1] - offsets[0]
    inner = at.clamp(1, len(offsets) - 2)
    low, middle, high = (power.gather(0, (inner + shift)[None])[0] for shift in (-1, 0, 1))
    curvature = (low - 2 * middle + high).clamp_max(-TINY)
    edge = at != inner
    peak = offsets[inner] + step * (0.5 * (low - high) / curvature).clamp(-1, 1)
    return centre + torch.where(edge, offsets[at], peak), middle, -curvature / step.square(), edge


def tone_power(data: Tensor, radar: BistaticRadar, motion: PointMotion, aperture: Aperture) -> Tensor:
    """Return the energy of the strongest tone in the deramped data, summed over channels.

    If the motion gives the right curvature of the phase, this is the energy of the echo of the
    point.

    Args:
        data: Channels, shape (..., channel, pulse), complex.
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        aperture: Expected amplitude over slow time.

    Returns:
        Energy, shape (...,).
    """
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj() * weight[..., None, :]
    spectrum = torch.fft.fft(deramped, smooth_length(4 * data.shape[-1])).abs().square().sum(-2)
    return spectrum.amax(-1) / weight.square().sum(-1).clamp_min(TINY)


def _assessed(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    aperture: Aperture,
    energy: Tensor,
    curvature: Tensor,
    ended: Tensor,
) -> Estimate:
    """Add standard deviation and outcome to the maximum."""
    time_s = radar.pulse_axis(data.shape[-1]).values(data.device)
    weight = aperture.weight(radar, motion, time_s)[..., None, :]
    lit = (weight != 0).expand(data.shape)
    noise = ((data.abs().square() * lit).sum((-2, -1)) - energy).clamp_min(0) / lit.sum((-2, -1)).clamp_min(1)
    deramped = data * point_phasor(radar, motion, time_s, data.dtype).conj()
    tone_hz = tone_frequency(deramped * weight, radar.prf_hz)
    still = deramped * unit_phasor(-tone_hz[..., None, None] * time_s, data.dtype)
    # each channel has its amplitude
    amplitude = (still * weight).sum(-1, keepdim=True) / weight.square().sum(-1, keepdim=True).clamp_min(TINY)
    beside = noise_beside(still - amplitude * weight, weight, amplitude, radar.channels + 2)
    spread = beside.diagonal(dim1=-2, dim2=-1).mean(-1) / curvature.clamp_min(TINY)
    variance = torch.where(energy > 0, spread, torch.inf)
    found = Found(motion, energy.sqrt(), noise, variance[..., None, None], energy, ("u_a_m_s",))
    outcome, _ = outcome_of_point(data, radar, found, aperture, [(Outcome.OUTSIDE_SEARCH, ended)])
    std, info = {"u_a_m_s": variance.sqrt()}, {"snr_db": found.snr_db}
    return Estimate({"u_a_m_s": motion.u_a_m_s}, std, quality_of(found.snr_db), outcome, info)
