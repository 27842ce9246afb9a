"""Omega-K focusing with the Stolt mapping, exact over the whole swath and at any squint."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import checked_samples, host_largest, outer_phasor, real_dtype
from torchsar.core.nufft import Nufft
from torchsar.focus.frame_geometry import FrameGeometry
from torchsar.focus.omega_k import (
    Focuser,
    FrequencyBasis,
    residual_frequency,
    row_tables,
)
from torchsar.focus.skew import DopplerSkew, through_skewed_doppler
from torchsar.radar import StripmapRadar


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
    `omega_k`, and for narrow swaths without squint the two functions give the same image. In
    complex64 the computation takes about 1.6 times as long as `omega_k` while the Stolt shift is
    below a tenth of a frequency bin, and up to three times beyond a bin. Differentiable in the raw
    data, the velocity and `frame_hz`.

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
    n = raw.shape[-1]
    basis = FrequencyBasis(radar, n, raw.device, skew.sin_reach(geometry))
    plan, real = Nufft(n, eps, raw.dtype, raw.device), real_dtype(raw.dtype)
    range_m = radar.near_range_m + n // 2 * radar.range_step_m
    reference = None if reference is None else reference.to(raw.dtype)

    def build(at: FrameGeometry) -> tuple[Tensor, ...]:
        # The bulk filter and refocusing already perform most of the Stolt mapping; the remaining
        # shift is a fraction of a frequency bin in most scenes.
        bins = residual_frequency(at, basis.nodes_hz) * (n / radar.sampling_hz)
        # the outermost nodes lie inside the band
        reach = bins.detach().abs().amax(-1, True) / math.cos(math.pi / (2 * bins.shape[-1]))
        return (*row_tables(basis, at, range_m, raw), basis.table(bins), reach)

    def focus_rows(rows: Tensor, bulk: Tensor, fine: Tensor, coarse: Tensor, bins: Tensor, reach: Tensor) -> Tensor:
        if reference is not None:
            rows = rows * reference
        lines = torch.fft.ifft(rows * basis.phasors(bulk, raw.dtype))
        largest = math.inf if raw.dtype == torch.complex128 else host_largest(reach, math.inf)
        # Float32 suffices for small shifts, which are usual, and takes half the time. For shifts up
        # to 100 bins it keeps the error of the image below -80 dB.
        shift = basis.evaluate(bins, real if largest < 100 else torch.float64)
        return plan.shift_spectrum(lines, shift, largest) * outer_phasor(fine, coarse, n)

    return through_skewed_doppler(raw, focus_rows, build, geometry, skew, not basis.direct)


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
