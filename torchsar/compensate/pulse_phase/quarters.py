"""Whether the pulses show one scene: the images of quarters of the pulses, compared."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, rising, rotate

# fewest pulses that are divided into quarters
_LEAST_PULSES = 32
# Quarters of the pulses; a quarter is compared with the others if its even and odd pulses have
# such a correlation: with less, noise hides the scene. It was 0.2 at -5 dB, 0.5 at 0 dB, 0.9 at 20
# dB. No two quarters may be less alike than this, as where the scene is another one.
_QUARTERS, _SEEN, _ALIKE = 4, 0.17, 0.33
# Mean correlation of the quarters, without noise: 0.93 to 1.06 in 90 % of the trials measured with
# up to 300 points that stay, 0.76 to 0.88 with the aircraft and where points are not resolved, 0.58
# to 0.78 where 40 or 120 scatterers change within 8 to 16 of 128 pulses, where the deviation is too
# small. The largest deviation that is surely ok grows from 0 at the first correlation to its usual
# value at the second. Both are lines (value at 0, slope) over the share of the scene in the moduli,
# the correlation of even and odd pulses. Found by trial: most of the wrong estimates lie beyond.
_CHANGING, _STAYING = (0.62, 0.19), (0.94, -0.09)
# Changes of few scatterers do not average out. Where fewer rows than this make the sharpness,
# nothing is sure below this correlation, which a few percent of the trials reach where four points
# change within 32 pulses, and most where few points stay.
_MANY_ROWS, _STILL = 30, 0.92
# From this share of the scene in the moduli on, noise does not make a large deviation of few
# scatterers, but changes do: the usual largest deviation is then exceeded only where the quarters
# are the same, by this difference of the correlation from 1. Without this, 5 % were wrong and ok
# where two scatterers turn out of sight, whose correlations were 0.80 to 0.98; those of points that
# stay were 0.995 to 1.01.
_CLEAR, _SAME = 0.6, 0.015
# With little noise bright scatterers may stay while weak ones change, as in an aircraft in flight.
# It is enough if they are alike: the same limits for moduli above so many times their median, in
# images with such a share of the scene. The correlation was below 0.71 in 95 % of the trials where
# 40 scatterers change, 0.75 in the recorded flight and 0.81 to 0.85 with the aircraft.
_BRIGHT, _LITTLE_NOISE = 3.0, 0.8
_BRIGHT_CHANGING, _BRIGHT_STAYING = 0.68, 0.76


def one_scene(
    rows: Tensor, phase: Tensor, std_rad: Tensor, largest_rad: Tensor, telling_rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compare the images of quarters of the pulses; those that noise hides are left out.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase that focuses them in rad, shape (trial, pulse).
        std_rad: Predicted standard deviation of the phase in rad, shape (trial,).
        largest_rad: Largest deviation that is ok in rad, shape (trial,).
        telling_rows: Effective number of rows over which the sharpness is spread, shape (trial,).

    Returns:
        Whether the quarters may show one scene; whether this is sure, as far as the deviation needs
        it; and whether they differ although noise does not hide the scene; bool, shape (trial,)
        each.
    """
    if rows.shape[-1] < _LEAST_PULSES:
        one = torch.ones_like(phase[:, 0], dtype=torch.bool)
        return one, std_rad < largest_rad, ~one
    x = rotate(rows, phase)
    n = rows.shape[-1] // _QUARTERS // 2 * 2
    parts = [[x[..., first + k : first + n : 2] for k in (0, 1)] for first in range(0, _QUARTERS * n, n)]
    images = [[torch.fft.fft(part, n).abs() for part in pair] for pair in parts]
    alike, least, share = _likeness(images)
    changing, staying = (at_0 + slope * share for at_0, slope in (_CHANGING, _STAYING))
    steady = (alike - changing) / (staying - changing)
    bright, _, _ = _likeness([[_above(image) for image in pair] for pair in images])
    steady_bright = (bright - _BRIGHT_CHANGING) / (_BRIGHT_STAYING - _BRIGHT_CHANGING)
    steady = torch.where(share > _LITTLE_NOISE, torch.maximum(steady, steady_bright), steady)
    differ = (share > _CLEAR) & ((alike - 1).abs() > _SAME)
    steady = torch.where(differ, steady.clamp_max(1), steady)
    sure = (std_rad < largest_rad * steady) & ((alike > _STILL) | (telling_rows > _MANY_ROWS))
    hidden = least.isinf()
    return hidden | (least > _ALIKE), sure | (hidden & (std_rad < largest_rad)), differ & ~hidden


def _above(image: Tensor) -> Tensor:
    """Moduli (trial, range, Doppler) above a multiple of their median."""
    sizes = rising(image.flatten(1))
    return (image - _BRIGHT * sizes[:, (sizes.shape[-1] - 1) // 2, None, None]).clamp_min(0)


def _likeness(images: Sequence[Sequence[Tensor]]) -> tuple[Tensor, Tensor, Tensor]:
    """Correlation of the quarters of the pulses, without noise: its mean over pairs of quarters,
    its least value, and the share of the scene in the moduli, (trial,) each.

    Two quarters are compared by the covariance of their moduli, at the displacement in Doppler
    where it is largest. It is related to the covariance of the images of the even and of the odd
    pulses of the same quarter, so that noise, which is independent in all of them, has no part in
    the result. Quarters that noise hides are left out; the least value is infinite without any.

    images: moduli (trial, range, Doppler) from the even and from the odd pulses of each quarter.
    """
    spectra, variances, shares = [], [], []
    for pair in images:
        even, odd = (image - image.mean((-2, -1), keepdim=True) for image in pair)
        common = (even * odd).sum((-2, -1))
        whole = (even.square().sum((-2, -1)) * odd.square().sum((-2, -1))).sqrt()
        spectra.append(torch.fft.rfft((even + odd) / 2))
        variances.append(common.clamp_min(0))
        shares.append(common / or_one(whole))
    total, count = torch.zeros_like(variances[0]), torch.zeros_like(variances[0])
    least = torch.full_like(variances[0], torch.inf)
    for i, j in combinations(range(len(images)), 2):
        common = torch.fft.irfft((spectra[i].conj() * spectra[j]).sum(-2), images[0][0].shape[-1]).amax(-1)
        both = torch.minimum(shares[i], shares[j]) > _SEEN
        alike = common / or_one((variances[i] * variances[j]).sqrt())
        total, count = total + torch.where(both, alike, 0), count + both
        least = torch.where(both, torch.minimum(alike, least), least)
    return total / or_one(count), least, torch.stack(shares).mean(0)
