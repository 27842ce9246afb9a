"""Focusing of strips longer than memory, by overlapping azimuth blocks of known size.

A focused line is a convolution of raw lines with the azimuth filter, which occupies (processed
band) / (Doppler rate) seconds and has tails beyond. Blocks overlap by that length and by a guard
that holds the energy of the cut tails below a tolerance; apart from those tails the blocks give
what one transform of the whole strip gives. Focusers with a processed band (`band_hz`) have short
tails; those that use the whole PRF have long ones, because their filter jumps where the band wraps.
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

# of block size at once: raw block, its image, and the previous image in the hands of the caller
ARRAYS = 3


class Lines(Protocol):
    """Anything sliceable as source[..., first:last, :] into complex samples: a tensor, a numpy
    array or memmap, a zarr array.
    """

    shape: Any

    def __getitem__(self, key: Any) -> Any: ...


@dataclass(frozen=True)
class StripPlan:
    """How a strip is cut. Image line k needs the raw lines k + reach[0] ..

    k + reach[1]; blocks read `height` lines each.
    """

    n_lines: int
    height: int
    reach: tuple[int, int]
    bytes: int

    @property
    def blocks(self) -> list[tuple[slice, slice]]:
        """(raw lines to read, image lines to keep) of every block; the kept ones tile the strip."""
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
    """Energy of a whole-PRF azimuth filter beyond guard_lines from the ends of its aperture,
    relative to all of it.

    The filter's phase jumps by any amount where the PRF band wraps; a jump of two gives |h| = 1 /
    (pi g), half of it on average.
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
    """First and last raw line, relative to an image line, that the image line is made of.

    doppler_hz: lowest and highest absolute centroid of the strip; frame_hz: frame of the image
    coordinates, the centroid itself where None. band_hz: the processed Doppler band of the focuser;
    its soft edges make the filter compact, the overlap shortest and the tolerance sure. Without one
    the aperture is that of the whole PRF, and the guard keeps tails below the tolerance for data
    whose ends of the PRF band are 30 dB down (a beam narrower than the PRF, little noise): data
    that fill the band agree to about -45 dB.
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
    """Time from the crossing of the frame's direction to the crossing of the beam centre, for a
    target at slant range range_m of the frame.
    """
    sin, sin_frame = (float(radar.sin_squint(f)) for f in (doppler_hz, frame_hz))
    closest = range_m * math.sqrt(1 - sin_frame**2)
    return closest / radar.velocity_m_s * (sin_frame / math.sqrt(1 - sin_frame**2) - sin / math.sqrt(1 - sin**2))


def plan_strip(shape: tuple[int, ...], reach: tuple[int, int], memory_bytes: int, itemsize: int = 8) -> StripPlan:
    """Blocks for a strip of shape (..., line, sample) that never hold more than memory_bytes of
    samples, three arrays of a block at once.

    Raises ValueError, naming the least memory that would do, where the overlap leaves no room for
    new lines.
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
            f"strip blocks of {height} lines ({memory_bytes / 1e9:.3g} GB) do not hold the "
            f"overlap of {overlap} lines; allow at least {least * line_bytes / 1e9:.3g} GB, or a "
            "narrower processed band"
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
    """Focus block after block; yields (image lines, their image), which tile the strip.

    source: (..., line, sample), read by blocks. focus: any focusing stage or chain that keeps the
    matrix size, called as focus(signal, **values(lines)). values: what differs along the strip,
    such as {"doppler_hz": ..., "velocity_m_s": ...} for the raw lines of a block; then the radar
    should have a nominal pointing, which keeps all blocks in one frame. Holds at most `plan.bytes`
    of samples if the caller keeps one block; the stage's own blocks come on top (tens of
    megabytes). Raises ValueError where source and plan disagree.
    """
    if source.shape[-2] != plan.n_lines:
        raise ValueError(
            f"the plan is for {plan.n_lines} lines, the source has {source.shape[-2]}; plan anew "
            "with plan_strip(source.shape, ...)"
        )
    axes = radar.raw_axes(plan.n_lines, source.shape[-1]) if axes is None else axes
    for read, keep in plan.blocks:
        yield keep, _focus_block(source, focus, radar, axes, read, keep, {} if values is None else values(read), device)


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
    pulse, range_ = axes
    raw = Signal(torch.as_tensor(source[..., read, :], device=device), (pulse.part(read.start, read.stop), range_))
    image = focus(raw, **values).data
    del raw
    # the azimuth transform is circular: an image line outside the block read appears at its place
    # modulo the block
    first, count = (keep.start - read.start) % image.shape[-2], keep.stop - keep.start
    if first + count > image.shape[-2]:
        image, first = torch.roll(image, -first, dims=-2), 0
    azimuth, image_range = radar.image_axes(axes)
    return Signal(image.narrow(-2, first, count), (azimuth.part(keep.start, keep.stop), image_range))


def write_strip(blocks: Iterator[tuple[slice, Signal]], target: Any) -> None:
    """Write every block into target[..., lines, :] (a tensor, numpy array or memmap, zarr array) as
    it is made.
    """
    for lines, image in blocks:
        samples: Any = image.data if isinstance(target, Tensor) else image.data.cpu().numpy()
        target[..., lines, :] = samples
        del image
