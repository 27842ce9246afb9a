"""Omega-K focusing with the Stolt mapping, exact over the whole swath and at any squint."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import checked_samples, real_dtype
from torchsar.core.nufft import Nufft, Points
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import (
    Focuser,
    FrequencyBasis,
    bulk_filter,
    is_below,
    refocus,
    refocus_turns_per_sample,
    residual_frequency,
)
from torchsar.focus.skew import DopplerSkew, through_skewed_doppler
from torchsar.radar import StripmapRadar


class StoltMap:
    """Stolt interpolation of the range spectrum after the bulk filter.

    It corrects the change of range migration and of range focus over the swath. The bulk filter and
    `refocus` already perform most of the Stolt mapping; the remaining frequency shift is a fraction
    of a frequency bin in most scenes. A non-uniform FFT evaluates the spectrum at the shifted
    frequencies of every Doppler row, so that larger shifts are also handled.

    Args:
        basis: Polynomials that interpolate the shift over the range band.
        radar: Radar of the recording.
        n: Number of range samples.
        eps: Relative error of the interpolation.
        dtype: Complex type of the data.
        device: Device of the data.
    """

    def __init__(
        self,
        basis: FrequencyBasis,
        radar: StripmapRadar,
        n: int,
        eps: float,
        dtype: torch.dtype,
        device: torch.device | None = None,
    ) -> None:
        self.basis, self.plan = basis, Nufft(n, eps, dtype, device)
        self.step_hz = radar.sampling_hz / self.plan.length
        self.start = radar.range_frequency_hz(n, device) / self.step_hz

    def __call__(self, lines: Tensor, at: FrameGeometry) -> Tensor:
        """Apply the mapping to azimuth spectra (..., d, range) after the bulk filter and before
        refocusing.
        """
        residual = residual_frequency(at, self.basis.nodes_hz) / self.step_hz
        real = real_dtype(lines.dtype)
        # Float32 suffices for small shifts, which are usual, and takes half the time. For shifts up
        # to 200 grid points it keeps the error of the image below -80 dB.
        near = real == torch.float64 or is_below(residual, 200)
        shift = self.basis.evaluate(residual, real if near else torch.float64)
        start, shift = (self.start, shift) if near else (self.start + shift, None)
        points = Points.of(self.plan.kernel, start, self.plan.length, real, shift)
        return torch.fft.fftshift(torch.fft.ifft(self.plan.type2(lines, points)), dim=-1)


def omega_k_stolt(
    raw: Tensor,
    radar: StripmapRadar,
    *,
    doppler_hz: Tensor | float,
    velocity_m_s: Tensor | float | None = None,
    frame_hz: Tensor | float | None = None,
    reference: Tensor | None = None,
    band_hz: float | None = None,
    eps: float = 2e-4,
) -> Tensor:
    """Focus by omega-K with Stolt interpolation.

    The image of a target is focused exactly at every range. Coordinates and phases are those of
    `omega_k`, and for narrow swaths without squint the two functions give the same image. The
    computation takes two to three times as long as `omega_k`. Differentiable in the raw data, the
    velocity and `frame_hz`.

    All range frequencies f have equal weights, as in every form of omega-K. At lower frequencies
    the Doppler of an echo changes more slowly, its spectrum is higher, and the direct sum, a
    matched filter, weighs it by (1 + f / f0)^(-1/2). For a bandwidth of 30 % of the carrier
    frequency f0 the two images differ by -27 dB.

    The Doppler of a squinted beam is proportional to the transmitted frequency. The azimuth
    spectrum is therefore unwrapped about the centroid of each range frequency, so that the PRF has
    to hold the Doppler band of an aperture at each range frequency only. Over the whole pulse
    bandwidth B, the image of a target spans a wider band: by the squint, |doppler_hz| B / f0 is
    added. If this sum exceeds the PRF by more than a twentieth, the image has a whole multiple of
    the lines of the raw data, equally spaced between them, see `azimuth_factor`.

    Args:
        raw: Raw or range-compressed data, shape (..., pulse, range), complex.
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler centroid at the carrier frequency in Hz, a number or shape
            (...,).
        velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
            radar.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        reference: Spectrum of the range compression filter, shape (range,); None for
            range-compressed data.
        band_hz: Processed Doppler bandwidth about the centroid of each range frequency in Hz; None
            for the whole PRF.
        eps: Relative error of the interpolation. The default keeps the image error below -80 dB;
            1e-12 suits complex128 references.

    Returns:
        Image, shape (..., azimuth, range), complex. The number of lines is that of the pulses times
        `azimuth_factor`.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `doppler_hz` or `velocity_m_s` is neither a
            number nor a tensor in the shape of the leading dims of the data. Also if the velocity
            is not positive, the magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity /
            wavelength, `band_hz` is not positive, or the Doppler band of a squinted aperture does
            not fit the PRF.
    """
    raw = checked_samples(raw, "omega_k_stolt", "pulse, range", finite=False)
    geometry = FrameGeometry.of(radar, raw, doppler_hz, velocity_m_s, frame_hz)
    skew = DopplerSkew.of(radar, raw, doppler_hz, geometry.velocity_m_s, band_hz)
    n, centre = raw.shape[-1], raw.shape[-1] // 2
    basis = FrequencyBasis(radar, n, raw.device, skew.sin_reach(geometry))
    mapping = StoltMap(basis, radar, n, eps, raw.dtype, raw.device)
    range_m = radar.near_range_m + centre * radar.range_step_m

    def focus_rows(rows: Tensor, at: FrameGeometry) -> Tensor:
        lines = torch.fft.ifft(rows * bulk_filter(basis, at, range_m, reference, raw.dtype))
        return refocus(mapping(lines, at), refocus_turns_per_sample(at), centre)

    return through_skewed_doppler(raw, focus_rows, geometry, skew)


class OmegaKStolt(Focuser):
    """Stage that focuses by omega-K with Stolt interpolation; arguments as in `Focuser`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> image = focus.OmegaKStolt(sensor)(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 96)  # line and sample of the peak
    (64, 36)

    At a large squint the image can have several lines per pulse, see `omega_k_stolt`.
    """

    form = staticmethod(omega_k_stolt)
