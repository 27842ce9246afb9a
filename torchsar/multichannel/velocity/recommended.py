"""Velocity and place of a moving point told nothing: a bank over velocities, then maximum
likelihood, in white noise or in clutter whose covariance the data give.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Estimate
from torchsar.multichannel.motion import Number
from torchsar.multichannel.velocity.aperture import Aperture, Dwell
from torchsar.multichannel.velocity.bank import Search, bank_search
from torchsar.multichannel.velocity.interferometry import DETECTED_DB
from torchsar.multichannel.velocity.likelihood import maximum_likelihood
from torchsar.multichannel.velocity.model import UNKNOWNS, Found, chosen, estimate_of, point_phasor
from torchsar.multichannel.velocity.whitening import Whitening, sample_whitening
from torchsar.radar import BistaticRadar

_COARSE_S = 4.5
_ROUNDS = 2
_CENTRED, _FEW = 4, 4


def moving_point_velocity(
    data: Tensor,
    radar: BistaticRadar,
    aperture: Aperture,
    search: Search | None = None,
    u_a_m_s: Tensor | float | None = None,
    range_m: Number | None = None,
    whitening: Whitening | None = None,
) -> Estimate:
    """u_r, u_a and y0 of the strongest moving point per trial, no start needed.

    data: complex (..., channel, pulse), slow time zero at pulse n // 2, transmit range removed.
    aperture: expected amplitude over slow time. search: what the bank covers, by default three
    pulse rates of u_r, whose ambiguity modulo lambda PRF the cubic phase of the range history
    resolves. u_a_m_s: where it is known, None to estimate it. whitening: covariance of the clutter,
    from neighbouring lines, say; None to take it from what the point leaves of the data themselves:
    the point is sought in white noise and in the covariance of the data, both are refined against
    what they leave, and the more likely one is taken, per trial. ok: found above the threshold of
    19 dB over all samples, inside of the search, and with a predicted deviation of u_r below its
    half width (one channel cannot). info: snr_db, noise_power, coloured (clutter was found).
    """
    search = search or Search(u_r_m_s=1.5 * radar.ambiguous_velocity_m_s)
    unknowns = UNKNOWNS if u_a_m_s is None else ("u_r_m_s", "y0_m")
    if u_a_m_s is not None:
        search = replace(search, u_a_m_s=0.0)
    job = _Job(
        data.to(torch.complex128), radar, aperture, search, 0.0 if u_a_m_s is None else u_a_m_s, range_m, unknowns
    )
    if whitening is not None:
        return job.estimate(
            job.centred(job.found(whitening), whitening),
            torch.ones(data.shape[:-2], dtype=torch.bool, device=data.device),
        )
    plain = job.refined(job.found(None))
    if not bool(plain.coloured.any()):
        return job.estimate(plain.found, plain.coloured)
    other = job.refined(job.found(sample_whitening(job.data, radar)))
    first = ~plain.coloured | (plain.log_det <= other.log_det)  # whatever the other trials are
    return job.estimate(_either(plain.found, other.found, first), torch.where(first, plain.coloured, other.coloured))


@dataclass(frozen=True)
class _Refined:
    """A point fitted in the covariance of what it leaves; log_det: of that covariance, (...,): the
    less, the likelier; coloured: it is not white.
    """

    found: Found
    log_det: Tensor
    coloured: Tensor


@dataclass(frozen=True)
class _Job:
    """Data and settings of one estimate."""

    data: Tensor
    radar: BistaticRadar
    aperture: Aperture
    search: Search
    u_a_m_s: Tensor | float
    range_m: Number | None
    unknowns: tuple[str, ...]

    def found(self, whitening: Whitening | None) -> Found:
        """Bank on the middle of the aperture, then maximum likelihood there and on the whole."""
        coarse = self.aperture if isinstance(self.aperture, Dwell) else Dwell(_COARSE_S)
        start, _ = bank_search(self.data, self.radar, coarse, self.search, self.u_a_m_s, self.range_m, whitening)
        near = maximum_likelihood(self.data, self.radar, start, coarse, self.unknowns, whitening)
        return maximum_likelihood(self.data, self.radar, near.motion, self.aperture, self.unknowns, whitening)

    def centred(self, found: Found, whitening: Whitening) -> Found:
        """The fit again with the aperture about the place found: in clutter an expected amplitude
        that lies off drags the place along, to a third in each round.
        """
        for _ in range(_CENTRED):
            found = maximum_likelihood(
                self.data, self.radar, found.motion, self.aperture, self.unknowns, whitening, _FEW
            )
        return found

    def refined(self, found: Found) -> _Refined:
        """The fit again in the covariance of what it left, twice: where that is white nothing
        changes.
        """
        whitening = sample_whitening(self.left(found), self.radar)
        for _ in range(_ROUNDS):
            if not bool(whitening.coloured.any()):
                break
            again = maximum_likelihood(self.data, self.radar, found.motion, self.aperture, self.unknowns, whitening)
            found = _either(again, found, whitening.coloured)
            whitening = sample_whitening(self.left(found), self.radar)
        return _Refined(found, whitening.log_det, whitening.coloured)

    def left(self, found: Found) -> Tensor:
        """Data without the point."""
        time_s = self.radar.pulse_axis(self.data.shape[-1]).values(self.data.device)
        weight = self.aperture.weight(self.radar, found.motion, time_s)[..., None, :]
        return self.data - found.amplitude[..., None, None] * weight * point_phasor(
            self.radar, found.motion, time_s, self.data.dtype
        )

    def estimate(self, found: Found, coloured: Tensor) -> Estimate:
        snr = found.snr_db
        inside = found.motion.u_r_m_s.abs() <= self.search.u_r_m_s + self.search.u_r_step_m_s
        if "u_a_m_s" in self.unknowns:
            inside = inside & (
                (found.motion.u_a_m_s - self.u_a_m_s).abs() <= self.search.u_a_m_s + self.search.u_a_step_m_s
            )
        told = (
            found.covariance[..., 0, 0].sqrt() <= self.search.u_r_m_s + self.search.u_r_step_m_s
        )  # one channel tells no velocity from a place
        return estimate_of(
            found, inside & told & (snr >= DETECTED_DB), torch.sigmoid((snr - DETECTED_DB) / 3), coloured=coloured
        )


def _either(a: Found, b: Found, first: Tensor) -> Found:
    """Per trial the one or the other fit."""

    def pick(x: Tensor, y: Tensor) -> Tensor:
        return torch.where(first[(...,) + (None,) * (x.ndim - first.ndim)], x, y)

    tensors = {
        name: pick(getattr(a, name), getattr(b, name)) for name in ("amplitude", "noise_power", "covariance", "energy")
    }
    return Found(chosen(a.motion, b.motion, first), **tensors, unknowns=a.unknowns)
