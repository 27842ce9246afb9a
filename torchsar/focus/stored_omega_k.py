"""Omega-K without Stolt interpolation with stored filters: a stage and an invertible operator.

For the whole PRF, every filter of `omega_k` has unit modulus, except the filter of range
compression. If this filter also has unit modulus (`all_pass`), the operator is unitary: its inverse
is its adjoint, which applies the conjugate filters in reverse order. The operator serves methods
that compute the echoes of a modelled image.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, checked_samples, outer_phasor, phasor_tables
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import FrequencyBasis, OmegaK, bulk_filter, refocus_turns_per_sample, through_doppler
from torchsar.radar import StripmapRadar


def all_pass(reference: Tensor) -> Tensor:
    """Scale a range reference spectrum to unit modulus and keep its phase.

    Args:
        reference: Spectrum of the range compression filter, shape (range,), complex.

    Returns:
        Spectrum of unit modulus, same shape; 1 where the reference is zero.
    """
    size = reference.abs()
    return torch.where(size > 0, reference / torch.where(size > 0, size, 1), 1)


def _compressed(spectra: Tensor, bulk: Tensor, fine: Tensor, coarse: Tensor) -> Tensor:
    """Transform Doppler rows (..., row, range frequency) into focused azimuth spectra.

    The bulk filter has the shape of the rows. `fine` and `coarse` are the tables of the phasors of
    refocusing, see `phasor_tables`.
    """
    return torch.fft.ifft(spectra * bulk) * outer_phasor(fine, coarse, spectra.shape[-1])


class InvertibleOmegaK:
    """Omega-K without Stolt interpolation and its adjoint, with filters stored for repeated use.

    The approximation is that of `omega_k`. The adjoint maps an image to raw lines; it is the exact
    inverse where |reference| = 1 or `reference` is None. `compress` and `expand` are the parts that
    work on each Doppler row by itself, for callers that process blocks of rows. The stored filters
    take one complex number per sample. Doppler and velocity may differ between trials.

    Args:
        radar: Radar of the recording.
        like: Data that give shape, dtype and device, shape (..., pulse, range).
        doppler_hz: Absolute Doppler centroid in Hz, a number or shape (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        reference: Spectrum of the range compression filter, shape (range,); None for
            range-compressed data.
        band_hz: Processed Doppler bandwidth about the centroid in Hz; None for the whole PRF, for
            which alone the adjoint can be the inverse.
        device: Device of the filters; None for that of the data.

    Raises:
        TypeError: If `like` is not complex64 or complex128.
        ValueError: If `like` has no samples, or if `doppler_hz` or `velocity_m_s` is neither a
            number nor a tensor in the shape of the leading dims of the data. Also if the velocity
            is not positive, or the magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity
            / wavelength.
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
        band_hz: float | None = None,
        device: torch.device | None = None,
    ) -> None:
        like = checked_samples(like, "InvertibleOmegaK", "pulse, range", finite=False)
        device = like.device if device is None else device
        at = FrameGeometry.of(radar, like, doppler_hz, velocity_m_s, frame_hz, device, band_hz)
        n, self.n = like.shape[-1], like.shape[-1]
        centre = n // 2
        range_m = radar.near_range_m + centre * radar.range_step_m
        basis = FrequencyBasis(radar, n, device, at.sin_reach)
        self.bulk = at.weighted(bulk_filter(basis, at, range_m, reference, like.dtype))
        self.fine, self.coarse = phasor_tables(refocus_turns_per_sample(at), -centre, n, like.dtype)

    def compress(self, spectra: Tensor, rows: slice = slice(None)) -> Tensor:
        """Transform Doppler rows of the two-dimensional spectrum into focused azimuth spectra.

        Args:
            spectra: Rows of the spectrum of raw lines, shape (..., row, range frequency), complex.
            rows: Slice of the Doppler axis to which the rows belong.

        Returns:
            Rows of focused azimuth spectra, shape (..., row, range).
        """
        return _compressed(spectra, *(table[..., rows, :] for table in (self.bulk, self.fine, self.coarse)))

    def expand(self, spectra: Tensor, rows: slice = slice(None)) -> Tensor:
        """Transform Doppler rows by the inverse of `compress`.

        The result is the adjoint times the number of range samples, which is the inverse where the
        range reference has unit modulus or is None.

        Args:
            spectra: Rows of focused azimuth spectra, shape (..., row, range), complex.
            rows: Slice of the Doppler axis to which the rows belong.

        Returns:
            Rows of the two-dimensional spectrum of raw lines, shape (..., row, range frequency).
        """
        fine, coarse = self.fine[..., rows, :].conj(), self.coarse[..., rows, :].conj()
        return torch.fft.fft(spectra * outer_phasor(fine, coarse, self.n)) * self.bulk[..., rows, :].conj()

    def focus(self, lines: Tensor) -> Tensor:
        """Focus raw lines with the stored filters; the image equals that of `omega_k`.

        Args:
            lines: Raw lines, shape (..., pulse, range), complex.

        Returns:
            Image, same shape.

        Raises:
            TypeError: If the samples are not complex64 or complex128.
            ValueError: If there are no samples.
        """
        lines = checked_samples(lines, "InvertibleOmegaK.focus", "pulse, range", finite=False)
        return torch.fft.ifft(self.compress(torch.fft.fft2(lines)), dim=-2)

    def defocus(self, image: Tensor) -> Tensor:
        """Transform an image into raw lines by the adjoint of `focus`.

        The adjoint is the inverse where the range reference has unit modulus or is None.

        Args:
            image: Image, shape (..., azimuth, range), complex.

        Returns:
            Raw lines, same shape.

        Raises:
            TypeError: If the samples are not complex64 or complex128.
            ValueError: If there are no samples.
        """
        image = checked_samples(image, "InvertibleOmegaK.defocus", "azimuth, range", finite=False)
        return torch.fft.ifft2(self.expand(torch.fft.fft(image, dim=-2)))


class StoredOmegaK(Stage):
    """Stage that focuses many recordings of one geometry with filters built once.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> stored = focus.StoredOmegaK(focus.OmegaK(sensor), recording.signal.axes)
    >>> divmod(int(stored(recording.signal).data.abs().argmax()), 96)  # line, sample of the peak
    (64, 36)

    The stored filters take one complex number per sample of the raw matrix.

    Args:
        stage: Stage whose radar, reference, velocity and Doppler are used.
        axes: Axes of the raw matrix, ending in (pulse, range).
        dtype: Complex type of the data.
    """

    filter: Tensor
    fine: Tensor
    coarse: Tensor

    def __init__(self, stage: OmegaK, axes: tuple[Axis, ...], dtype: torch.dtype = torch.complex64) -> None:
        super().__init__()
        self.axes, self.radar = axes, replace(stage.radar, near_range_m=axes[-1].start)
        device = stage.velocity_m_s.device
        with torch.no_grad():
            operator = InvertibleOmegaK(
                self.radar,
                torch.empty((axes[-2].n, axes[-1].n), dtype=dtype, device="meta"),
                doppler_hz=stage.doppler_hz,
                velocity_m_s=stage.velocity_m_s,
                frame_hz=stage.frame_hz,
                reference=stage.spectrum(axes[-1].n, device),
                band_hz=stage.band_hz,
                device=device,
            )
        for name, table in (("filter", operator.bulk), ("fine", operator.fine), ("coarse", operator.coarse)):
            self.register_buffer(name, table)

    def forward(self, signal: Signal) -> Signal:
        """Focus a recording whose axes and dtype are those that the filters were built for.

        Args:
            signal: Recording with axes (pulse, range).

        Returns:
            Image with axes (azimuth, range).

        Raises:
            ValueError: If axes or dtype are not those that the filters were built for.
        """
        if signal.axes != self.axes or signal.data.dtype != self.filter.dtype:
            raise ValueError(
                f"the signal must have the axes {self.axes} and the dtype {self.filter.dtype} that the filters of "
                f"this StoredOmegaK were built for, got {signal.axes} and {signal.data.dtype}; build a new one"
            )

        def focus_rows(rows: Tensor, part: slice) -> Tensor:
            return _compressed(rows, *(table[..., part, :] for table in (self.filter, self.fine, self.coarse)))

        data = through_doppler(signal.data, focus_rows, differentiable=signal.data.requires_grad)
        return Signal(data, self.radar.image_axes(signal.axes))
