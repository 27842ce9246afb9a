"""Reader of recorded raw stripmap data in `.npz` files.

`Recording.from_arrays` makes a recording from arrays in any other form.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Recording
from torchsar.radar import LIGHT_M_S, LinearFM, StripmapRadar

# keys of the archive: samples, then numbers
_REQUIRED = ("iq", "fs_hz", "prf_hz", "f0_hz", "chirp_rate_hz_s", "pulse_s", "slant_range_cell1_m", "v_eff_m_s")
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
        ValueError: If the file is not such an archive, or a key is missing or invalid.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"data.file: {path} does not exist; give the path of a raw stripmap .npz file")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} must be a numpy archive (.npz) without pickled objects: {error}") from None
    missing = [key for key in _REQUIRED if key not in arrays]
    if missing:
        raise ValueError(
            f"{path} lacks the keys {missing}; a raw stripmap archive must hold {list(_REQUIRED)}, "
            f"got the keys {sorted(arrays)}"
        )
    number = {key: _number(arrays, key, path) for key in _REQUIRED[1:]}
    c = _number(arrays, "c_m_s", path) if "c_m_s" in arrays else LIGHT_M_S
    first_cell = _first_cell(arrays, path)
    try:
        radar = _radar(number, c, first_cell)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    aux: dict[str, Any] = {name: arrays[name] for name in _AUX if name in arrays}
    return Recording.from_arrays(_complex(arrays["iq"], path), radar, dtype=dtype, what=str(path), **aux)


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


def _number(arrays: dict[str, np.ndarray], key: str, path: Path) -> float:
    """One finite number, positive except for the chirp rate, whose sign is the direction."""
    value = np.asarray(arrays[key])
    signed = key == "chirp_rate_hz_s"
    plain = value.ndim == 0 and value.dtype.kind in "iuf"
    if not (plain and np.isfinite(value) and (value != 0 if signed else value > 0)):
        raise ValueError(
            f"{path}: {key} must be one "
            f"{'number other than zero' if signed else 'positive number'}, got {_shown(value)}"
        )
    return float(value)


def _first_cell(arrays: dict[str, np.ndarray], path: Path) -> int:
    """Index of the first sample, counted from 1."""
    value = np.asarray(arrays.get("first_cell", 1))
    if value.ndim or value.dtype.kind not in "iuf" or value != np.round(value):
        raise ValueError(f"{path}: first_cell must be one whole number, got {_shown(value)}")
    return int(value)


def _shown(value: np.ndarray) -> str:
    """Value or shape of an array for messages."""
    return repr(value.item()) if value.ndim == 0 else f"{value.dtype} of shape {value.shape}"


def _complex(iq: np.ndarray, path: Path) -> np.ndarray:
    """Samples as complex numbers."""
    if np.iscomplexobj(iq) and iq.ndim == 2:
        return iq
    if iq.ndim == 3 and iq.shape[-1] == 2 and iq.dtype.kind in "iuf":
        return iq[..., 0].astype(np.float32) + 1j * iq[..., 1].astype(np.float32)
    raise ValueError(
        f"{path}: iq must be complex (line, sample) or (line, sample, 2) with real I and Q, got {iq.dtype} of "
        f"shape {iq.shape}"
    )
