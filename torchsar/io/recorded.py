"""Reader of recorded raw stripmap data in `.npz` files.

For data in arrays in memory, `Recording.from_arrays` makes the recording.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Recording, StoredArray
from torchsar.io.fields import (
    Described,
    Level,
    joined,
    likely_unit,
    naming,
    number,
    read_described,
    refuse_missing,
    shown,
    vector,
)
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
    return Described(iq, radar, aux, partial(_samples, offset=_offset(fields)))


def _samples(iq: np.ndarray, offset: complex) -> np.ndarray:
    """Convert samples, or pairs of I and Q, to complex samples (line, sample) and subtract their
    offset.
    """
    data = iq if iq.ndim == 2 else joined(iq[..., 0], iq[..., 1])
    return data - offset if offset else data


def _offset(fields: Mapping[str, StoredArray]) -> complex:
    """Offset of the recorded samples from their true values, I + j Q."""
    if "offset" not in fields:
        return 0
    both = np.broadcast_to(fields["offset"].load("iuf"), 2) if fields["offset"].shape in ((), (1,), (2,)) else None
    if both is None or not np.isfinite(both).all():
        raise ValueError(
            f"{fields['offset'].what} must be one finite number, or one for I and Q, got {shown(fields['offset'])}"
        )
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
