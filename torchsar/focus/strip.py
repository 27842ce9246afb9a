"""Focusing of strips longer than memory, by overlapping azimuth blocks.

A focused line is a convolution of raw lines with the azimuth filter. The main part of the filter
has the length of the time in which the line of sight crosses the processed Doppler band; beyond it,
the filter has tails. Blocks overlap by this length and by a guard. The guard is so long that the
tails beyond it, which are cut off, are below a given level. Apart from these tails, the blocks
equal one transform of the whole strip.

The soft edges of a processed band (`band_hz`) make the tails short. A filter for the whole PRF has
a discontinuity at the limits of the PRF band. Its tails therefore decrease only as 1 / g at g lines
from the ends of the aperture, independently of the length of the blocks. For an error of -35 dB at
the ends of the blocks, a guard of 640 lines is necessary; for -60 dB, 203,000 lines.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage
from torchsar.core.fft import smooth_length
from torchsar.focus.frame_geometry import BAND_EDGE, raised_cosine_band
from torchsar.focus.omega_k import Focuser, OmegaK
from torchsar.focus.range_doppler import RangeDoppler
from torchsar.focus.stolt import OmegaKStolt
from torchsar.radar import StripmapRadar

# number of arrays of block size in memory: raw block, its image, and the previous image, which the
# caller still holds
ARRAYS = 3
# largest sine of the squint for which an aperture is computed; beyond it, waves run along the path
_STEEPEST = 1 - 1e-6


class Lines(Protocol):
    """Any source of complex raw lines that can be sliced as source[..., first:last, :].

    Examples are a tensor, a numpy array or memmap, and a zarr array.
    """

    shape: Any

    def __getitem__(self, key: Any, /) -> Any: ...


@dataclass(frozen=True)
class StripPlan:
    """Division of a strip into overlapping blocks of raw lines that fit the memory.

    Image line k needs the raw lines k + reach[0] to k + reach[1].

    Args:
        n_lines: Number of lines of the strip.
        height: Raw lines read per block.
        reach: First and last raw line that contribute to an image line, relative to it.
        bytes: Memory in bytes for the samples of the three arrays that `plan_strip` describes.
        multiple: Number of which the image lines kept per block are a whole multiple, except in the
            last block.
    """

    n_lines: int
    height: int
    reach: tuple[int, int]
    bytes: int
    multiple: int = 1

    @property
    def blocks(self) -> list[tuple[slice, slice]]:
        """Raw lines to read and image lines to keep for each block. The kept lines of all blocks
        cover the strip once.
        """
        if self.height >= self.n_lines:
            return [(slice(0, self.n_lines), slice(0, self.n_lines))]
        step = (self.height - (self.reach[1] - self.reach[0])) // self.multiple * self.multiple
        cuts = [*range(0, self.n_lines, step), self.n_lines]
        starts = (min(max(0, first + self.reach[0]), self.n_lines - self.height) for first in cuts[:-1])
        return [
            (slice(start, start + self.height), slice(first, last))
            for start, first, last in zip(starts, cuts[:-1], cuts[1:], strict=True)
        ]


def guard_lines(radar: StripmapRadar, band_hz: float | None, seam_db: float = -60.0) -> float:
    """Compute how far beyond its aperture an azimuth filter reaches.

    A raised-cosine edge of width w has tails whose energy beyond the time t is at most 3e-5 (w
    t)^-5 of that of the filter, as measured. Where the spectrum is cut at a weight W, as at the
    ends of the PRF band, it jumps by 2 W at most. The energy beyond g lines is then at most W^2 /
    (pi^2 g). It is missing in a block. Since the transform of a block is circular, the same energy
    also enters the block from the other side, so that the sum is 2 W^2 / (pi^2 g).

    Args:
        radar: Radar of the recording.
        band_hz: Processed Doppler bandwidth in Hz; None for the whole PRF.
        seam_db: Energy that is missing and that enters, relative to that of the filter, in dB.

    Returns:
        Number of lines on either side.
    """
    energy, prf = 10 ** (seam_db / 10), radar.prf_hz
    if band_hz is None:
        return 2 / (math.pi**2 * energy)
    cut = float(raised_cosine_band(torch.tensor(prf / 2 / band_hz, dtype=torch.float64)))
    return (3e-5 / energy) ** 0.2 * prf / (BAND_EDGE * band_hz) + 2 * cut**2 / (math.pi**2 * energy)


def reach_lines(
    radar: StripmapRadar,
    axes: tuple[Axis, ...],
    doppler_hz: tuple[float, float],
    *,
    frame_hz: float | None = None,
    band_hz: float | None = None,
    seam_db: float = -60.0,
) -> tuple[int, int]:
    """Compute the first and last raw line, relative to an image line, that contribute to it.

    >>> from torchsar import focus, radar
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> focus.reach_lines(sensor, sensor.raw_axes(4096, 96), (0.0, 0.0), band_hz=300.0)
    (-958, 958)

    These are the lines in which the line of sight crosses the Doppler band with its edges, over all
    ranges of the swath and all range frequencies, and the guard of `guard_lines` on either side. At
    a seam of two blocks the image then differs by `seam_db` from one transform of the whole strip,
    for any data, white noise over the whole PRF included; away from seams by less.

    Process a band of at most PRF / 1.1 with soft edges. Without a band the filter has long tails:
    -60 dB takes a guard of 203,000 lines, -42 dB takes 3,200, -35 dB takes 640.

    Args:
        radar: Radar of the recording.
        axes: Axes of the raw matrix, (pulse, range).
        doppler_hz: Lowest and highest absolute centroid of the strip in Hz.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates;
            None for the centroid itself.
        band_hz: Processed Doppler bandwidth of the focuser in Hz; None for the whole PRF.
        seam_db: Error at the seams relative to the rms of the image of white noise, in dB.

    Returns:
        First and last contributing raw line relative to the image line; the first is negative where
        earlier lines contribute.
    """
    half = radar.prf_hz / 2 if band_hz is None else min(radar.prf_hz, band_hz * (1 + BAND_EDGE)) / 2
    shifts = [
        _frame_shift_s(radar, f + offset, f if frame_hz is None else frame_hz, r, top) * radar.prf_hz
        for f in doppler_hz
        for offset in (-half, half)
        for r in (axes[-1].start, axes[-1].stop)
        for top in (-0.5, 0.5)
    ]
    guard = guard_lines(radar, band_hz, seam_db)
    return math.floor(min(shifts) - guard), math.ceil(max(shifts) + guard)


def _frame_shift_s(radar: StripmapRadar, doppler_hz: float, frame_hz: float, range_m: float, top: float) -> float:
    """Time from the crossing of the frame direction to that of the direction with a given Doppler
    frequency.

    The Doppler frequency applies at a range frequency `top` sampling rates above the carrier.
    range_m: slant range of the target in the frame.
    """
    ratio = max(0.5, 1 + top * radar.sampling_hz / radar.carrier_hz)
    sin, sin_frame = float(radar.sin_squint(doppler_hz)) / ratio, float(radar.sin_squint(frame_hz))
    sin = max(-_STEEPEST, min(_STEEPEST, sin))
    closest = range_m * math.sqrt(1 - sin_frame**2)
    return closest / radar.velocity_m_s * (sin_frame / math.sqrt(1 - sin_frame**2) - sin / math.sqrt(1 - sin**2))


def plan_strip(
    shape: tuple[int, ...], reach: tuple[int, int], memory_bytes: int, itemsize: int = 8, multiple: int = 1
) -> StripPlan:
    """Divide a strip into blocks that fit a memory limit.

    >>> from torchsar.focus import plan_strip
    >>> plan = plan_strip((1000, 100), reach=(-20, 20), memory_bytes=3 * 540 * 100 * 8)
    >>> [(kept.start, kept.stop) for read, kept in plan.blocks]  # image lines of each block
    [(0, 500), (500, 1000)]

    Three arrays of the size of a block are in memory at once: its raw lines, its image, and the
    image of the previous block.

    Args:
        shape: Shape of the strip, (..., line, sample).
        reach: First and last raw line that contribute to an image line, relative to it, see
            `reach_lines`.
        memory_bytes: Memory for these arrays in bytes.
        itemsize: Bytes per sample.
        multiple: Number of which the image lines kept per block shall be a whole multiple.

    Returns:
        Plan of the blocks.

    Raises:
        ValueError: If the memory holds fewer lines per block than 9/8 of the overlap of the blocks
            or than the overlap and `multiple`; the message names the least memory.
    """
    n_lines = shape[-2]
    line_bytes = ARRAYS * itemsize * math.prod(shape[:-2]) * shape[-1]
    overlap = reach[1] - reach[0]
    height = memory_bytes // line_bytes
    if height >= n_lines:
        return StripPlan(n_lines, n_lines, reach, n_lines * line_bytes, multiple)
    least = overlap + max(multiple, overlap // 8)
    if height < least:
        raise ValueError(
            f"memory_bytes must hold blocks of at least {least} lines, since blocks overlap by {overlap} lines, got "
            f"{memory_bytes / 1e9:.3g} GB, which hold {height} lines; allow at least {least * line_bytes / 1e9:.3g} "
            "GB, or process a narrower Doppler band (band_hz, at most PRF / 1.1), or accept larger errors at seams"
        )
    height = max((h for h in range(max(least, height // 2), height + 1) if smooth_length(h) == h), default=height)
    step = (height - overlap) // multiple * multiple
    # lines per block if all blocks have nearly equal lengths, so that the last one is not shorter
    even = math.ceil(n_lines / math.ceil(n_lines / step) / multiple) * multiple
    height = min(height, smooth_length(overlap + even))
    return StripPlan(n_lines, height, reach, height * line_bytes, multiple)


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
        raw = torch.as_tensor(source[..., read, :], device=device)
        image = focus_block(raw, focus, radar, axes, read, keep, {} if values is None else values(read))
        del raw
        factor = image.data.shape[-2] // (keep.stop - keep.start)
        yield slice(keep.start * factor, keep.stop * factor), image


def focus_block(
    raw: Tensor,
    focus: Callable[..., Signal],
    radar: StripmapRadar,
    axes: tuple[Axis, ...],
    read: slice,
    keep: slice,
    values: Mapping[str, Tensor | float],
) -> Signal:
    """Focus one block of a strip and select the image lines to keep.

    Args:
        raw: Raw lines of the block, shape (..., line, sample).
        focus: Focusing stage or chain, as for `focus_strip`.
        radar: Radar of the recording.
        axes: Axes of the raw matrix of the whole strip, (pulse, range).
        read: Slice of the raw lines of the block, an entry of `StripPlan.blocks`.
        keep: Slice of the image lines to keep, of the same entry.
        values: Values for the focusing stage.

    Returns:
        The image lines to keep.
    """
    pulse, range_ = axes
    image = focus(Signal(raw, (pulse.part(read.start, read.stop), range_)), **values).data
    del raw
    # The azimuth transform is circular. An image line outside the block therefore appears at its
    # position modulo the block.
    factor = image.shape[-2] // (read.stop - read.start)
    first, count = (keep.start - read.start) * factor % image.shape[-2], (keep.stop - keep.start) * factor
    if first + count > image.shape[-2]:
        image, first = torch.roll(image, -first, dims=-2), 0
    azimuth, image_range = radar.image_axes(axes)
    kept = azimuth.part(keep.start, keep.stop).resampled(factor)
    return Signal(image.narrow(-2, first, count), (kept, image_range))


def write_strip(blocks: Iterator[tuple[slice, Signal]], target: Any) -> None:
    """Write the blocks of `focus_strip` into an array as they are produced.

    >>> import torch
    >>> from torchsar import Axis, Signal, focus
    >>> axes = (Axis("azimuth", 2, 0.0, 1.0, "m"), Axis("range", 3, 0.0, 1.0, "m"))
    >>> image, parts = torch.zeros(4, 3), [Signal(torch.full((2, 3), x), axes) for x in (1.0, 2.0)]
    >>> focus.write_strip(iter([(slice(0, 2), parts[0]), (slice(2, 4), parts[1])]), image)
    >>> image[:, 0]
    tensor([1., 1., 2., 2.])

    Args:
        blocks: Image lines of each block and their image, as yielded by `focus_strip`.
        target: Tensor, numpy array or memmap, or zarr array, written as target[..., lines, :].
    """
    for lines, image in blocks:
        samples: Any = image.data if isinstance(target, Tensor) else image.data.cpu().numpy()
        target[..., lines, :] = samples
        del image


FORMS = {"omega_k": OmegaK, "omega_k_stolt": OmegaKStolt, "range_doppler": RangeDoppler}


class FocusStrip(Stage):
    """Stage that focuses stripmap data in overlapping blocks of lines, see `focus_strip`.

    >>> from torchsar import Draws, echo, focus, radar, scene
    >>> sensor = radar.StripmapRadar(carrier_hz=3.2e9, pulse=radar.LinearFM(40e6, 0.5e-6),
    ...     sampling_hz=48e6, prf_hz=400.0, velocity_m_s=120.0, near_range_m=4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.Dwell(0.2))
    >>> recording, _ = echo.simulate(sensor, world, n_pulse=128, n_range=96, draws=Draws(1))
    >>> image = focus.FocusStrip(sensor, band_hz=300.0)(recording.signal)
    >>> divmod(int(image.data.abs().argmax()), 96)  # line and sample of the peak
    (64, 36)

    The image differs from that of one transform by `seam_db` at the seams of the blocks. It needs
    the working memory of one block; `torchsar focus` also reads the data and writes the image block
    by block. Values passed to `forward` take precedence over those given here.

    Args:
        radar: Radar of the recording.
        form: Focusing algorithm: "omega_k", "omega_k_stolt" or "range_doppler".
        reference: Filter that compresses the pulses in range in the same pass: "matched", "flat" or
            "phase"; None for range-compressed data.
        velocity_m_s: Effective velocity in m/s; None for that of the radar.
        doppler_hz: Absolute Doppler centroid in Hz; None for the nominal pointing of the radar, or
            0 where it has none.
        frame_hz: Doppler frequency in Hz of the line of sight that defines the image coordinates, 0
            for a zero-Doppler image; None for the nominal pointing of the radar, or for the
            centroid where the radar has none.
        band_hz: Processed Doppler bandwidth in Hz; None for PRF / 1.1, the largest band whose soft
            edges the PRF holds.
        memory_gb: Memory for the samples of a block, its image and the image before it, in 10^9
            bytes.
        seam_db: Largest error at the seams relative to the rms of an image of white noise, in dB.

    Raises:
        ValueError: If `form` or `reference` is not known, or `memory_gb` or `seam_db` does not
            have the right sign.
    """

    def __init__(
        self,
        radar: StripmapRadar,
        form: Literal["omega_k", "omega_k_stolt", "range_doppler"] = "omega_k",
        reference: Literal["matched", "flat", "phase"] | None = "matched",
        velocity_m_s: float | None = None,
        doppler_hz: float | None = None,
        frame_hz: float | None = None,
        band_hz: float | None = None,
        memory_gb: float = 2.0,
        seam_db: float = -60.0,
    ) -> None:
        super().__init__()
        if form not in FORMS:
            raise ValueError(f"form of FocusStrip must be one of {', '.join(FORMS)}, got {form!r}")
        if not (memory_gb > 0 and seam_db < 0):
            raise ValueError(f"memory_gb must be positive and seam_db negative, got {memory_gb} and {seam_db}")
        band_hz = radar.prf_hz / (1 + BAND_EDGE) if band_hz is None else band_hz
        self.focuser: Focuser = FORMS[form](radar, reference, velocity_m_s, doppler_hz, frame_hz, band_hz)
        self.memory_bytes, self.seam_db = int(memory_gb * 1e9), seam_db

    def plan(
        self,
        shape: tuple[int, ...],
        axes: tuple[Axis, ...],
        itemsize: int = 8,
        multiple: int = 1,
        doppler_hz: Tensor | None = None,
        velocity_m_s: Tensor | None = None,
    ) -> StripPlan:
        """Divide a strip into blocks that fit the memory, see `plan_strip`.

        Args:
            shape: Shape of the strip, (..., line, sample).
            axes: Axes of the raw matrix, (pulse, range).
            itemsize: Bytes per sample.
            multiple: Number of which the image lines kept per block shall be a whole multiple.
            doppler_hz: Doppler centroid in Hz; None for that of the stage.
            velocity_m_s: Effective velocity in m/s; None for that of the stage.

        Returns:
            Plan of the blocks.

        Raises:
            ValueError: If the memory is too small; the message names the least memory.
        """
        focus = self.focuser
        doppler, velocity = (
            (own if given is None else given).detach()
            for own, given in ((focus.doppler_hz, doppler_hz), (focus.velocity_m_s, velocity_m_s))
        )
        slowest = replace(focus.radar, velocity_m_s=float(velocity.min()))
        frame = focus.radar.pointing_doppler_hz if focus.frame_hz is None else focus.frame_hz
        ends = float(doppler.min()), float(doppler.max())
        reach = reach_lines(slowest, axes, ends, frame_hz=frame, band_hz=focus.band_hz, seam_db=self.seam_db)
        return plan_strip(shape, reach, self.memory_bytes, itemsize, multiple)

    def forward(self, signal: Signal, doppler_hz: Tensor | None = None, velocity_m_s: Tensor | None = None) -> Signal:
        """Focus a signal with axes (pulse, range).

        Args:
            signal: Recording.
            doppler_hz: Doppler centroid in Hz; None for that of the stage.
            velocity_m_s: Effective velocity in m/s; None for that of the stage.

        Returns:
            Image with axes (azimuth, range).

        Raises:
            ValueError: If a value is not valid, see `omega_k`, or the memory is too small.
        """
        values = {"doppler_hz": doppler_hz, "velocity_m_s": velocity_m_s}
        given: dict[str, Any] = {name: value for name, value in values.items() if value is not None}
        data, raw_axes = signal.data, signal.axes
        if ARRAYS * data.numel() * data.element_size() <= self.memory_bytes:
            return self.focuser(signal, **given)
        plan = self.plan(data.shape, raw_axes, data.element_size(), **given)
        blocks = focus_strip(data, self.focuser, self.focuser.radar, plan, axes=raw_axes, values=lambda _: given)
        lines, first = next(blocks)
        azimuth, range_ = first.axes
        n = plan.n_lines * azimuth.n // plan.blocks[0][1].stop
        whole = data.new_empty((*data.shape[:-2], n, range_.n))
        write_strip(chain([(lines, first)], blocks), whole)
        return Signal(whole, (azimuth.part(0, n), range_))
