"""Reader of recorded inverse synthetic aperture and spotlight data in `.npz` files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Recording, StoredArray, refuse_non_finite
from torchsar.io.fields import Described, archive, naming, number, refuse_missing, shown, vector
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
    samples, radar, aux = describe_inverse(archive(path, "range profiles or phase history"), path)
    with naming(path):
        data = torch.from_numpy(samples.load()).T
        if aux:  # profiles of a target in flight have none
            refuse_non_finite(data, samples.what)  # the transform would spread them
            data = range_profiles(data.to(torch.complex128))
        return Recording.from_arrays(data.contiguous(), radar, dtype=dtype, what=str(path), **aux)


def describe_inverse(fields: Mapping[str, StoredArray], path: Path) -> Described:
    """Check the fields of an archive for `read_inverse`, without loading the samples.

    Args:
        fields: The fields by key.
        path: Path of the archive, for messages.

    Returns:
        The samples, an InverseRadar, and the side data of frequency samples.

    Raises:
        ValueError: If a key is missing or invalid.
    """
    kind = _kind(fields, path)
    samples = _samples(fields[kind], kind)
    with naming(path):
        return Described(samples, *_READERS[kind](fields, samples.shape))


def _kind(fields: Mapping[str, StoredArray], path: Path) -> str:
    """Key of the only sample array in the archive; raise ValueError if keys are missing."""
    found = [kind for kind in _SCHEMAS if kind in fields]
    if len(found) != 1:
        choices = "; ".join(f"{kind} with {', '.join(keys)}" for kind, keys in _SCHEMAS.items())
        raise ValueError(
            f"{path} must hold exactly one of the sample arrays ({choices}), got {found or 'none'} among "
            f"the keys {sorted(fields)}"
        )
    refuse_missing(fields, path, _SCHEMAS[found[0]], f"an archive with {found[0]!r}")
    return found[0]


def _samples(field: StoredArray, key: str) -> StoredArray:
    """The sample array, of two dimensions and complex."""
    if field.dtype.kind != "c" or len(field.shape) != 2 or min(field.shape) < 2:
        rows = "range" if key == "profiles" else "frequency"
        raise ValueError(
            f"{field.what} must be a complex array ({rows}, pulse) of at least 2 x 2 samples, got {shown(field)}"
        )
    return field


def _profiles_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar of range profiles; its bandwidth is c / (2 step), so that a range cell is the step."""
    step, bandwidth = number(fields["range_step_m"]), number(fields["bandwidth_hz"])
    sampled = LIGHT_M_S / (2 * step)
    if bandwidth > 1.01 * sampled:
        raise ValueError(
            f"range_step_m must be at most c / (2 B) for the bandwidth_hz B = {bandwidth:g}, "
            f"got {step:g} m, which samples only {sampled:g} Hz"
        )
    carrier = number(fields["f0_hz"]) if "f0_hz" in fields else UNSTATED_CARRIER_HZ
    return InverseRadar(carrier, sampled, number(fields["prf_hz"])), {}


def _turntable_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a turntable sweep."""
    frequency = _frequency(fields["freq_hz"], shape[0])
    angle = torch.deg2rad(vector(fields["angle_deg"], shape[1]))
    turn = float((angle[-1] - angle[0]).abs())
    return _radar(fields, frequency, shape, turn, 0.0), {"frequency_hz": frequency, "angle_rad": angle}


def _spotlight_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a spotlight phase history."""
    frequency = _frequency(fields["freq_hz"], shape[0])
    position = torch.stack([vector(fields[key], shape[1]) for key in ("x_m", "y_m", "z_m")], -1)
    reference = vector(fields["r0_m"], shape[1])
    if not bool((reference > 0).all() and (torch.linalg.vector_norm(position, dim=-1) > 0).all()):
        raise ValueError(
            "r0_m must be positive and the antenna must not be at the scene centre, "
            f"got a least r0_m of {float(reference.min()):g}"
        )
    aux = {"frequency_hz": frequency, "position_m": position, "reference_m": reference}
    return _radar(fields, frequency, shape, _turn_rad(position), float(reference.mean())), aux


_READERS = {"profiles": _profiles_radar, "sig": _turntable_radar, "fp": _spotlight_radar}


def _radar(
    fields: Mapping[str, StoredArray], frequency: Tensor, shape: tuple[int, ...], turn_rad: float, reference_m: float
) -> InverseRadar:
    """Radar of frequency samples whose line of sight turns by turn_rad from first to last pulse."""
    prf = number(fields["prf_hz"]) if "prf_hz" in fields else 1.0
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


def _frequency(field: StoredArray, n: int) -> Tensor:
    """Frequencies in Hz, rising in equal steps."""
    frequency = vector(field, n)
    with naming(field.what):
        frequency_step_hz(frequency)
    return frequency
