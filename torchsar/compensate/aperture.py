"""Doppler centroid from targets that are illuminated for their whole dwell within the record.

Targets near the ends of a record are illuminated for a part of their dwell only. In a strip with a
few bright points they bias the centroid by a considerable part of the beam's Doppler band. In an
image each target lies at the time when the beam centre crosses it. The image lines whose targets
have complete apertures can therefore be selected. Their azimuth spectrum has the shape of the beam,
whatever the scene.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from torchsar.compensate.doppler import lag_products
from torchsar.compensate.group import RangeGroup, compress, full_columns, full_spectrum, stays_inside
from torchsar.compensate.pulse_phase.data import or_one
from torchsar.core import cis, settle, unit_level, wrapped
from torchsar.focus.reference import REFERENCES
from torchsar.radar import StripmapRadar

# Lines and columns of a tile, found by trial: larger tiles measure their coherence better, smaller
# ones resolve the end of the complete lines.
_TILE = 16, 32


def complete_aperture_centroid(
    raw: Tensor, radar: StripmapRadar, doppler_hz: Tensor, reference: str | None, rounds: int = 2
) -> tuple[Tensor, Tensor]:
    """Refine an absolute Doppler centroid with targets whose whole dwell lies within the record.

    Targets whose apertures are cut by the ends of the record would bias the centroid. The image
    lines that show them are excluded.

    Args:
        raw: Lines, shape (..., pulse, range), complex.
        radar: Radar parameters.
        doppler_hz: Absolute centroid in Hz, shape (...,), positive when closing.
        reference: Name of the range reference in `torchsar.focus.reference`; None if `raw` is
            already range-compressed.
        rounds: Number of rounds, each of which forms the image anew with the current centroid.

    Returns:
        The refined centroid and its standard deviation in Hz, shape (...,) each. There are no such
        targets if the dwell of the beam is not known (`radar.integration_s` is None), or if the
        record is shorter than 1.15 dwells. There are none in trials where the targets migrate out
        of the swath in more than half of the range cells, or less than a tenth of the energy is
        that of such targets. `doppler_hz` and infinity are then returned.

    """
    std = torch.full_like(doppler_hz, math.inf)
    if radar.integration_s is None:
        return doppler_hz, std
    # length of the dwell in lines, with a guard of 2 % at each end, by trial
    dwell = math.ceil(1.04 * radar.integration_s * radar.prf_hz)
    if raw.shape[-2] < 1.1 * dwell:
        return doppler_hz, std
    raw, value = unit_level(raw), doppler_hz
    for _ in range(rounds):
        found, std = _refined(raw, radar, value, dwell, reference)
        value = torch.where(std.isfinite(), found, doppler_hz)
    return value, std


def _refined(
    raw: Tensor, radar: StripmapRadar, doppler_hz: Tensor, dwell: int, reference: str | None
) -> tuple[Tensor, Tensor]:
    """Make one round: form an image with the centroid doppler_hz, then update the lines and the
    centroid in turn.

    The image is formed in chunks of range that overlap by a pulse length, so that memory does not
    grow with the swath.
    """
    extra = 0 if reference is None else raw.shape[-1] - full_columns(raw.shape[-1], radar.pulse_samples)
    columns, scale = raw.shape[-1] - extra, radar.prf_hz / (2 * math.pi)
    count = max(1, round(columns / 2048))
    parts = []
    for a, b in pairwise(round(i * columns / count) for i in range(count + 1)):
        near = replace(radar, near_range_m=radar.near_range_m + a * radar.range_step_m)
        parts.append(_tiles(raw[..., a : b + extra], near, doppler_hz, reference))
    products, power = (torch.cat([part[k] for part in parts], -1) for k in (0, 1))
    rate = torch.cat([torch.full(p.shape[-1:], r, dtype=torch.float64, device=raw.device) for p, _, r in parts])
    # coherence of a tile, and a weight, 0 to 1, by how far it exceeds that of white noise
    coherence = products.abs() / or_one(power)
    weight = (1 - 6 / (_TILE[0] * _TILE[1] * coherence.square()).clamp_min(1e-9)).clamp_min(0)
    products = products * weight
    tile = raw.shape[-2] / products.shape[-2]
    line = (torch.arange(products.shape[-2], dtype=torch.float64, device=raw.device) + 0.5) * tile
    uncut, held = products, (raw.detach() != 0).any(-1).long()
    # zeros before the first and after the last of the other lines are none that a gap has taken
    held = (held | (held.cumsum(-1) == 0).long() | (held.flip(-1).cumsum(-1) == 0).flip(-1).long()).double()
    total, whole, phase = doppler_hz, torch.ones_like(power), torch.zeros_like(doppler_hz)
    for _ in range(8):
        # an error d of the assumed Doppler frequency delays the targets by d / rate
        shift = (total - doppler_hz)[..., None, None] / rate * radar.prf_hz
        crossing = line[:, None] - shift
        whole = _whole(crossing, raw.shape[-2], dwell)
        # the lines that a gap leaves of a dwell have another mean Doppler
        late = 2 * math.pi * rate / radar.prf_hz**2 * _mean_offset(held, crossing, dwell)
        products = uncut * cis(late)
        chosen = (products * whole).sum((-2, -1))
        phase = torch.angle(chosen)
        total = torch.where(chosen.abs() > 0, total + wrapped(scale * phase - total, radar.prf_hz), total)
    kept, energy = (products * whole).abs().sum((-2, -1)), products.abs().sum((-2, -1))
    # phase increment in rad half way between the centre and the edge of the beam
    half_way = math.pi / 2 * parts[0][2] * dwell / radar.prf_hz**2
    noise = ((weight * whole).square() * _noise_variance(power, radar)).sum((-2, -1))
    # Half a percent of the energy of targets that are left out leaks into the chosen tiles, with a
    # Doppler half way to the edge of the beam.
    std = scale * _std_rad(products * whole, noise, phase, 0.005 * half_way * (energy - kept))
    # less than a tenth of the energy may be nothing but sidelobes of other targets
    return total, torch.where(kept > 0.1 * energy, std, math.inf)


def _whole(crossing: Tensor, lines: int, dwell: int) -> Tensor:
    """Weight of image lines, given the line at which the beam centre crosses their targets.

    The weight is 1 where the whole dwell lies inside the record and 0 where it does not. It falls
    off over a tenth of a dwell. A sharp end would cut responses that a wrong nominal velocity
    smears, and the parts of such a response differ in Doppler.
    """
    margin = torch.minimum(crossing - dwell / 2, lines - dwell / 2 - crossing)
    return (margin / min(0.1 * dwell, (lines - dwell) / 4)).clamp(0, 1)


def _mean_offset(held: Tensor, crossing: Tensor, dwell: int) -> Tensor:
    """Mean distance in lines of the lines of a dwell that are there from its middle.

    held: 1 for a line that is there, 0 for a missing one, (..., line). crossing: middles, (..., a,
    b).
    """
    n = held.shape[-1]
    first = (crossing - dwell / 2).round().long().clamp(0, n)
    last = (first + dwell).clamp(max=n)
    index = torch.arange(n, dtype=held.dtype, device=held.device)

    def between(x: Tensor) -> Tensor:
        sums = torch.nn.functional.pad(x.cumsum(-1), (1, 0))
        high, low = (sums.gather(-1, at.flatten(-2)).view(at.shape) for at in (last, first))
        return high - low

    return between(held * index) / between(held).clamp_min(1) - (first + last - 1) / 2


def _tiles(
    raw: Tensor, radar: StripmapRadar, doppler_hz: Tensor, reference: str | None
) -> tuple[Tensor, Tensor, float]:
    """Lag products and powers of image tiles, and the azimuth rate in the middle of the chunk.

    The products and powers have shape (..., a, b), the rate is in Hz/s.
    """
    lines = compress(raw, radar, reference_spectrum(radar, reference, raw))
    group = RangeGroup(lines, torch.zeros(lines.shape[:-2], device=raw.device), radar)
    image = full_spectrum(group, doppler_hz).image(doppler_hz, radar.velocity_m_s)
    tiles = (max(1, image.shape[-2] // _TILE[0]), max(1, image.shape[-1] // _TILE[1]))
    inside = stays_inside(image.shape[-1], radar, doppler_hz, radar.integration_s or 0.0, always=False)
    image = image * inside[..., None, :].to(image.real.dtype)
    products, power = lag_products(image, tiles)
    # the chunks are scaled alike, because `lag_products` removes the scale of its input
    scale = image.abs().amax((-2, -1)).to(torch.float64).square()[..., None, None]
    rate = radar.azimuth_rate_hz_s(radar.near_range_m + image.shape[-1] / 2 * radar.range_step_m)
    return products * scale, power * scale, float(rate)


def reference_spectrum(radar: StripmapRadar, reference: str | None, raw: Tensor) -> Tensor | None:
    """Return the range reference of a name.

    Args:
        radar: Radar parameters.
        reference: Name in `torchsar.focus.reference`, or None for range-compressed lines.
        raw: Lines that it is for, shape (..., pulse, range).

    Returns:
        The spectrum, shape (range,); None without a name.
    """
    if reference is None:
        return None
    return REFERENCES[reference](radar.pulse, raw.shape[-1], radar.sampling_hz, raw.device)


def _noise_variance(power: Tensor, radar: StripmapRadar) -> Tensor:
    """Variance that noise adds to the imaginary part of the products of a tile.

    It includes noise times noise and noise times signal. The noise power is the power that a tenth
    of the tiles do not exceed. Compression leaves noise in the band of the pulse only, so that
    neighbouring range cells are correlated.
    """
    flat = power.flatten(-2)
    floor = torch.where(flat > 0, flat, torch.inf).kthvalue(max(1, flat.shape[-1] // 10), dim=-1).values
    floor = settle(floor, 0.0)[0][..., None, None]
    alike = max(1.0, radar.sampling_hz / radar.pulse.bandwidth_hz)
    return alike * floor * (power - 0.5 * floor).clamp_min(0) / (_TILE[0] * _TILE[1])


def _std_rad(products: Tensor, noise: Tensor, phase_rad: Tensor, leak: Tensor) -> Tensor:
    """Standard deviation of the common phase: the larger one of those by noise and by the scatter.

    The scatter has two parts, with weights found by trial. Columns of tiles are independent, but
    few of them may hold most of the energy. Twelfths of columns are many, but those of one target
    may differ in Doppler, because a wrong nominal velocity smears it. `leak` is the imaginary part
    of the products that may leak into the chosen tiles from targets whose dwell is cut.
    """
    parts = torch.stack([part.sum(-2) for part in products.tensor_split(12, -2)], -2) * cis(-phase_rad)[..., None, None]
    columns = parts.sum(-2)
    total = columns.real.sum(-1).clamp_min(1e-300)
    share = (columns.real / total[..., None]).clamp(0, 0.9)
    scatter = 0.5 * (columns.imag.square() / (1 - share)).sum(-1) + 0.25 * parts.imag.square().sum((-2, -1))
    return torch.hypot(torch.maximum(scatter, noise).sqrt() / total, leak / total)
