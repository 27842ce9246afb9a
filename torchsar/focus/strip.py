"""Focusing of strips longer than memory, by overlapping azimuth blocks.

A focused line is a convolution of raw lines with the azimuth filter. The filter occupies (processed
band) / (Doppler rate) seconds and has tails beyond. Blocks overlap by this length and by a guard.
The guard is so long that the energy of the tails beyond it, which are cut off, is below a
tolerance. Apart from these tails, the blocks equal one transform of the whole strip. The filter of
a focuser with a processed band (`band_hz`) has short tails. A filter for the whole PRF has long
tails, because it is discontinuous where the PRF band wraps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from torchsar.core import Axis, Signal
from torchsar.focus.nufft import smooth_length
from torchsar.focus.omega_k import BAND_EDGE
from torchsar.radar import StripmapRadar

# arrays of block size in memory: raw block, its image, and the previous image held by the caller
ARRAYS = 3


class Lines(Protocol):
    """Any source of complex raw lines that can be sliced as source[..., first:last, :].

    Examples are a tensor, a numpy array or memmap, and a zarr array.
    """

    shape: Any

    def __getitem__(self, key: Any) -> Any: ...


@dataclass(frozen=True)
class StripPlan:
    """Division of a strip into overlapping blocks of raw lines that fit the memory.

    Image line k needs the raw lines k + reach[0] to k + reach[1].

    Args:
        n_lines: Number of lines of the strip.
        height: Raw lines read per block.
        reach: First and last raw line that contribute to an image line, relative to it.
        bytes: Memory in bytes for the samples of the three arrays that `plan_strip` describes.
    """

    n_lines: int
    height: int
    reach: tuple[int, int]
    bytes: int

    @property
    def blocks(self) -> list[tuple[slice, slice]]:
        """Raw lines to read and image lines to keep for each block; kept lines tile the strip."""
        if self.height >= self.n_lines:
            return [(slice(0, self.n_lines), slice(0, self.n_lines))]
        step = self.height - (self.reach[1] - self.reach[0])
        cuts = [*range(0, self.n_lines, step), self.n_lines]
        starts = (min(max(0, first + self.reach[0]), self.n_lines - self.height) for first in cuts[:-1])
        return [
            (slice(start, start + self.height), slice(first, last))
            for start, first, last in zip(starts, cuts[:-1], cuts[1:], strict=True)
        ]


def filter_tail(guard_lines: float) -> float:
    """Compute the part of the energy of an azimuth filter beyond its aperture and a guard.

    The filter uses the whole PRF, and its phase jumps where the PRF band wraps. The largest jump,
    by pi, gives a tail of magnitude 1 / (pi g) at g lines from the ends of the aperture. The mean
    energy over jumps of all phases, which is returned, is half of that of the largest.

    Args:
        guard_lines: Distance g from the ends of the aperture in lines.

    Returns:
        Energy beyond the guard relative to the whole energy of the filter.
    """
    return 1 / (math.pi**2 * guard_lines)


def reach_lines(
    radar: StripmapRadar,
    axes: tuple[Axis, ...],
    doppler_hz: tuple[float, float],
    *,
    frame_hz: float | None = None,
    band_hz: float | None = None,
    tolerance_db: float = -60.0,
) -> tuple[int, int]:
    """Compute the first and last raw line, relative to an image line, that contribute to it.

    With a processed band (`band_hz`), its soft edges make the azimuth filter short: few lines
    contribute, and the tolerance holds for any data. Without it the aperture is that of the whole
    PRF. The tolerance then holds for data whose spectrum is 30 dB down at the ends of the PRF band
    (a beam narrower than the PRF, little noise). For data that fill the band, the blocks agree with
    one transform of the whole strip to about -45 dB.

    Args:
        radar: Radar of the recording.
        axes: Axes of the raw matrix, (pulse, range).
        doppler_hz: Lowest and highest absolute centroid of the strip in Hz.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates;
            None for the centroid itself.
        band_hz: Processed Doppler bandwidth of the focuser in Hz; None for the whole PRF.
        tolerance_db: Energy of the tails of the filter that are cut off, relative to its whole
            energy, in dB.

    Returns:
        First and last contributing raw line relative to the image line; the first is negative where
        earlier lines contribute.
    """
    far, near = axes[-1].stop, axes[-1].start
    cos2 = 1 - max(float(radar.sin_squint(f)) ** 2 for f in doppler_hz)
    rate = float(radar.azimuth_rate_hz_s(far)) * cos2**1.5
    if band_hz is None:
        aperture, guard = radar.prf_hz**2 / rate, 1e-3 * filter_tail(1.0) / 10 ** (tolerance_db / 10)
    else:
        # tails of a raised-cosine edge of width w fall as (w tau)^-5 in energy: 3e-5 (w tau)^-5
        periods = (3e-5 / 10 ** (tolerance_db / 10)) ** 0.2
        aperture, guard = (
            band_hz * (1 + BAND_EDGE) * radar.prf_hz / rate,
            (2 + periods) * radar.prf_hz / (BAND_EDGE * band_hz),
        )
    shifts = [
        _frame_shift_s(radar, f, f if frame_hz is None else frame_hz, r) * radar.prf_hz
        for f in doppler_hz
        for r in (near, far)
    ]
    half = aperture / 2 + guard
    return math.floor(min(shifts) - half), math.ceil(max(shifts) + half)


def _frame_shift_s(radar: StripmapRadar, doppler_hz: float, frame_hz: float, range_m: float) -> float:
    """Time from the crossing of the frame direction to the crossing of the beam centre, for a
    target at slant range range_m in the frame.
    """
    sin, sin_frame = (float(radar.sin_squint(f)) for f in (doppler_hz, frame_hz))
    closest = range_m * math.sqrt(1 - sin_frame**2)
    return closest / radar.velocity_m_s * (sin_frame / math.sqrt(1 - sin_frame**2) - sin / math.sqrt(1 - sin**2))


def plan_strip(shape: tuple[int, ...], reach: tuple[int, int], memory_bytes: int, itemsize: int = 8) -> StripPlan:
    """Divide a strip into blocks that fit a memory limit.

    Three arrays of the size of a block are in memory at once: its raw lines, its image, and the
    image of the previous block.

    Args:
        shape: Shape of the strip, (..., line, sample).
        reach: First and last raw line that contribute to an image line, relative to it, see
            `reach_lines`.
        memory_bytes: Memory for these arrays in bytes.
        itemsize: Bytes per sample.

    Returns:
        Plan of the blocks.

    Raises:
        ValueError: If the memory holds fewer lines per block than 9/8 of the overlap of the blocks;
            the message names the least memory.
    """
    n_lines = shape[-2]
    line_bytes = ARRAYS * itemsize * math.prod(shape[:-2]) * shape[-1]
    overlap = reach[1] - reach[0]
    height = memory_bytes // line_bytes
    if height >= n_lines:
        return StripPlan(n_lines, n_lines, reach, n_lines * line_bytes)
    least = overlap + max(1, overlap // 8)
    if height < least:
        raise ValueError(
            f"memory_bytes must hold blocks of at least {least} lines, since blocks overlap by {overlap} lines, got "
            f"{memory_bytes / 1e9:.3g} GB, which hold {height} lines; allow at least {least * line_bytes / 1e9:.3g} "
            "GB, or process a narrower Doppler band"
        )
    height = max((h for h in range(max(least, height // 2), height + 1) if smooth_length(h) == h), default=height)
    return StripPlan(n_lines, height, reach, height * line_bytes)


def focus_strip(
    source: Lines,
    focus: Callable[..., Signal],
    radar: StripmapRadar,
    plan: StripPlan,
    *,
    axes: tuple[Axis, ...] | None = None,
    values: Callable[[slice], Mapping[str, Tensor | float]] | None = None,
    device: torch.device | str | None = None,
) -> Iterator[tuple[slice, Signal]]:
    """Focus a strip block by block.

    At most `plan.bytes` of samples are in memory if the caller keeps one block at a time; the
    working memory of the focusing stage (tens of megabytes) is additional.

    Args:
        source: Raw lines, shape (..., line, sample), read by blocks.
        focus: Focusing stage or chain that keeps the size of the matrix, or makes a whole multiple
            of its lines, the same in every block. It is called for each block as focus(signal,
            **values(lines)), where `lines` is the slice of its raw lines.
        radar: Radar of the recording.
        plan: Division of the strip into blocks, from `plan_strip`.
        axes: Axes of the raw matrix; None for those of the radar.
        values: Function of a slice of raw lines that returns the values that change along the
            strip, such as {"doppler_hz": ..., "velocity_m_s": ...}; None where there are none. If
            the Doppler changes, the radar should have a nominal pointing, so that all blocks have
            the same image coordinates.
        device: Device for the computation.

    Yields:
        The slice of image lines of each block and their image; the images tile the strip.

    Raises:
        ValueError: If the source has another number of lines than the plan.
    """
    if source.shape[-2] != plan.n_lines:
        raise ValueError(
            f"source must have the {plan.n_lines} lines of the plan, got {source.shape[-2]} lines; make a plan "
            "with plan_strip(source.shape, ...)"
        )
    axes = radar.raw_axes(plan.n_lines, source.shape[-1]) if axes is None else axes
    for read, keep in plan.blocks:
        image = _focus_block(source, focus, radar, axes, read, keep, {} if values is None else values(read), device)
        factor = image.data.shape[-2] // (keep.stop - keep.start)
        yield slice(keep.start * factor, keep.stop * factor), image


def _focus_block(
    source: Lines,
    focus: Callable[..., Signal],
    radar: StripmapRadar,
    axes: tuple[Axis, ...],
    read: slice,
    keep: slice,
    values: Mapping[str, Tensor | float],
    device: torch.device | str | None,
) -> Signal:
    """Focus one block and select the image lines to keep."""
    pulse, range_ = axes
    raw = Signal(torch.as_tensor(source[..., read, :], device=device), (pulse.part(read.start, read.stop), range_))
    image = focus(raw, **values).data
    del raw
    # the azimuth transform is circular: an image line outside the block appears at its position
    # modulo the block
    factor = image.shape[-2] // (read.stop - read.start)
    first, count = (keep.start - read.start) * factor % image.shape[-2], (keep.stop - keep.start) * factor
    if first + count > image.shape[-2]:
        image, first = torch.roll(image, -first, dims=-2), 0
    azimuth, image_range = radar.image_axes(axes)
    kept = azimuth.part(keep.start, keep.stop).resampled(factor)
    return Signal(image.narrow(-2, first, count), (kept, image_range))


def write_strip(blocks: Iterator[tuple[slice, Signal]], target: Any) -> None:
    """Write the blocks of `focus_strip` into an array as they are produced.

    Args:
        blocks: Image lines of each block and their image, as yielded by `focus_strip`.
        target: Tensor, numpy array or memmap, or zarr array, written as target[..., lines, :].
    """
    for lines, image in blocks:
        samples: Any = image.data if isinstance(target, Tensor) else image.data.cpu().numpy()
        target[..., lines, :] = samples
        del image
