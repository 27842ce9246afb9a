"""Readers of rotating targets and of phase histories along any path, in `.npz` files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, StoredArray, refuse_non_finite
from torchsar.io.fields import (
    Described,
    naming,
    number,
    read_described,
    refuse_carrier,
    refuse_implausible,
    refuse_missing,
    shown,
    vector,
)
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar, LocalFrame, range_profiles, resample_path
from torchsar.radar.spotlight import frequency_step_hz


def read_inverse(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read range profiles, a turntable sweep or a spotlight phase history from a numpy archive.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar.io import read_inverse
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "turntable.npz"
    >>> sig, freq_hz = numpy.ones((3, 2), complex), [1e9, 2e9, 3e9]
    >>> numpy.savez(path, sig=sig, freq_hz=freq_hz, angle_deg=[0, 1])
    >>> read_inverse(path).radar.carrier_hz
    2000000000.0

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
    return read_described(path, dtype, "range profiles or phase history", describe_inverse)


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
    found = [kind for kind in _READERS if kind in fields]
    if len(found) != 1:
        choices = "; ".join(f"{kind} with {', '.join(keys)}" for kind, (keys, _) in _READERS.items())
        raise ValueError(
            f"{path} must hold exactly one of the sample arrays ({choices}), got {found or 'none'} among "
            f"the keys {sorted(fields)}"
        )
    keys, reader = _READERS[found[0]]
    refuse_missing(fields, path, keys, f"an archive with {found[0]!r}")
    samples = matrix(fields[found[0]], "range" if found[0] == "profiles" else "frequency")
    with naming(path):
        radar, aux = reader(fields, samples.shape)
    if found[0] == "profiles":
        return Described(samples, radar, aux, lambda x: np.ascontiguousarray(x.T))
    return Described(samples, radar, aux, partial(profiles_of, what=samples.what))


def matrix(field: StoredArray, rows: str) -> StoredArray:
    """Check that a field holds complex samples of two dimensions.

    Args:
        field: The field.
        rows: Name of the first dimension, for messages.

    Returns:
        The field.

    Raises:
        ValueError: If it has another type or shape.
    """
    if field.dtype.kind != "c" or len(field.shape) != 2 or min(field.shape) < 2:
        raise ValueError(
            f"{field.what} must be a complex array ({rows}, pulse) of at least 2 x 2 samples, got {shown(field)}"
        )
    return field


def profiles_of(history: np.ndarray, what: str) -> Tensor:
    """Form range profiles of the samples of a phase history.

    Args:
        history: Samples, shape (frequency, pulse), complex.
        what: Name of the samples for messages.

    Returns:
        Profiles, shape (pulse, range), complex128.

    Raises:
        ValueError: If a sample is not finite.
    """
    data = torch.from_numpy(history).T
    # checked before the transform, which would spread NaN and Inf to all samples
    refuse_non_finite(data, what)
    return range_profiles(data.to(torch.complex128)).contiguous()


def history_radar(
    frequency_hz: Tensor, prf_hz: float, reference_m: float, rotation_rad_s: float | None = None
) -> InverseRadar:
    """Return the radar of frequency samples in equal steps.

    Args:
        frequency_hz: Frequencies in Hz, shape (n,).
        prf_hz: Pulse repetition frequency in Hz.
        reference_m: Range in metres at which range coordinates are zero.
        rotation_rad_s: Mean rotation rate of the line of sight in rad/s; None or 0 if it does not
            turn.

    Returns:
        The radar.

    Raises:
        ValueError: If the frequencies do not rise in equal steps.
    """
    n = len(frequency_hz)
    return InverseRadar(
        carrier_hz=float(frequency_hz[n // 2]),
        bandwidth_hz=n * frequency_step_hz(frequency_hz),
        prf_hz=prf_hz,
        rotation_rad_s=rotation_rad_s or None,
        reference_range_m=reference_m,
    )


def frequencies(field: StoredArray, n: int) -> Tensor:
    """Load frequencies that rise in equal steps.

    Args:
        field: The field.
        n: How many frequencies it must hold.

    Returns:
        Frequencies in Hz, shape (n,), float64.

    Raises:
        ValueError: If the field holds anything else.
    """
    frequency = vector(field, n)
    refuse_carrier(frequency, field.what)
    with naming(field.what):
        frequency_step_hz(frequency)
    return frequency


def _profiles_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar of recorded range profiles; its bandwidth is c / (2 step), so that a range cell is one
    step.
    """
    step, bandwidth = number(fields["range_step_m"]), number(fields["bandwidth_hz"])
    sampled = LIGHT_M_S / (2 * step)
    if bandwidth > 1.01 * sampled:
        raise ValueError(
            f"range_step_m must be at most c / (2 B) for the bandwidth_hz B = {bandwidth:g}, "
            f"got {step:g} m, which samples only {sampled:g} Hz"
        )
    # carrier in C band commonly given in the literature for the Yak-42 recording; not verified
    carrier = number(fields["f0_hz"]) if "f0_hz" in fields else 5.52e9
    return InverseRadar(carrier, sampled, number(fields["prf_hz"])), {}


def _turntable_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a turntable measurement."""
    frequency = frequencies(fields["freq_hz"], shape[0])
    angle = torch.deg2rad(vector(fields["angle_deg"], shape[1]))
    prf = number(fields["prf_hz"]) if "prf_hz" in fields else 1.0
    turn = float((angle[-1] - angle[0]).abs()) * prf / (shape[1] - 1)
    return history_radar(frequency, prf, 0.0, turn), {"frequency_hz": frequency, "angle_rad": angle}


def _spotlight_radar(fields: Mapping[str, StoredArray], shape: tuple[int, ...]) -> tuple[InverseRadar, dict[str, Any]]:
    """Radar and side data of a spotlight phase history."""
    frequency = frequencies(fields["freq_hz"], shape[0])
    position = torch.stack([vector(fields[key], shape[1]) for key in ("x_m", "y_m", "z_m")], -1)
    reference = vector(fields["r0_m"], shape[1])
    if not bool((reference > 0).all() and (torch.linalg.vector_norm(position, dim=-1) > 0).all()):
        raise ValueError(
            "r0_m must be positive and the antenna must not be at the scene centre, "
            f"got a least r0_m of {float(reference.min()):g}"
        )
    refuse_implausible(frequency, position, reference, ("the antenna position x_m, y_m, z_m", "r0_m"))
    prf = number(fields["prf_hz"]) if "prf_hz" in fields else 1.0
    first, last = (position[i] / torch.linalg.vector_norm(position[i]) for i in (0, -1))
    chord = float(torch.linalg.vector_norm(last - first))
    turn = 2 * math.asin(min(1.0, chord / 2)) * prf / (shape[1] - 1)
    aux = {"frequency_hz": frequency, "position_m": position, "reference_m": reference}
    return history_radar(frequency, prf, float(reference.mean()), turn), aux


# for each name of a sample array: the other keys that are required, and the function for its radar
_READERS = {
    "profiles": (("range_step_m", "bandwidth_hz", "prf_hz"), _profiles_radar),
    "sig": (("freq_hz", "angle_deg"), _turntable_radar),
    "fp": (("freq_hz", "x_m", "y_m", "z_m", "r0_m"), _spotlight_radar),
}


_REQUIRED = ("history", "freq_hz", "transmitter_m", "path_reference_m")


def read_path(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read the phase history of an antenna or a pair of antennas on any path.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar.io import read_path
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "flight.npz"
    >>> places = dict(transmitter_m=[[0, -5e3, 3e3], [1, -5e3, 3e3]], path_reference_m=[11e3, 11e3])
    >>> numpy.savez(path, history=numpy.ones((3, 2), complex), freq_hz=[1e9, 2e9, 3e9], **places)
    >>> sorted(read_path(path).aux)
    ['frequency_hz', 'path_reference_m', 'position_m', 'reference_m', 'transmitter_m']

    The archive (.npz, without pickled objects) holds the complex samples `history` (frequency,
    pulse), in which the point x has the phase -2 pi f (|transmitter - x| + |x - receiver| -
    reference) / c, and these arrays:
    - `freq_hz` (frequency,): the frequencies f, rising in equal steps.
    - `transmitter_m`: positions (pulse, 3), records of a navigation system (record, 3), or the
      position (3,) of a fixed transmitter.
    - `receiver_m`: likewise; not given if both share an antenna.
    - `path_reference_m` (pulse,): the path to which phases refer, twice the range if both share an
      antenna with one position.
    It may also hold these:
    - `pulse_time_s` (pulse,), with `transmitter_time_s` (record,) and `receiver_time_s` (record,)
      if positions are records: `resample_path` interpolates them, and refuses gaps and jumps of
      the record.
    - `origin_deg_m` (3,): latitude and longitude in degrees and height in metres of the origin of
      local coordinates. Positions are then geocentric (ECEF), and are converted by `LocalFrame`.
    - `prf_hz`; by default that of `pulse_time_s`, or 1, so that slow time counts pulses.
    An archive with `fp` is one of spotlight data as for `read_inverse`. Other keys are ignored.

    Args:
        path: Path of the archive.
        dtype: complex64 or complex128, dtype of the profiles.

    Returns:
        Recording of range profiles with the axes (pulse, range), the centred unitary inverse FFT of
        the samples; range is half the path less its reference. Side data are `frequency_hz`
        (range,) and those of `AntennaPath.side_data`, float64: positions at every pulse; and
        `origin_deg_m` if the archive holds it.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive, or a key is missing or invalid.
    """
    return read_described(path, dtype, "phase history", describe_path)


def describe_path(fields: Mapping[str, StoredArray], path: Path) -> Described:
    """Check the fields of an archive for `read_path`, without loading the samples.

    Args:
        fields: The fields by key.
        path: Path of the archive, for messages.

    Returns:
        The samples, an InverseRadar, and the frequencies and positions.

    Raises:
        ValueError: If a key is missing or invalid.
    """
    if "fp" in fields:
        found = describe_inverse(fields, path)
        antennas = AntennaPath(found.aux["position_m"], None, 2 * found.aux["reference_m"])
        return found._replace(aux={**found.aux, **antennas.side_data()})
    refuse_missing(fields, path, _REQUIRED, "an archive with the history of any path")
    samples = matrix(fields["history"], "frequency")
    with naming(path):
        n, pulses = samples.shape
        frequency = frequencies(fields["freq_hz"], n)
        time = vector(fields["pulse_time_s"], pulses) if "pulse_time_s" in fields else None
        transmitter, receiver = (_places(fields, name, pulses, time) for name in ("transmitter", "receiver"))
        assert transmitter is not None
        antennas = AntennaPath(transmitter, receiver, vector(fields["path_reference_m"], pulses))
        reference_m = float(antennas.reference_m.mean()) / 2
        if not reference_m >= 0:
            raise ValueError(f"path_reference_m must be paths of 0 m or more, got a mean of {2 * reference_m:g} m")
        moved = max(antennas.places, key=lambda place: float(place.std(0).norm()))
        half = antennas.reference_m / 2
        refuse_implausible(frequency, moved, half, ("transmitter_m", "path_reference_m"))
        radar = history_radar(frequency, _prf_hz(fields, time), reference_m)
        origin = {"origin_deg_m": vector(fields["origin_deg_m"], 3)} if "origin_deg_m" in fields else {}
    aux = {"frequency_hz": frequency, **antennas.side_data(), **origin}
    return Described(samples, radar, aux, partial(profiles_of, what=samples.what))


def _places(fields: Mapping[str, StoredArray], antenna: str, pulses: int, time: Tensor | None) -> Tensor | None:
    """Positions of an antenna at all pulses, float64 (pulse, 3); None if the archive has none."""
    if f"{antenna}_m" not in fields:
        return None
    field, records = fields[f"{antenna}_m"], fields.get(f"{antenna}_time_s")
    n = pulses if records is None else math.prod(records.shape)
    accepted = ((n, 3),) if records is not None else ((n, 3), (3,))
    if field.shape not in accepted or field.dtype.kind not in "iuf":
        raise ValueError(
            f"{field.what} must be real numbers of shape {' or '.join(map(str, accepted))}, got {shown(field)}"
        )
    place = torch.from_numpy(field.load().astype(np.float64))
    refuse_non_finite(place, field.what, "interpolate the gaps of the record", "values")
    if "origin_deg_m" in fields:
        origin = vector(fields["origin_deg_m"], 3).tolist()
        with naming(fields["origin_deg_m"].what):
            frame = LocalFrame(*origin)
        low = float(torch.linalg.vector_norm(place, dim=-1).min())
        # in metres: a smaller distance from the centre of the Earth is below its surface
        if low < 6.3e6:
            raise ValueError(
                f"{field.what} must be geocentric coordinates in metres where origin_deg_m is given, but has a "
                f"distance of {low:.4g} m from the centre of the Earth, such as {place.reshape(-1, 3)[0].tolist()}; "
                "convert latitude and longitude in degrees by torchsar.radar.geocentric, or kilometres to metres"
            )
        place = frame.local_m(place)
    if records is None:
        return place.expand(pulses, 3).clone()
    if time is None:
        raise ValueError(f"{records.what} needs pulse_time_s, the times of the pulses on the same clock; add it")
    with naming(field.what):
        return resample_path(vector(records, n), place, time)


def _prf_hz(fields: Mapping[str, StoredArray], time: Tensor | None) -> float:
    """Pulse repetition frequency (Hz): the given one, or the mean one computed from the times of
    the pulses.
    """
    if "prf_hz" in fields or time is None:
        return number(fields["prf_hz"]) if "prf_hz" in fields else 1.0
    span = float(time[-1] - time[0])
    if not (span > 0 and bool((time.diff() > 0).all())):
        raise ValueError(
            f"pulse_time_s must rise, got a span of {span:g} s with a least step of {float(time.diff().min()):g} s"
        )
    return (len(time) - 1) / span
