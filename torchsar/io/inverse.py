"""Reader of recorded inverse synthetic aperture and spotlight data in `.npz` files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording
from torchsar.radar import LIGHT_M_S, InverseRadar, range_profiles
from torchsar.radar.spotlight import frequency_step_hz

# sample array of each kind of data, and the keys that it requires
_SCHEMAS = {
    "profiles": ("range_step_m", "bandwidth_hz", "prf_hz"),
    "sig": ("freq_hz", "angle_deg"),
    "fp": ("freq_hz", "x_m", "y_m", "z_m", "r0_m"),
}
# C band, commonly given in the literature for the Yak-42 recording, not verified; `profiles`
# without `f0_hz` are taken for data of this kind
UNSTATED_CARRIER_HZ = 5.52e9


def read_inverse(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read range profiles, a turntable sweep or a spotlight phase history from a numpy archive.

    The archive (.npz, without pickled objects) holds exactly one of three complex sample arrays,
    each with further keys:
    - Target in flight: range profiles `profiles` (range, pulse), with range increasing away from
      the radar. Numbers: `range_step_m`, `bandwidth_hz`, `prf_hz`, and optionally the carrier
      `f0_hz`, which only scales cross range (by default 5.52e9).
    - Turntable: `sig` (frequency, pulse), in which the point (x, y) has the phase -4 pi f (x cos a
      + y sin a) / c. Arrays: the frequencies f in `freq_hz` (frequency,), rising in equal steps,
      and the rotation angles a in `angle_deg` (pulse,).
    - Spotlight: `fp` (frequency, pulse), in which the point p has the phase -4 pi f (|antenna - p|
      - r0) / c. Arrays: `freq_hz` (frequency,) as above, the antenna position `x_m`, `y_m`, `z_m`
      (pulse,) relative to the scene centre, and the reference range r0 in `r0_m` (pulse,).
    Turntable and spotlight data may have `prf_hz`; by default it is 1, so that slow time counts
    pulses. Other keys are ignored.

    Args:
        path: Path of the archive.
        dtype: complex64 or complex128, dtype of the profiles.

    Returns:
        Recording of range profiles with the axes (pulse, range) and an InverseRadar. Range is zero
        at cell n // 2, the scene centre. The field `rotation_rad_s` of the radar is the mean
        rotation rate of the line of sight in rad/s. It is None for a target in flight, or if the
        line of sight does not turn.

        Profiles of turntable and spotlight data are the centred unitary inverse FFT of the
        frequency samples; the function `torchsar.radar.frequency_samples` restores the samples.
        `aux` then holds float64 tensors, the inputs of `PolarFormat` and `SpotlightBackprojection`.
        For a turntable they are `frequency_hz` (range,) and `angle_rad` (pulse,); for spotlight
        data `frequency_hz`, `position_m` (pulse, 3) and `reference_m` (pulse,).

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive, or a key is missing or invalid.
    """
    path = Path(path)
    arrays = _load(path)
    kind = _kind(arrays, path)
    samples = _samples(arrays[kind], kind, path)
    radar, aux = _READERS[kind](arrays, samples.shape, path)
    data = samples.T if kind == "profiles" else range_profiles(samples.T.to(torch.complex128))
    return Recording.from_arrays(data.contiguous(), radar, dtype=dtype, what=str(path), **aux)


def _load(path: Path) -> dict[str, np.ndarray]:
    """Arrays of the archive by name."""
    if not path.is_file():
        raise FileNotFoundError(
            f"data.file: {path} does not exist; give the path of an .npz file with range profiles or phase history"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} must be a numpy archive (.npz) without pickled objects: {error}") from None


def _kind(arrays: dict[str, np.ndarray], path: Path) -> str:
    """Key of the only sample array in the archive; raise ValueError if keys are missing."""
    found = [kind for kind in _SCHEMAS if kind in arrays]
    if len(found) != 1:
        choices = "; ".join(f"{kind} with {', '.join(keys)}" for kind, keys in _SCHEMAS.items())
        raise ValueError(
            f"{path} must hold exactly one of the sample arrays ({choices}), got {found or 'none'} among "
            f"the keys {sorted(arrays)}"
        )
    missing = [key for key in _SCHEMAS[found[0]] if key not in arrays]
    if missing:
        raise ValueError(
            f"{path} lacks the keys {missing}; an archive with {found[0]!r} must also hold "
            f"{list(_SCHEMAS[found[0]])}, got the keys {sorted(arrays)}"
        )
    return found[0]


def _samples(value: np.ndarray, key: str, path: Path) -> Tensor:
    """Sample array as a complex tensor."""
    if not np.iscomplexobj(value) or value.ndim != 2 or min(value.shape) < 2:
        rows = "range" if key == "profiles" else "frequency"
        raise ValueError(
            f"{path}: {key} must be a complex array ({rows}, pulse) of at least 2 x 2 samples, got {_shown(value)}"
        )
    return torch.from_numpy(np.ascontiguousarray(value))


def _profiles_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar of range profiles; its bandwidth is c / (2 step), so that a range cell is the step."""
    step, bandwidth = _number(arrays, "range_step_m", path), _number(arrays, "bandwidth_hz", path)
    sampled = LIGHT_M_S / (2 * step)
    if bandwidth > 1.01 * sampled:
        raise ValueError(
            f"{path}: range_step_m must be at most c / (2 B) for the bandwidth_hz B = {bandwidth:g}, "
            f"got {step:g} m, which samples only {sampled:g} Hz"
        )
    carrier = _number(arrays, "f0_hz", path) if "f0_hz" in arrays else UNSTATED_CARRIER_HZ
    return InverseRadar(carrier, sampled, _number(arrays, "prf_hz", path)), {}


def _turntable_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a turntable sweep."""
    frequency = _frequency(arrays, shape[0], path)
    angle = torch.deg2rad(_vector(arrays, "angle_deg", shape[1], path))
    turn = float((angle[-1] - angle[0]).abs())
    return _radar(arrays, frequency, shape, turn, 0.0, path), {"frequency_hz": frequency, "angle_rad": angle}


def _spotlight_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a spotlight phase history."""
    frequency = _frequency(arrays, shape[0], path)
    position = torch.stack([_vector(arrays, key, shape[1], path) for key in ("x_m", "y_m", "z_m")], -1)
    reference = _vector(arrays, "r0_m", shape[1], path)
    if not bool((reference > 0).all() and (torch.linalg.vector_norm(position, dim=-1) > 0).all()):
        raise ValueError(
            f"{path}: r0_m must be positive and the antenna must not be at the scene centre, "
            f"got a least r0_m of {float(reference.min()):g}"
        )
    aux = {"frequency_hz": frequency, "position_m": position, "reference_m": reference}
    return _radar(arrays, frequency, shape, _turn_rad(position), float(reference.mean()), path), aux


_READERS = {"profiles": _profiles_radar, "sig": _turntable_radar, "fp": _spotlight_radar}


def _radar(
    arrays: dict[str, np.ndarray], frequency: Tensor, shape: torch.Size, turn_rad: float, reference_m: float, path: Path
) -> InverseRadar:
    """Radar of frequency samples whose line of sight turns by turn_rad from first to last pulse."""
    prf = _number(arrays, "prf_hz", path) if "prf_hz" in arrays else 1.0
    n = shape[0]
    rotation = turn_rad * prf / (shape[1] - 1)
    return InverseRadar(
        carrier_hz=float(frequency[n // 2]),
        bandwidth_hz=n * frequency_step_hz(frequency),
        prf_hz=prf,
        rotation_rad_s=rotation if rotation > 0 else None,
        reference_range_m=reference_m,
    )


def _turn_rad(position: Tensor) -> float:
    """Angle between the first and the last line of sight, radians."""
    first, last = (position[i] / torch.linalg.vector_norm(position[i]) for i in (0, -1))
    return 2 * math.asin(min(1.0, float(torch.linalg.vector_norm(last - first)) / 2))


def _frequency(arrays: dict[str, np.ndarray], n: int, path: Path) -> Tensor:
    """Frequencies in Hz, rising in equal steps."""
    frequency = _vector(arrays, "freq_hz", n, path)
    try:
        frequency_step_hz(frequency)
    except ValueError as error:
        raise ValueError(f"{path}: freq_hz: {error}") from None
    return frequency


def _vector(arrays: dict[str, np.ndarray], key: str, n: int, path: Path) -> Tensor:
    """Side data of n finite real numbers."""
    value = np.asarray(arrays[key])
    if value.shape != (n,) or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
        raise ValueError(f"{path}: {key} must be {n} finite real numbers, got {_shown(value)}")
    return torch.from_numpy(value.astype(np.float64))


def _number(arrays: dict[str, np.ndarray], key: str, path: Path) -> float:
    """One positive number."""
    value = np.asarray(arrays[key])
    if not (value.ndim == 0 and value.dtype.kind in "iuf" and np.isfinite(value) and value > 0):
        raise ValueError(f"{path}: {key} must be one positive number, got {_shown(value)}")
    return float(value)


def _shown(value: np.ndarray) -> str:
    """Value or shape of an array for messages."""
    return repr(value.item()) if value.ndim == 0 else f"{value.dtype} of shape {value.shape}"
