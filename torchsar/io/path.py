"""Reader of phase histories along any path, monostatic or bistatic, in `.npz` files."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, StoredArray, refuse_non_finite
from torchsar.io.fields import (
    Described,
    naming,
    number,
    read_described,
    refuse_implausible,
    refuse_missing,
    shown,
    vector,
)
from torchsar.io.inverse import describe_inverse, frequencies, history_radar, matrix, profiles_of
from torchsar.radar import AntennaPath, LocalFrame, resample_path

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
        refuse_implausible(frequency, moved, half, ("freq_hz", "transmitter_m", "path_reference_m"))
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
