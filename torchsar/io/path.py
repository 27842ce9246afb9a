"""Reader of phase histories along any path, monostatic or bistatic, in `.npz` files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, StoredArray, refuse_non_finite
from torchsar.io.fields import Described, archive, naming, number, refuse_missing, shown, vector
from torchsar.io.inverse import read_inverse
from torchsar.radar import AntennaPath, InverseRadar, LocalFrame, range_profiles, resample_path
from torchsar.radar.spotlight import frequency_step_hz

_REQUIRED = ("history", "freq_hz", "transmitter_m", "path_reference_m")


def read_path(path: str | Path, dtype: torch.dtype = torch.complex64) -> Recording:
    """Read the phase history of an antenna or a pair of antennas on any path.

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
    path = Path(path)
    fields = archive(path, "phase history")
    if "fp" in fields:
        recording = read_inverse(path, dtype)
        antennas = AntennaPath(recording.aux["position_m"], None, 2 * recording.aux["reference_m"])
        return replace(recording, aux={**recording.aux, **antennas.side_data()})
    samples, radar, aux = describe_path(fields, path)
    with naming(path):
        data = torch.from_numpy(samples.load()).T
        refuse_non_finite(data, samples.what)  # the transform would spread them
        data = range_profiles(data.to(torch.complex128)).contiguous()
        return Recording.from_arrays(data, radar, dtype=dtype, what=str(path), **aux)


def describe_path(fields: Mapping[str, StoredArray], path: Path) -> Described:
    """Check the fields of an archive with `history` for `read_path`, without loading the samples.

    Args:
        fields: The fields by key.
        path: Path of the archive, for messages.

    Returns:
        The samples, an InverseRadar, and the frequencies and positions.

    Raises:
        ValueError: If a key is missing or invalid.
    """
    refuse_missing(fields, path, _REQUIRED, "an archive with the history of any path")
    samples = fields["history"]
    if samples.dtype.kind != "c" or len(samples.shape) != 2 or min(samples.shape) < 2:
        raise ValueError(
            f"{samples.what} must be a complex array (frequency, pulse) of at least 2 x 2 samples, got {shown(samples)}"
        )
    with naming(path):
        n, pulses = samples.shape
        frequency = vector(fields["freq_hz"], n)
        with naming(fields["freq_hz"].what):
            step_hz = frequency_step_hz(frequency)
        time = vector(fields["pulse_time_s"], pulses) if "pulse_time_s" in fields else None
        places = [_places(fields, name, pulses, time) for name in ("transmitter", "receiver")]
        assert places[0] is not None
        antennas = AntennaPath(places[0], places[1], vector(fields["path_reference_m"], pulses))
        reference_m = float(antennas.reference_m.mean()) / 2
        if not reference_m >= 0:
            raise ValueError(f"path_reference_m must be paths of 0 m or more, got a mean of {2 * reference_m:g} m")
        radar = InverseRadar(float(frequency[n // 2]), n * step_hz, _prf_hz(fields, time), None, None, reference_m)
        origin = {"origin_deg_m": vector(fields["origin_deg_m"], 3)} if "origin_deg_m" in fields else {}
    return Described(samples, radar, {"frequency_hz": frequency, **antennas.side_data(), **origin})


def _places(fields: Mapping[str, StoredArray], antenna: str, pulses: int, time: Tensor | None) -> Tensor | None:
    """Positions of an antenna at the pulses, float64 (pulse, 3); None if there are none."""
    if f"{antenna}_m" not in fields:
        return None
    field, records = fields[f"{antenna}_m"], fields.get(f"{antenna}_time_s")
    n = pulses if records is None else math.prod(records.shape)
    accepted = ((n, 3),) if records is not None else ((n, 3), (3,))
    if field.shape not in accepted or field.dtype.kind not in "iuf":
        raise ValueError(
            f"{field.what} must be real numbers of shape {' or '.join(map(str, accepted))}, got {shown(field)}"
        )
    place = _finite(field)
    if "origin_deg_m" in fields:
        origin = vector(fields["origin_deg_m"], 3).tolist()
        with naming(fields["origin_deg_m"].what):
            place = LocalFrame(*origin).local_m(place)
    if records is None:
        return place.expand(pulses, 3).clone()
    if time is None:
        raise ValueError(f"{records.what} needs pulse_time_s, the times of the pulses on the same clock; add it")
    with naming(field.what):
        return resample_path(vector(records, n), place, time)


def _finite(field: StoredArray) -> Tensor:
    """Load finite real numbers of any shape, float64."""
    value = torch.from_numpy(field.load().astype(np.float64))
    refuse_non_finite(value, field.what, "interpolate the gaps of the record", "values")
    return value


def _prf_hz(fields: Mapping[str, StoredArray], time: Tensor | None) -> float:
    """Pulse repetition frequency, the mean one if it follows from the times of the pulses."""
    if "prf_hz" in fields or time is None:
        return number(fields["prf_hz"]) if "prf_hz" in fields else 1.0
    span = float(time[-1] - time[0])
    if not (span > 0 and bool((time.diff() > 0).all())):
        raise ValueError(
            f"pulse_time_s must rise, got a span of {span:g} s with a least step of {float(time.diff().min()):g} s"
        )
    return (len(time) - 1) / span
