"""Strips longer than memory: recordings read and images written in blocks of lines."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from torchsar.core import Axis, Recording, Signal
from torchsar.focus.detection import QuickLook
from torchsar.io.arrays import WRITE_ALL, axes_of, put, refuse_changed_files, refuse_missing_chunks, seal_files
from torchsar.io.extras import library, reading
from torchsar.io.fields import Level, archive, naming
from torchsar.io.recorded import describe_stripmap
from torchsar.io.seal import canonical, group_attributes, sealed
from torchsar.repair.placing import LinePlan

# version number of the layout of the store; a store with another number is not read
_FORMAT = 2
# folder of the samples of the image, which have checksums of their own
_CHUNKS = "image/c"
# number of samples of a chunk along range, by choice: a chunk is 8 MB as complex64
_CHUNK_SAMPLES = 4096
# number of bytes that are read from an image at once, by choice
_PART_BYTES = 32 << 20
# names of side data with one entry per line
_PER_LINE = ("agc_db", "line_number", "line_time_s", "window_start_m")


class StripRecording:
    """Raw stripmap recording in an archive for `read_stripmap`, of which lines are read.

    Args:
        path: Path of the archive, written without compression, such as by `torchsar import`.
        dtype: complex64 or complex128, dtype of the samples.

    Lines with numbers, times or window starts of their own are put on a regular grid, as
    `regular_lines` does.

    Attributes:
        radar: Radar of the recording.
        shape: Numbers of lines and samples.
        notes: What was done with the lines.
        axes: Axes of the raw matrix, (pulse, range).

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive, or its samples are compressed.
    """

    def __init__(self, path: str | Path, dtype: torch.dtype = torch.complex64) -> None:
        self.path, self.dtype = Path(path), dtype
        found = describe_stripmap(archive(self.path, "raw stripmap data"), self.path)
        self._held, self.radar = found, found.radar
        lines, samples = found.samples.shape[:2]
        for name in _PER_LINE:
            if name in found.aux and found.aux[name].shape != (lines,):
                raise ValueError(f"{path}: {name} must have one entry per line, {lines}, got {found.aux[name].shape}")
        with naming(self.path):
            side = {name: torch.as_tensor(x) for name, x in found.aux.items() if name in _PER_LINE}
            self._plan = plan = LinePlan.of(self.radar, side, lines)
        self.shape = (lines, samples) if plan is None else (plan.rows, samples + plan.further_samples)
        self.axes, self.notes = self.radar.raw_axes(*self.shape), () if plan is None else plan.notes
        level = Level()
        level.add(found.formed(found.samples.rows(0, min(lines, 64))))  # pyright: ignore[reportArgumentType]
        level.warn(str(path), "offset")

    def recording(self, first: int, last: int) -> Recording:
        """Read some of the lines.

        Args:
            first: Index of the first line.
            last: Index after the last line.

        Returns:
            Recording of these lines, with their slow times and side data, and with `missing`
            (line,), bool.

        Raises:
            ValueError: If a sample or side data are not valid, as for `read_stripmap`.
        """
        if self._plan is None:
            held = self._recorded(first, last)
            return replace(held, aux={**held.aux, "missing": torch.zeros(last - first, dtype=torch.bool)})
        start, stop = self._plan.needed(first, last)
        held = self._recorded(start, stop)
        rows = self._plan.placed(self._plan.aligned(held.signal.data, start), start, first, last, self._turns)
        aux = {name: x for name, x in held.aux.items() if name not in _PER_LINE}
        aux["missing"] = self._plan.missing[first:last]
        if "line_number" in held.aux:
            aux["line_number"] = torch.arange(first, last)
        pulse = self.axes[0].part(first, last)
        return replace(held, signal=replace(held.signal, data=rows, axes=(pulse, self.axes[1])), aux=aux)

    @cached_property
    def _turns(self) -> float:
        """Doppler centroid (cycles per line), about which lines are interpolated; estimated from
        the middle lines.
        """
        assert self._plan is not None
        n = len(self._plan.time)
        start, stop = max(0, n // 2 - 1024), min(n, n // 2 + 1024)
        return self._plan.doppler_turns(self._plan.aligned(self._recorded(start, stop).signal.data, start), start)

    def _recorded(self, first: int, last: int) -> Recording:
        """Read some of the lines as they were recorded."""
        aux = {name: x[first:last] if name in _PER_LINE else x for name, x in self._held.aux.items()}
        with naming(self.path):
            data = self._held.formed(self._held.samples.rows(first, last))
            start_s, what = self.axes[0].start + first * self.axes[0].step, f"{self.path}: lines {first} to {last - 1}"
            return Recording.from_arrays(data, self.radar, dtype=self.dtype, start_s=start_s, what=what, **aux)

    def __getitem__(self, key: Any) -> torch.Tensor:
        """Read the samples of the lines key[-2], for use by `focus_strip`."""
        return self.recording(key[-2].start, key[-2].stop).signal.data


class StripImage:
    """Image in a zarr store of version 3 that is written in blocks of lines; see `create`.

    >>> import tempfile, torch
    >>> from torchsar import Axis, io
    >>> axes = Axis("azimuth", 8, 0.0, 2.0, "m"), Axis("range", 4, 9000.0, 3.0, "m")
    >>> image = io.StripImage.create(tempfile.mkdtemp(), axes, torch.complex64, {}, {})
    >>> image.write(slice(0, 4), torch.ones(4, 4, dtype=torch.complex64), raw=0)
    >>> image.is_finished(slice(0, 4)), image.is_finished(slice(4, 8))
    (True, False)

    The store has the arrays `image`, `azimuth` and `range`, as a group of the arrays of a run (see
    `read_images`). Its attributes hold what the image depends on, and the finished blocks with
    checksums of their samples. They are written, in a single file, after the samples of a block: if
    a program is killed, at most the block at which it worked is lost.

    Args:
        path: Folder of an existing store.
        mode: "r" to read, "r+" to write further blocks.

    Attributes:
        axes: Axes of the image, (azimuth, range).
        about: What was given to `create`.

    Raises:
        FileNotFoundError: If there is no such store.
        ModuleNotFoundError: If zarr is not installed (extra `study`).
        ValueError: If the store is damaged or of another kind.
    """

    def __init__(self, path: str | Path, mode: str = "r") -> None:
        self.path = Path(path)
        if not (self.path / "zarr.json").is_file():
            raise FileNotFoundError(f"{path} does not exist; give the folder of the result of torchsar focus")
        zarr = library("zarr", "study", f"reading {path}")
        with reading(self.path, "an image of a strip"):
            held = refuse_changed_files(self.path)
            if held.get("format") != _FORMAT or not {"identity", "about", "blocks"} <= set(held):
                raise ValueError(f"{path} was not written by this version of torchsar focus; choose another folder")
            self._root: Any = zarr.open_group(str(path), mode=mode)
            self.identity, self.about = held["identity"], held["about"]
            self._blocks: dict[str, list[int]] = held["blocks"]
            self.array: Any = self._root["image"].with_config(WRITE_ALL)
            self.axes = axes_of(self._root, self.array)

    @staticmethod
    def is_begun(path: str | Path) -> bool:
        """Check if a store has finished blocks, so that it must not simply be replaced.

        Args:
            path: Folder of the store, which may not exist, or be cut off while it was created.

        Raises:
            ValueError: If it is damaged.
        """
        if not (Path(path) / "zarr.json").is_file():
            return False
        with reading(Path(path), "an image of a strip"):
            return bool(group_attributes(Path(path)).get("blocks"))

    @staticmethod
    def create(
        path: str | Path,
        axes: tuple[Axis, ...],
        dtype: torch.dtype,
        identity: Mapping[str, Any],
        about: Mapping[str, Any],
        chunk_lines: int = 256,
    ) -> StripImage:
        """Make a store without finished blocks.

        Args:
            path: Folder of the new store; an earlier one is replaced.
            axes: Axes of the image, (azimuth, range).
            dtype: Type of its samples.
            identity: What the image depends on, values that JSON can hold.
            about: Further values that JSON can hold.
            chunk_lines: Image lines of a chunk; blocks should have whole chunks.

        Returns:
            The store, open for writing.

        Raises:
            ModuleNotFoundError: If zarr is not installed (extra `study`).
        """
        zarr, codecs = (library(name, "study", f"writing {path}") for name in ("zarr", "zarr.codecs"))
        root = zarr.open_group(str(path), mode="w", zarr_format=3)
        for axis in axes:
            put(root, axis.name, axis.values(), (axis.name,), unit=axis.unit, step=axis.step)
        shape = tuple(axis.n for axis in axes)
        root.create_array(
            "image",
            shape=shape,
            dtype=str(dtype).removeprefix("torch."),
            chunks=(min(shape[0], chunk_lines), min(shape[1], _CHUNK_SAMPLES)),
            compressors=[codecs.Crc32cCodec()],  # detects a damaged chunk
            dimension_names=[axis.name for axis in axes],
            attributes={"unit": "1"},
            config=WRITE_ALL,
        )
        plain = {"format": _FORMAT, "identity": dict(identity), "about": dict(about), "blocks": {}}
        seal_files(root, Path(path), _CHUNKS, **plain)
        return StripImage(path, "r+")

    def refuse_another(self, identity: Mapping[str, Any]) -> None:
        """Check that the finished blocks are of the image that is to be continued.

        Args:
            identity: What the image depends on.

        Raises:
            ValueError: If it differs from that given to `create`.
        """
        for key, value in identity.items():
            if canonical(self.identity.get(key)) != canonical(value):
                raise ValueError(
                    f"{self.path} was made with another {key}, {self.identity.get(key)!s:.100} instead "
                    f"of {value!s:.100}; choose another folder"
                )

    def is_finished(self, lines: slice) -> bool:
        """Check if a block of image lines is finished."""
        return str(lines.start) in self._blocks

    def check(self, lines: slice, raw: int) -> None:
        """Check that a finished block is that of some raw lines, and that it is whole.

        Args:
            lines: Image lines of the block.
            raw: Checksum of these raw lines, see `samples_checksum`.

        Raises:
            ValueError: If the raw lines or the samples of the image have changed.
        """
        of_raw, of_image = self._blocks[str(lines.start)]
        if of_raw != raw:
            raise ValueError(
                f"{self.path}: lines {lines.start} to {lines.stop - 1} were made from other raw data than those of "
                "now; choose another folder"
            )
        with reading(self.path, "an image of a strip"):
            if of_image != samples_checksum(torch.from_numpy(self.array[lines])):
                raise ValueError(f"{self.path}: lines {lines.start} to {lines.stop - 1} are damaged; start again")

    def write(self, lines: slice, image: torch.Tensor, raw: int) -> None:
        """Write a block of the image, and then mark it as finished.

        Args:
            lines: Image lines of the block.
            image: Their samples.
            raw: Checksum of the raw lines from which it was made, see `samples_checksum`.
        """
        self.array[lines] = image.numpy()
        self._blocks[str(lines.start)] = [raw, samples_checksum(image)]
        self._root.update_attributes(sealed({**dict(self._root.attrs), "blocks": self._blocks}))

    def parts(self, multiple: int = 1) -> Iterator[tuple[slice, Signal]]:
        """Read the image in parts of at most 32 MiB, or of `multiple` lines if these are more.

        Args:
            multiple: Number of which the lines of every part but the last are a whole multiple.

        Yields:
            The lines of a part, and the part with its axes.

        Raises:
            ValueError: If a chunk is damaged or missing.
        """
        azimuth, range_ = self.axes
        with reading(self.path, "an image of a strip"):
            refuse_missing_chunks(self.array)
        # number of lines with which no chunk is read twice
        whole = math.lcm(multiple, self.array.chunks[0])
        step = max(1, _PART_BYTES // (multiple * range_.n * self.array.dtype.itemsize)) * multiple
        step -= step % whole if step >= whole else 0
        for first in range(0, azimuth.n, step):
            lines = slice(first, min(first + step, azimuth.n))
            with reading(self.path, "an image of a strip"):
                data = torch.from_numpy(self.array[lines])
            yield lines, Signal(data, (azimuth.part(lines.start, lines.stop), range_))

    def quick_look(self, stage: QuickLook) -> Signal:
        """Compute the picture of the image that a stage makes of it, reading it in parts.

        Args:
            stage: The stage.

        Returns:
            Amplitude, as from the stage for the whole image.
        """
        detect = stage.detect(self.axes)
        looks = detect.looks[0]
        looked = [detect(part).data for lines, part in self.parts(looks) if lines.stop - lines.start >= looks]
        return Signal(torch.cat(looked, -2), detect.axes(self.axes))


def samples_checksum(samples: torch.Tensor) -> int:
    """Compute a checksum (CRC-32) of samples on the CPU, by which other samples are recognised.

    Args:
        samples: Samples, any shape.

    Returns:
        The checksum.
    """
    return zlib.crc32(samples.contiguous().view(torch.uint8).numpy().data)
