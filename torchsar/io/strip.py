"""Raw stripmap recordings, and images of strips, whole or in blocks of lines.

For data in arrays in memory, `Recording.from_arrays` makes the recording.
"""

from __future__ import annotations

import math
import warnings
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Axis, Recording, Signal, StoredArray
from torchsar.focus.detection import QuickLook
from torchsar.io.arrays import WRITE_ALL, axes_of, put, refuse_changed_files, refuse_missing_chunks, seal_files
from torchsar.io.extras import library, reading
from torchsar.io.fields import (
    Described,
    Level,
    archive,
    joined,
    likely_unit,
    naming,
    number,
    read_described,
    refuse_missing,
    shown,
    vector,
)
from torchsar.io.seal import canonical, group_attributes, sealed
from torchsar.radar import LIGHT_M_S, LinearFM, StripmapRadar
from torchsar.repair.placing import LinePlan, regular_lines

# required keys of the archive: the samples, then the parameters of the radar
_REQUIRED = ("iq", "fs_hz", "prf_hz", "f0_hz", "chirp_rate_hz_s", "pulse_s", "slant_range_cell1_m", "v_eff_m_s")
# Least and largest accepted value of each parameter, and its unit.
# The limits are far beyond the values of any recording, including sonar. Only a wrong unit or a
# damaged number exceeds them.
_RANGES = {
    "fs_hz": (1e3, 1e13, "Hz"),
    "prf_hz": (1e-3, 1e8, "Hz"),
    "pulse_s": (1e-10, 10.0, "s"),
    "slant_range_cell1_m": (0.1, 1e9, "m"),
    "v_eff_m_s": (1e-3, 3e4, "m/s"),
}
# optional keys that become side data of the recording
_AUX = ("agc_db", "line_number", "line_time_s", "pilot")
# parameters that may be given for each line
_VARYING = ("prf_hz", "slant_range_cell1_m")


def read_stripmap(path: str | Path, dtype: torch.dtype = torch.complex64, regular: bool = False) -> Recording:
    """Read a raw stripmap recording from a numpy archive.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar.io import read_stripmap
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "strip.npz"
    >>> numbers = dict(fs_hz=50e6, prf_hz=400.0, f0_hz=5.3e9, chirp_rate_hz_s=1e14, pulse_s=1e-7)
    >>> place = dict(slant_range_cell1_m=9000.0, v_eff_m_s=7000.0)
    >>> numpy.savez(path, iq=numpy.ones((4, 8), complex), **numbers, **place)
    >>> read_stripmap(path).signal.names
    ('pulse', 'range')

    The archive (.npz, without pickled objects) must hold these keys:
    - `iq`: samples, complex (line, sample), or integer or float (line, sample, 2) with I and Q.
    - `fs_hz`, `prf_hz`, `f0_hz`: sampling rate, pulse repetition frequency and carrier in Hz.
    - `chirp_rate_hz_s`, `pulse_s`: chirp rate, negative for a down-chirp, and pulse length.
    - `slant_range_cell1_m`: slant range of a target whose echo begins at range cell 1.
    - `v_eff_m_s`: nominal effective velocity.
    It may hold these:
    - `offset`: a number, or one for I and Q, that samples exceed their true values by and that is
      subtracted, such as 127.5 of bytes without sign.
    - `first_cell`: range cell of the first sample, counted from 1, by default 1.
    - `c_m_s`: speed of light.
    - `integration_s`: time that a target stays in the beam; otherwise it counts as unknown.
    - `agc_db` (line,): attenuation of the receiver in dB, which is compensated here.
    - `line_number` (line,), which jumps where lines were lost, and `line_time_s` (line,), the times
      of the pulses. `prf_hz` and `slant_range_cell1_m` may have one number per line, too, where the
      pulse rate or the start of the range window changes.
    - `pilot` (sample,): a recorded pilot tone.
    Other keys are ignored, including the Doppler ambiguity number, which is estimated from the
    data. Samples whose mean exceeds half their standard deviation cause a UserWarning.

    Args:
        path: Path of the archive.
        dtype: complex64 or complex128, dtype of the samples.
        regular: Whether lines are put on a regular grid by their numbers, times and window starts,
            as `regular_lines` does; a warning says what was done, and `missing` (line,) of the side
            data which lines were lost.

    Returns:
        Recording with the axes (pulse, range), a StripmapRadar with the usual pulse rate and the
        nearest window start, and the optional side data in `aux`, with `line_time_s` and
        `window_start_m` of what differs from line to line.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive, a key is missing or invalid, or a number is
            far from those of any recording.
    """
    recording = read_described(path, dtype, "raw stripmap data", describe_stripmap)
    level = Level()
    # in blocks of 1024 lines, so that temporary copies are small
    for block in recording.signal.data.split(1024):
        level.add(block.numpy())
    level.warn(str(path), "offset")
    if not regular:
        return recording
    with naming(path):
        plan = LinePlan.of(recording.radar, recording.aux, len(recording.signal.data))
        for note in () if plan is None else plan.notes:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        found = regular_lines(recording)
        none = torch.zeros(len(found.signal.data), dtype=torch.bool)
        return replace(found, aux={"missing": none, **found.aux})


def describe_stripmap(fields: Mapping[str, StoredArray], path: Path) -> Described:
    """Check the fields of an archive for `read_stripmap`, without loading the samples.

    Args:
        fields: The fields by key.
        path: Path of the archive, for messages.

    Returns:
        The samples, a StripmapRadar and the optional side data.

    Raises:
        ValueError: If a key is missing or invalid, or a number is far from those of any recording.
    """
    refuse_missing(fields, path, _REQUIRED, "a raw stripmap archive")
    signs = {"chirp_rate_hz_s": "number other than zero"}
    varying = {key: fields[key] for key in _VARYING if fields[key].shape == fields["iq"].shape[:1] != (1,)}
    numbers = {
        key: number(fields[key], signs.get(key, "positive number")) for key in _REQUIRED[1:] if key not in varying
    }
    per_line = {key: vector(field, field.shape[0]) for key, field in varying.items()}
    for key, values in per_line.items():
        if not bool((values > 0).all()):
            raise ValueError(f"{fields[key].what} must be positive numbers, got a least one of {float(values.min()):g}")
    numbers |= {key: float(x.median() if key == "prf_hz" else x.min()) for key, x in per_line.items()}
    c = number(fields["c_m_s"]) if "c_m_s" in fields else LIGHT_M_S
    dwell = number(fields["integration_s"], "positive number") if "integration_s" in fields else None
    first = number(fields["first_cell"], "whole number") if "first_cell" in fields else 1
    iq = fields["iq"]
    real = len(iq.shape) == 3 and iq.shape[-1] == 2 and iq.dtype.kind in "iuf"
    if (
        0 in iq.shape
        or len(iq.shape) < 2
        or iq.shape[0] < 2
        or not (real or (len(iq.shape) == 2 and iq.dtype.kind == "c"))
    ):
        raise ValueError(
            f"{iq.what} must be complex (line, sample) or (line, sample, 2) with real I and Q, two lines of at "
            f"least one sample, got {iq.described}"
        )
    with naming(path):
        _refuse_implausible(numbers, c)
        rate, duration, fs = numbers["chirp_rate_hz_s"], numbers["pulse_s"], numbers["fs_hz"]
        radar = StripmapRadar(
            carrier_hz=numbers["f0_hz"],
            pulse=LinearFM(abs(rate) * duration, duration, 1 if rate > 0 else -1),
            sampling_hz=fs,
            prf_hz=numbers["prf_hz"],
            velocity_m_s=numbers["v_eff_m_s"],
            near_range_m=numbers["slant_range_cell1_m"] + (int(first) - 1) * c / (2 * fs),
            wave_speed_m_s=c,
            integration_s=dwell,
        )
        aux: dict[str, Any] = {name: _side(fields[name], name, iq) for name in _AUX if name in fields}
        if "prf_hz" in per_line:
            aux.setdefault("line_time_s", np.cumsum(np.append(0.0, 1 / per_line["prf_hz"][:-1].numpy())))
        if "slant_range_cell1_m" in per_line:
            start = per_line["slant_range_cell1_m"].numpy()
            aux["window_start_m"] = start + (radar.near_range_m - start.min())
    return Described(iq, radar, aux, partial(_samples, offset=offset_of(fields.get("offset"))))


def _samples(iq: np.ndarray, offset: complex) -> np.ndarray:
    """Convert samples, or pairs of I and Q, to complex samples (line, sample) and subtract their
    offset.
    """
    data = iq if iq.ndim == 2 else joined(iq[..., 0], iq[..., 1])
    return data - offset if offset else data


def offset_of(field: StoredArray | None) -> complex:
    """Return the offset of recorded samples from their true values.

    Args:
        field: One number, or one for I and Q; None for no offset.

    Returns:
        The offset, I + j Q.

    Raises:
        ValueError: If the field holds anything else.
    """
    if field is None:
        return 0
    both = np.broadcast_to(field.load("iuf"), 2) if field.shape in ((), (1,), (2,)) else None
    if both is None or not np.isfinite(both).all():
        raise ValueError(f"{field.what} must be one finite number, or one for I and Q, got {shown(field)}")
    return complex(*both.tolist())


def _refuse_implausible(numbers: Mapping[str, float], c: float) -> None:
    """Raise ValueError for parameters that no recording has. c: wave speed in m/s."""
    # carrier limits of wavelengths from 15 m to 30 nm, also far beyond any recording
    ranges = {**_RANGES, "f0_hz": (c / 15, c / 3e-8, "Hz")}
    for key, (low, high, unit) in ranges.items():
        if not low <= numbers[key] <= high:
            factors = {"Hz": {"MHz": 1e6, "GHz": 1e9, "kHz": 1e3}, "s": {"us": 1e-6, "ms": 1e-3, "ns": 1e-9}}
            likely = likely_unit(numbers[key], low, high, factors.get(unit, {"km": 1e3, "mm": 1e-3}))
            raise ValueError(f"{key} is {numbers[key]:g} {unit}, and should be {low:g} to {high:g} {unit}{likely}")
    rate, duration = abs(numbers["chirp_rate_hz_s"]), numbers["pulse_s"]
    low, high = 1e-3 / duration**2, 2 * numbers["f0_hz"] / duration
    if not low <= rate <= high:
        likely = likely_unit(rate, low, high, {"MHz/us": 1e12, "kHz/us": 1e9, "MHz/s": 1e6})
        raise ValueError(
            f"the bandwidth chirp_rate_hz_s pulse_s is {rate:g} Hz/s times {duration:g} s, {rate * duration:g} Hz, and "
            f"should be {1e-3 / duration:g} Hz, 0.001 / pulse_s, to {2 * numbers['f0_hz']:g} Hz, twice "
            f"f0_hz{likely}"
        )
    if numbers["pulse_s"] * numbers["prf_hz"] > 1:
        raise ValueError(
            f"pulse_s of {numbers['pulse_s']:g} s is longer than the pulse interval, 1 / prf_hz of "
            f"{1 / numbers['prf_hz']:g} s; check both"
        )
    blind, near, speed = c * numbers["pulse_s"] / 2, numbers["slant_range_cell1_m"], numbers["v_eff_m_s"]
    if near < blind / 4:
        raise ValueError(
            f"slant_range_cell1_m is {near:g} m, far within the {blind:g} m that the pulse of {numbers['pulse_s']:g} s "
            f"covers while it is sent{likely_unit(near, blind, 1e7, {'km': 1e3})}"
        )
    if near > 2e5 and speed < 50:
        raise ValueError(
            f"v_eff_m_s is {speed:g} m/s at a slant range of {near:g} m, which only satellites see, and should be some "
            f"km/s{likely_unit(speed, 1e3, 2e4, {'km/s': 1e3})}"
        )


def _side(field: StoredArray, name: str, iq: StoredArray) -> np.ndarray:
    """Load side data after a check of their size: an entry for each line or sample, or one row for
    a pilot.
    """
    if name == "pilot" and (len(field.shape) != 1 or 0 in field.shape):
        raise ValueError(f"{field.what} must be one row of samples, got {field.described}")
    if math.prod(field.shape) > math.prod(iq.shape):
        raise ValueError(
            f"{field.what} must have one entry per line or per sample of {iq.described}, got {field.described}"
        )
    return field.load()


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
