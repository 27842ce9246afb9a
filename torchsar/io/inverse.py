"""Recorded inverse and spotlight data from `.npz` files: range profiles of a target in flight,
turntable sweeps, phase histories.
"""

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

_SCHEMAS = {
    "profiles": ("range_step_m", "bandwidth_hz", "prf_hz"),
    "sig": ("freq_hz", "angle_deg"),
    "fp": ("freq_hz", "x_m", "y_m", "z_m", "r0_m"),
}
UNSTATED_CARRIER_HZ = 5.52e9


def read_inverse(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read range profiles, a turntable sweep or a spotlight phase history from a numpy archive
    without pickles.

    Schema, known by its keys: (a) target in flight: `profiles` complex (range, pulse), range
    growing away from the radar, with the numbers `range_step_m`, `bandwidth_hz`, `prf_hz`, and
    optionally `f0_hz` (5.52e9 where it is not stated; it only scales cross range); (b) turntable:
    `sig` complex (frequency, pulse), `freq_hz` (frequency,) rising in equal steps, `angle_deg`
    (pulse,), phase -4 pi f (x cos a + y sin a) / c; (c) spotlight: `fp` complex (frequency, pulse),
    `freq_hz`, antenna position `x_m`, `y_m`, `z_m` (pulse,) about the scene centre, and reference
    range `r0_m` (pulse,), phase -4 pi f (|antenna - p| - r0) / c. (b) and (c) may state `prf_hz`, 1
    by default, so that slow time counts pulses. Other keys are ignored.

    Returns a Recording of range profiles with the axes (pulse, range) and an InverseRadar; range is
    zero at cell n // 2, the scene centre. For (b) and (c) profiles are the centred unitary
    transform of the frequency samples (`radar.frequency_samples` takes it back), and aux holds, in
    float64, `frequency_hz` (range,) and `angle_rad` (pulse,), or `position_m` (pulse, 3) and
    `reference_m` (pulse,): what `PolarFormat` and `SpotlightBackprojection` connect to.
    radar.rotation_rad_s is the mean turn of the line of sight, unknown for (a). Raises
    FileNotFoundError, or ValueError naming the file and the key.
    """
    path = Path(path)
    arrays = _load(path)
    kind = _kind(arrays, path)
    samples = _samples(arrays[kind], kind, path)
    radar, aux = _READERS[kind](arrays, samples.shape, path)
    data = samples.T if kind == "profiles" else range_profiles(samples.T.to(torch.complex128))
    return Recording.from_arrays(data.contiguous(), radar, dtype=dtype, what=str(path), **aux)


def _load(path: Path) -> dict[str, np.ndarray]:
    if not path.is_file():
        raise FileNotFoundError(
            f"data.file: {path} does not exist; give the path of an .npz file with range profiles or phase history"
        )
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, OSError) as error:
        raise ValueError(f"{path} is not a numpy archive without pickles ({error})") from None


def _kind(arrays: dict[str, np.ndarray], path: Path) -> str:
    """Which schema: the one whose sample array is there.

    Raises where none or several are, or where keys of it lack.
    """
    found = [kind for kind in _SCHEMAS if kind in arrays]
    if len(found) != 1:
        choices = "; ".join(f"{kind} with {', '.join(keys)}" for kind, keys in _SCHEMAS.items())
        raise ValueError(
            f"{path} holds {found or 'none'} of the sample arrays; an archive of this sort holds "
            f"exactly one: {choices} (this one: {sorted(arrays)})"
        )
    missing = [key for key in _SCHEMAS[found[0]] if key not in arrays]
    if missing:
        raise ValueError(
            f"{path} lacks {missing}; beside {found[0]!r} there must be "
            f"{list(_SCHEMAS[found[0]])} (this one: {sorted(arrays)})"
        )
    return found[0]


def _samples(value: np.ndarray, key: str, path: Path) -> Tensor:
    if not np.iscomplexobj(value) or value.ndim != 2 or min(value.shape) < 2:
        rows = "range" if key == "profiles" else "frequency"
        raise ValueError(f"{path}: {key} must be complex ({rows}, pulse) with two or more of each, got {_shown(value)}")
    return torch.from_numpy(np.ascontiguousarray(value))


def _profiles_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    """The radar's bandwidth is the sampled one, c / (2 step), so that its range cell is the step of
    the file.
    """
    step, bandwidth = _number(arrays, "range_step_m", path), _number(arrays, "bandwidth_hz", path)
    sampled = LIGHT_M_S / (2 * step)
    if bandwidth > 1.01 * sampled:
        raise ValueError(
            f"{path}: range_step_m {step:g} holds a bandwidth of {sampled:g} Hz, less than "
            f"bandwidth_hz {bandwidth:g}; the step must be c / (2 B) or finer"
        )
    carrier = _number(arrays, "f0_hz", path) if "f0_hz" in arrays else UNSTATED_CARRIER_HZ
    return InverseRadar(carrier, sampled, _number(arrays, "prf_hz", path)), {}


def _turntable_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    frequency = _frequency(arrays, shape[0], path)
    angle = torch.deg2rad(_vector(arrays, "angle_deg", shape[1], path))
    turn = float((angle[-1] - angle[0]).abs())
    return _radar(arrays, frequency, shape, turn, 0.0, path), {"frequency_hz": frequency, "angle_rad": angle}


def _spotlight_radar(
    arrays: dict[str, np.ndarray], shape: torch.Size, path: Path
) -> tuple[InverseRadar, dict[str, Any]]:
    frequency = _frequency(arrays, shape[0], path)
    position = torch.stack([_vector(arrays, key, shape[1], path) for key in ("x_m", "y_m", "z_m")], -1)
    reference = _vector(arrays, "r0_m", shape[1], path)
    if not bool((reference > 0).all() and (torch.linalg.vector_norm(position, dim=-1) > 0).all()):
        raise ValueError(
            f"{path}: r0_m must be positive and the antenna must not stand at the scene centre, "
            f"got r0_m down to {float(reference.min()):g}"
        )
    aux = {"frequency_hz": frequency, "position_m": position, "reference_m": reference}
    return _radar(arrays, frequency, shape, _turn_rad(position), float(reference.mean()), path), aux


_READERS = {"profiles": _profiles_radar, "sig": _turntable_radar, "fp": _spotlight_radar}


def _radar(
    arrays: dict[str, np.ndarray], frequency: Tensor, shape: torch.Size, turn_rad: float, reference_m: float, path: Path
) -> InverseRadar:
    """turn_rad: of the line of sight between the first and the last pulse."""
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
    first, last = (position[i] / torch.linalg.vector_norm(position[i]) for i in (0, -1))
    return 2 * math.asin(min(1.0, float(torch.linalg.vector_norm(last - first)) / 2))


def _frequency(arrays: dict[str, np.ndarray], n: int, path: Path) -> Tensor:
    frequency = _vector(arrays, "freq_hz", n, path)
    try:
        frequency_step_hz(frequency)
    except ValueError as error:
        raise ValueError(f"{path}: freq_hz: {error}") from None
    return frequency


def _vector(arrays: dict[str, np.ndarray], key: str, n: int, path: Path) -> Tensor:
    value = np.asarray(arrays[key])
    if value.shape != (n,) or value.dtype.kind not in "iuf" or not np.isfinite(value).all():
        raise ValueError(f"{path}: {key} must be {n} finite real numbers, got {_shown(value)}")
    return torch.from_numpy(value.astype(np.float64))


def _number(arrays: dict[str, np.ndarray], key: str, path: Path) -> float:
    value = np.asarray(arrays[key])
    if not (value.ndim == 0 and value.dtype.kind in "iuf" and np.isfinite(value) and value > 0):
        raise ValueError(f"{path}: {key} must be one positive number, got {_shown(value)}")
    return float(value)


def _shown(value: np.ndarray) -> str:
    return repr(value.item()) if value.ndim == 0 else f"{value.dtype} of shape {value.shape}"
