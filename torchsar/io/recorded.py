"""Reader of recorded raw stripmap data in `.npz` files.

`Recording.from_arrays` makes a recording from arrays in any other form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Recording, StoredArray
from torchsar.io.fields import Described, Level, joined, naming, number, read_described, refuse_missing, shown
from torchsar.radar import LIGHT_M_S, LinearFM, StripmapRadar

# keys of the archive: samples, then numbers
_REQUIRED = ("iq", "fs_hz", "prf_hz", "f0_hz", "chirp_rate_hz_s", "pulse_s", "slant_range_cell1_m", "v_eff_m_s")
# least and largest accepted number with its unit, chosen far beyond those of any recording, sonar
# included: a wrong unit or a damaged number is outside
_RANGES = {
    "fs_hz": (1e3, 1e13, "Hz"),
    "prf_hz": (1e-3, 1e8, "Hz"),
    "pulse_s": (1e-10, 10.0, "s"),
    "slant_range_cell1_m": (0.1, 1e9, "m"),
    "v_eff_m_s": (1e-3, 3e4, "m/s"),
}
# optional keys that become side data of the recording
_AUX = ("agc_db", "line_number", "pilot")


def read_stripmap(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
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
    - `agc_db` (line,): attenuation of the receiver in dB, which is compensated here.
    - `line_number` (line,).
    - `pilot` (sample,): a recorded pilot tone.
    Other keys are ignored, including the Doppler ambiguity number, which is estimated from the
    data. Samples whose mean exceeds half their standard deviation cause a UserWarning.

    Args:
        path: Path of the archive.
        dtype: complex64 or complex128, dtype of the samples.

    Returns:
        Recording with the axes (pulse, range), a StripmapRadar, and the optional side data in
        `aux`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive, a key is missing or invalid, or a number is
            far from those of any recording.
    """
    recording = read_described(path, dtype, "raw stripmap data", describe_stripmap)
    level = Level()
    level.add(recording.signal.data.numpy())
    level.warn(str(path), "offset")
    return recording


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
    numbers = {key: number(fields[key], signs.get(key, "positive number")) for key in _REQUIRED[1:]}
    c = number(fields["c_m_s"]) if "c_m_s" in fields else LIGHT_M_S
    first = number(fields["first_cell"], "whole number") if "first_cell" in fields else 1
    iq = fields["iq"]
    real = len(iq.shape) == 3 and iq.shape[-1] == 2 and iq.dtype.kind in "iuf"
    if 0 in iq.shape or not (real or (len(iq.shape) == 2 and iq.dtype.kind == "c")):
        raise ValueError(
            f"{iq.what} must be complex (line, sample) or (line, sample, 2) with real I and Q, at least one sample, "
            f"got {iq.described}"
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
        )
        aux: dict[str, Any] = {name: _side(fields[name], name, iq) for name in _AUX if name in fields}
    return Described(iq, radar, aux, partial(_samples, offset=_offset(fields)))


def _samples(iq: np.ndarray, offset: complex) -> np.ndarray:
    """Complex samples (line, sample) of complex ones, or of I and Q, without their offset."""
    data = iq if iq.ndim == 2 else joined(iq[..., 0], iq[..., 1])
    return data - offset if offset else data


def _offset(fields: Mapping[str, StoredArray]) -> complex:
    """What samples exceed their true values by."""
    if "offset" not in fields:
        return 0
    both = np.broadcast_to(fields["offset"].load("iuf"), 2) if fields["offset"].shape in ((), (1,), (2,)) else None
    if both is None or not np.isfinite(both).all():
        raise ValueError(
            f"{fields['offset'].what} must be one finite number, or one for I and Q, got {shown(fields['offset'])}"
        )
    return complex(*both.tolist())


def _refuse_implausible(numbers: Mapping[str, float], c: float) -> None:
    """Raise ValueError for numbers that no recording has; c in m/s."""
    # wavelengths of 15 m to 30 nm, chosen likewise
    ranges = {**_RANGES, "f0_hz": (c / 15, c / 3e-8, "Hz")}
    for key, (low, high, unit) in ranges.items():
        if not low <= numbers[key] <= high:
            raise ValueError(f"{key} is {numbers[key]:g} {unit}, and should be {low:g} to {high:g} {unit}; check it")
    carrier, band = numbers["f0_hz"], abs(numbers["chirp_rate_hz_s"]) * numbers["pulse_s"]
    if band > 2 * carrier:
        raise ValueError(
            f"the bandwidth chirp_rate_hz_s pulse_s is {band:g} Hz, beyond f0_hz of {carrier:g} Hz; check it"
        )
    if numbers["pulse_s"] * numbers["prf_hz"] > 1:
        raise ValueError(
            f"pulse_s of {numbers['pulse_s']:g} s is longer than the pulse interval, 1 / prf_hz of "
            f"{1 / numbers['prf_hz']:g} s; check both"
        )


def _side(field: StoredArray, name: str, iq: StoredArray) -> np.ndarray:
    """Side data, which have an entry per line or per sample; a pilot tone is one row."""
    if name == "pilot" and (len(field.shape) != 1 or 0 in field.shape):
        raise ValueError(f"{field.what} must be one row of samples, got {field.described}")
    if math.prod(field.shape) > math.prod(iq.shape):
        raise ValueError(
            f"{field.what} must have one entry per line or per sample of {iq.described}, got {field.described}"
        )
    return field.load()
