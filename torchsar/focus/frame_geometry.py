"""Doppler, velocity and image frame of stripmap data, and the omega-K mapping of wave numbers.

The mapping is derived in `torchsar.focus.omega_k`.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import check_value, host_largest, per_trial, real_dtype, untraced
from torchsar.radar import StripmapRadar


def wavenumber(
    radar: StripmapRadar,
    frequency_hz: Tensor,
    doppler_hz: Tensor,
    velocity_m_s: Tensor | float,
    frame_hz: Tensor | float,
) -> Tensor:
    """Compute the omega-K mapping G - f0 of range frequency f and Doppler frequency f_a, in Hz.

        G = cos(s) sqrt((f0 + f)^2 - X^2) + sin(s) X,    X = c f_a / (2 v),

    where f0 is the carrier frequency, v the velocity and s the squint of the line of sight that
    defines the image coordinates. 2 G / c is the wave number along slant range. The difference
    G - f0 is formed without loss of digits. Where |X| > f0 + f, the square root is set to 0.

    Args:
        radar: Radar of the recording.
        frequency_hz: Range frequencies f relative to the carrier in Hz, shape (f,).
        doppler_hz: Doppler frequencies f_a in Hz, shape (..., d).
        velocity_m_s: Effective velocity v in m/s, a number or shape (...,).
        frame_hz: Doppler frequency of that line of sight in Hz, sin(s) = lambda frame_hz / (2 v), a
            number or shape (...,).

    Returns:
        G - f0 in Hz, shape (..., d, f), float64.
    """
    velocity, frame = (per_trial(value, 2, doppler_hz) for value in (velocity_m_s, frame_hz))
    f0, c = radar.carrier_hz, radar.wave_speed_m_s
    x = c * doppler_hz[..., None] / (2 * velocity)
    sin = c * frame / (2 * velocity * f0)
    cos = torch.sqrt(1 - sin.square())
    root = torch.sqrt(((f0 + frequency_hz - x) * (f0 + frequency_hz + x)).clamp_min(0))
    at_frame = f0 * cos
    # cos * root + sin * x - f0, where f0 is split into f0 (cos^2 + sin^2)
    return cos * (root - at_frame) + sin * (x - f0 * sin)


# width of the raised-cosine edges relative to the processed band, by choice
BAND_EDGE = 0.1


def band_weight(radar: StripmapRadar, offset_hz: Tensor, band_hz: float) -> Tensor:
    """Compute the weights of a processed Doppler band: 1 inside, 1/2 at +-band_hz / 2.

    Each edge is a raised cosine whose width is a tenth of the band. Warns where the band with its
    edges, 1.1 band_hz, exceeds the PRF, which then cuts the azimuth spectrum.

    Args:
        radar: Radar of the recording.
        offset_hz: Doppler relative to the centroid in Hz, any shape.
        band_hz: Processed Doppler bandwidth in Hz.

    Returns:
        Weights, same shape as `offset_hz`.

    Raises:
        ValueError: If `band_hz` is not a positive number.
    """
    if not (math.isfinite(band_hz) and band_hz > 0):
        raise ValueError(f"band_hz, the processed Doppler band, must be a positive number of Hz, got {band_hz}")
    if band_hz * (1 + BAND_EDGE) > radar.prf_hz * (1 + 1e-9):
        warnings.warn(
            f"PRF {radar.prf_hz:g} Hz is below the processed band of {band_hz:g} Hz and its "
            f"edges, {band_hz * (1 + BAND_EDGE):g} Hz: "
            f"azimuth is cut at the PRF; process at most {radar.prf_hz / (1 + BAND_EDGE):.6g} Hz",
            stacklevel=2,
        )
    return raised_cosine_band(offset_hz / band_hz)


def raised_cosine_band(offset: Tensor) -> Tensor:
    """Compute the weights of a band of unit width: 1 inside, 1/2 at +-0.5, 0 outside.

    Each edge is a raised cosine, a tenth of the band wide.

    Args:
        offset: Distance from the middle of the band, relative to its width, any shape.

    Returns:
        Weights, same shape.
    """
    beyond = (offset.abs() - 0.5) / BAND_EDGE
    return 0.5 - 0.5 * torch.sin(math.pi * beyond.clamp(-0.5, 0.5))


@dataclass(frozen=True)
class FrameGeometry:
    """Doppler, velocity and image frame of the rows of an azimuth spectrum.

    There is one row per Doppler bin. All values are float64.

    Args:
        radar: Radar of the recording.
        doppler_hz: Absolute Doppler of each row in Hz, shape (..., d).
        velocity_m_s: Effective velocity in m/s, shape (...,).
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates,
            shape (...,).
        weight: Weight of each row inside a processed Doppler band, shape (..., d); None for the
            whole PRF.
    """

    radar: StripmapRadar
    doppler_hz: Tensor
    velocity_m_s: Tensor
    frame_hz: Tensor
    weight: Tensor | None = None

    @staticmethod
    def of(
        radar: StripmapRadar,
        raw: Tensor,
        doppler_hz: Tensor | float,
        velocity_m_s: Tensor | float | None,
        frame_hz: Tensor | float | None,
        device: torch.device | None = None,
        band_hz: float | None = None,
    ) -> FrameGeometry:
        """Build the geometry of the azimuth spectrum of raw data, with as many rows as pulses.

        Args:
            radar: Radar of the recording.
            raw: Raw data, shape (..., pulse, range).
            doppler_hz: Absolute Doppler centroid in Hz, a number or shape (...,).
            velocity_m_s: Effective velocity in m/s, a number or shape (...,); None for that of the
                radar.
            frame_hz: Doppler frequency in Hz of the line of sight that defines the image
                coordinates, 0 for a zero-Doppler image; None for the nominal pointing of the radar,
                or for the centroid where the radar has none.
            device: Device of the result; None for that of the data.
            band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.

        Returns:
            Geometry of all Doppler rows.

        Raises:
            ValueError: If `doppler_hz` or `velocity_m_s` is neither a number nor a tensor in the
                shape of the leading dims of the data. Also if the velocity is not positive, the
                magnitude of `doppler_hz` or `frame_hz` is not below 2 velocity / wavelength, or
                `band_hz` is not positive.
        """
        with untraced(doppler_hz, velocity_m_s, frame_hz):
            device = raw.device if device is None else device
            centroid = torch.as_tensor(doppler_hz, dtype=torch.float64, device=device)
            velocity = torch.as_tensor(
                radar.velocity_m_s if velocity_m_s is None else velocity_m_s, dtype=torch.float64, device=device
            )
            default = radar.pointing_doppler_hz if radar.pointing_doppler_hz is not None else centroid
            frame = torch.as_tensor(default if frame_hz is None else frame_hz, dtype=torch.float64, device=device)
            for name, value in (("doppler_hz", centroid), ("velocity_m_s", velocity)):
                if value.ndim and value.shape != raw.shape[:-2]:
                    raise ValueError(
                        f"{name} must be one number, or one per trial in the shape "
                        f"{tuple(raw.shape[:-2])} of the leading dims of the data, got shape {tuple(value.shape)}"
                    )
            _check_squint(radar, velocity, centroid, frame)
            doppler = radar.doppler_hz(raw.shape[-2], centroid, device)
            return FrameGeometry(
                radar,
                doppler,
                velocity,
                frame,
                None if band_hz is None else band_weight(radar, doppler - centroid[..., None], band_hz),
            )

    def rows(self, part: slice) -> FrameGeometry:
        """Return the geometry of some of the rows, which are Doppler bins.

        Args:
            part: Slice of the Doppler axis.
        """
        return replace(
            self, doppler_hz=self.doppler_hz[..., part], weight=None if self.weight is None else self.weight[..., part]
        )

    def weighted(self, lines: Tensor) -> Tensor:
        """Multiply each Doppler row by its weight in the processed band, if there is such a band.

        Args:
            lines: Rows of an azimuth spectrum, shape (..., d, n), complex.

        Returns:
            Weighted rows, same shape.
        """
        return lines if self.weight is None else lines * self.weight.to(real_dtype(lines.dtype))[..., None]

    @property
    def sin_reach(self) -> float:
        """Largest magnitude of the sine of the squint over all rows, at the carrier frequency. It
        is 0 where values cannot be read.
        """
        with untraced(self.doppler_hz, self.velocity_m_s):
            sine = self.radar.sin_squint(self.doppler_hz.detach(), self.velocity_m_s.detach()[..., None])
            return host_largest(sine.abs(), 0.0)

    @property
    def requires_grad(self) -> bool:
        """True if `doppler_hz`, `velocity_m_s` or `frame_hz` requires gradients."""
        return any(value.requires_grad for value in (self.doppler_hz, self.velocity_m_s, self.frame_hz))

    def mapped(self, frequency_hz: Tensor) -> Tensor:
        """Compute the omega-K mapping G - f0 at the Doppler of each row, see `wavenumber`.

        Args:
            frequency_hz: Range frequencies relative to the carrier f0 in Hz, shape (f,).

        Returns:
            G - f0 in Hz, shape (..., d, f).
        """
        return wavenumber(self.radar, frequency_hz, self.doppler_hz, self.velocity_m_s, self.frame_hz)


def _check_squint(radar: StripmapRadar, velocity_m_s: Tensor, *doppler_hz: Tensor) -> None:
    """Raise ValueError for velocities that are not positive and for Dopplers beyond 90 degrees of
    squint.
    """
    velocity = velocity_m_s.detach()
    sines = [radar.sin_squint(value.detach(), velocity).abs() for value in doppler_hz]

    def check(slowest: float, *largest: float) -> None:
        if not 0 < slowest < math.inf:
            raise ValueError(f"velocity_m_s must be positive and finite in every trial, got {slowest:g}")
        if not all(sine < 1 for sine in largest):
            raise ValueError(
                "doppler_hz and frame_hz must stay below 2 * velocity / wavelength in magnitude, got "
                f"{max(largest):.4g} times this limit"
            )

    if velocity.numel() and all(sine.numel() for sine in sines):
        check_value(torch.stack([velocity.min(), *(sine.max() for sine in sines)]), check)
