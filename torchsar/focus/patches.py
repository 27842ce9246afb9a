"""Small patches of stripmap images about point targets, cut from any image or focused exactly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchsar.core import Signal
from torchsar.focus.strip_backprojection import Backproject
from torchsar.radar import StripmapRadar

# Half of the number of lines and of cells of a patch. It then contains the main lobe and a dozen
# side lobes at any usual sampling.
HALF = 16


def smooth_band(width_hz: float, since_s: Tensor, offset_hz: Tensor) -> Tensor:
    """Weight pulses by a Doppler band with raised-cosine edges over its outer eighths.

    Sharp edges would add Fresnel ripple to an image that serves as reference. Pulses in the inner
    three quarters of the band have the weight 1.

    Args:
        width_hz: Width of the band in Hz.
        since_s: Not used.
        offset_hz: Doppler of the pixel relative to the centroid, in Hz.

    Returns:
        Weights, shape of `offset_hz`.
    """
    outer = ((offset_hz.abs() - 3 * width_hz / 8) / (width_hz / 8)).clamp(0, 1)
    return 0.5 * (1 + torch.cos(math.pi * outer))


@dataclass(frozen=True)
class PointPatches:
    """Square patches of 32 x 32 samples of a stripmap image, each about a point target.

    Args:
        radar: Radar of the recording.
        spots: Azimuth line and range cell of the middle of each patch.
        lines: Number of pulses of the recording; an image may have a multiple of it as lines.
    """

    radar: StripmapRadar
    spots: Sequence[tuple[int, int]]
    lines: int

    @staticmethod
    def about(
        radar: StripmapRadar,
        size: tuple[int, int],
        zero_doppler_s: Tensor,
        closest_range_m: Tensor,
        doppler_hz: Tensor,
        velocity_m_s: Tensor,
    ) -> PointPatches:
        """Place one patch about each point target, at its position in a focused image.

        A patch that would extend beyond the first or last line is moved inside the image.

        Args:
            radar: Radar of the recording.
            size: Lines and samples of the recording.
            zero_doppler_s: Times of closest approach in seconds, shape (point,).
            closest_range_m: Closest ranges in metres, shape (point,).
            doppler_hz: Doppler centroid in Hz; it defines the image coordinates where the radar has
                no nominal pointing.
            velocity_m_s: Effective velocity in m/s.

        Returns:
            The patches, one per point.
        """
        frame = doppler_hz if radar.pointing_doppler_hz is None else radar.pointing_doppler_hz
        at = radar.image_position(zero_doppler_s, closest_range_m, frame, velocity_m_s)
        axes = radar.image_axes(radar.raw_axes(*size))
        lines, cells = (axis.index_of(x).round().long().tolist() for axis, x in zip(axes, at, strict=True))
        spots = [(min(max(i, HALF), size[0] - HALF), j) for i, j in zip(lines, cells, strict=True)]
        return PointPatches(radar, spots, size[0])

    def cut(self, image: Tensor) -> Tensor:
        """Cut the patches from a focused image.

        Args:
            image: Image, shape (line, cell), complex. Of several lines per pulse the first is used.

        Returns:
            Patches, complex128, shape (patch, line, cell).
        """
        image = image[:: image.shape[0] // self.lines]
        parts = [image[i - HALF : i + HALF, j - HALF : j + HALF] for i, j in self.spots]
        return torch.stack(parts).to(torch.complex128)

    def exact(self, signal: Signal, doppler_hz: Tensor, velocity_m_s: Tensor) -> Tensor:
        """Focus only the patches, by exact backprojection of raw data over one PRF of Doppler.

        The sum over pulses grows with their number, in proportion to the range of the target. The
        amplitude in an image by transforms grows with the square root of this number. The sum is
        divided by the root of the range, so that both images have the same gain over range.

        Args:
            signal: Raw data.
            doppler_hz: Doppler centroid in Hz.
            velocity_m_s: Effective velocity in m/s.

        Returns:
            Patches, complex128, shape (patch, line, cell).
        """
        band, parts = partial(smooth_band, self.radar.prf_hz), []
        for spot in self.spots:
            lines, cells = ((i - HALF, i + HALF) for i in spot)
            stage = Backproject(
                self.radar, "matched", velocity_m_s, doppler_hz, lines=lines, cells=cells, aperture=band
            )
            range_m = signal.axis("range").start + spot[1] * signal.axis("range").step
            parts.append(stage(signal).data / math.sqrt(range_m))
        return torch.stack(parts).to(torch.complex128)
