"""Reader of recorded raw stripmap data in `.npz` files.

`Recording.from_arrays` makes a recording from arrays in any other form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Recording, StoredArray
from torchsar.io.fields import Described, archive, joined, naming, number, refuse_missing, shown
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
# chosen likewise
_WAVELENGTHS_M = (3e-8, 15.0)
# optional keys that become side data of the recording
_AUX = ("agc_db", "line_number", "pilot")


def read_stripmap(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read a raw stripmap recording from a numpy archive.

    The archive (.npz, without pickled objects) must hold these keys:
    - `iq`: samples, complex (line, sample), or integer or float (line, sample, 2) with I and Q.
    - `fs_hz`, `prf_hz`, `f0_hz`: sampling rate, pulse repetition frequency and carrier in Hz.
    - `chirp_rate_hz_s`, `pulse_s`: chirp rate, negative for a down-chirp, and pulse length.
    - `slant_range_cell1_m`: slant range of a target whose echo begins at range cell 1.
    - `v_eff_m_s`: nominal effective velocity.
    It may hold `first_cell` (range cell of the first sample, counted from 1, by default 1), `c_m_s`
    (speed of light), `agc_db` (line,) (attenuation of the receiver in dB, which is compensated
    here), `line_number` (line,) and `pilot` (sample,), a recorded pilot tone. Other keys are
    ignored, including the Doppler ambiguity number, which is estimated from the data.

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
    path = Path(path)
    found = describe_stripmap(archive(path, "raw stripmap data"), path)
    with naming(path):
        iq = found.samples.load()
        data = iq if iq.ndim == 2 else joined(iq[..., 0], iq[..., 1])
        return Recording.from_arrays(data, found.radar, dtype=dtype, what=str(path), **found.aux)


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
    numbers = {key: number(fields[key], signed=key == "chirp_rate_hz_s") for key in _REQUIRED[1:]}
    c = number(fields["c_m_s"]) if "c_m_s" in fields else LIGHT_M_S
    iq = _samples(fields["iq"])
    with naming(path):
        _refuse_implausible(numbers, c)
        radar = _radar(numbers, c, _first_cell(fields))
        if "pilot" in fields:
            _refuse_other_than_tone(fields["pilot"])
        aux: dict[str, Any] = {name: _side(fields[name], iq) for name in _AUX if name in fields}
    return Described(iq, radar, aux)


def _refuse_implausible(number: dict[str, float], c: float) -> None:
    """Raise ValueError for numbers that no recording has; c in m/s."""
    for key, (low, high, unit) in _RANGES.items():
        if not low <= number[key] <= high:
            raise ValueError(f"{key} is {number[key]:g} {unit}, and should be {low:g} to {high:g} {unit}; check it")
    carrier, band = number["f0_hz"], abs(number["chirp_rate_hz_s"]) * number["pulse_s"]
    low, high = (c / length for length in reversed(_WAVELENGTHS_M))
    if not low <= carrier <= high:
        raise ValueError(f"f0_hz is {carrier:g} Hz, and should be {low:g} to {high:g} Hz; check it")
    if band > 2 * carrier:
        raise ValueError(
            f"the bandwidth chirp_rate_hz_s pulse_s is {band:g} Hz, beyond f0_hz of {carrier:g} Hz; check it"
        )
    if number["pulse_s"] * number["prf_hz"] > 1:
        raise ValueError(
            f"pulse_s of {number['pulse_s']:g} s is longer than the pulse interval, 1 / prf_hz of "
            f"{1 / number['prf_hz']:g} s; check both"
        )


def _radar(number: dict[str, float], c: float, first_cell: int) -> StripmapRadar:
    """Radar with these numbers, c in m/s."""
    rate, duration, fs = number["chirp_rate_hz_s"], number["pulse_s"], number["fs_hz"]
    return StripmapRadar(
        carrier_hz=number["f0_hz"],
        pulse=LinearFM(abs(rate) * duration, duration, 1 if rate > 0 else -1),
        sampling_hz=fs,
        prf_hz=number["prf_hz"],
        velocity_m_s=number["v_eff_m_s"],
        near_range_m=number["slant_range_cell1_m"] + (first_cell - 1) * c / (2 * fs),
        wave_speed_m_s=c,
    )


def _first_cell(fields: Mapping[str, StoredArray]) -> int:
    """Index of the first sample, counted from 1."""
    if "first_cell" not in fields:
        return 1
    field = fields["first_cell"]
    value = float(field.load()) if field.shape == () and field.dtype.kind in "iuf" else math.nan
    if not value.is_integer():
        raise ValueError(f"{field.what} must be one whole number, got {shown(field)}")
    return int(value)


def _samples(field: StoredArray) -> StoredArray:
    """The samples, complex or as I and Q."""
    real = len(field.shape) == 3 and field.shape[-1] == 2 and field.dtype.kind in "iuf"
    if 0 not in field.shape and (real or (len(field.shape) == 2 and field.dtype.kind == "c")):
        return field
    raise ValueError(
        f"{field.what} must be complex (line, sample) or (line, sample, 2) with real I and Q, at least one sample, got "
        f"{field.described}"
    )


def _side(field: StoredArray, iq: StoredArray) -> np.ndarray:
    """Side data, which have an entry per line or per sample."""
    if math.prod(field.shape) > math.prod(iq.shape):
        raise ValueError(
            f"{field.what} must have one entry per line or per sample of {iq.described}, got {field.described}"
        )
    return field.load()


def _refuse_other_than_tone(pilot: StoredArray) -> None:
    """Raise ValueError unless a pilot tone is a single row of samples."""
    if len(pilot.shape) != 1 or 0 in pilot.shape:
        raise ValueError(f"{pilot.what} must be one row of samples, got {pilot.described}")
