"""The way back from an image to lines: bulk + refocus omega-K as an invertible operator.

Every filter of `omega_k` but the range reference has unit modulus, so that with an all-pass
reference the operator is unitary: its inverse is its adjoint, the conjugate filters in reverse
order. Repairs that model the scene stand on this.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import outer_phasor, phasor_tables
from torchsar.focus.omega_k import FrameGeometry, FrequencyBasis, bulk_filter, refocus_turns_per_sample
from torchsar.radar import StripmapRadar


def all_pass(reference: Tensor) -> Tensor:
    """The phase of a range reference spectrum, unit modulus, (range,); 1 where the reference is
    zero.
    """
    size = reference.abs()
    return torch.where(size > 0, reference / torch.where(size > 0, size, 1), 1)


class InvertibleOmegaK:
    """Bulk + refocus omega-K with stored filters, forwards and backwards, for one geometry (one per
    trial). (..., pulse, range).

    Exact inverse where |reference| = 1 or reference is None (range-compressed data); otherwise
    `defocus` is the adjoint of `focus`. The Doppler-range domain between the two halves is public,
    for models of the azimuth spectrum: focus = from_doppler(to_doppler). Holds one complex number
    per sample of the lines. Geometry arguments as in `omega_k`; neglects what it neglects.
    """

    def __init__(
        self,
        radar: StripmapRadar,
        like: Tensor,
        *,
        doppler_hz: Tensor | float,
        velocity_m_s: Tensor | float | None = None,
        frame_hz: Tensor | float | None = None,
        reference: Tensor | None = None,
    ) -> None:
        at = FrameGeometry.of(radar, like, doppler_hz, velocity_m_s, frame_hz)
        n, self.n = like.shape[-1], like.shape[-1]
        centre = n // 2
        range_m = radar.near_range_m + centre * radar.range_step_m
        self.bulk = bulk_filter(FrequencyBasis(radar, n, like.device), at, range_m, reference, like.dtype)
        self.fine, self.coarse = phasor_tables(refocus_turns_per_sample(at), -centre, n, like.dtype)

    def _residual(self) -> Tensor:
        return outer_phasor(self.fine, self.coarse, self.n)

    def to_doppler(self, lines: Tensor) -> Tensor:
        """Lines to focused azimuth spectra, (..., doppler, range)."""
        return torch.fft.ifft(torch.fft.fft2(lines) * self.bulk) * self._residual()

    def from_doppler(self, spectra: Tensor) -> Tensor:
        """Adjoint and, with an all-pass reference, inverse of to_doppler."""
        return torch.fft.ifft2(torch.fft.fft(spectra * self._residual().conj()) * self.bulk.conj())

    def focus(self, lines: Tensor) -> Tensor:
        """The image; `omega_k` of the same arguments."""
        return torch.fft.ifft(self.to_doppler(lines), dim=-2)

    def defocus(self, image: Tensor) -> Tensor:
        """The lines of an image."""
        return self.from_doppler(torch.fft.fft(image, dim=-2))


def defocus_omega_k(
    image: Tensor,
    radar: StripmapRadar,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    frame_hz: Tensor | float | None = None,
    reference: Tensor | None = None,
) -> Tensor:
    """Lines whose bulk + refocus image is `image` (adjoint of `omega_k`; exact inverse for an
    all-pass reference or None).
    """
    operator = InvertibleOmegaK(
        radar, image, doppler_hz=doppler_hz, velocity_m_s=velocity_m_s, frame_hz=frame_hz, reference=reference
    )
    return operator.defocus(image)
