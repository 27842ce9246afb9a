"""Reader of compensated phase history data (CPHD), NGA.STND.0068-1."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, refuse_non_finite, unit_phasor
from torchsar.focus.chirp_z import chirp_z
from torchsar.io.extras import library, reading
from torchsar.io.inverse import history_radar
from torchsar.radar import LIGHT_M_S, AntennaPath, LocalFrame, geocentric, range_profiles

# largest error of a frequency that is ignored, in frequency steps, by choice: it causes a phase
# error of 3e-4 rad at the edge of the swath
_SAME_STEP = 1e-4
# number of samples that are transformed at once, by choice: 64 MB as complex128
_BLOCK = 1 << 22
_POSITIONS = ("TxPos", "RcvPos", "SRPPos")
_NEEDED = ("TxTime", *_POSITIONS, "FX1", "FX2", "SC0", "SCSS")
# Three parts: the frequencies of the range profiles in Hz, and the delay of the middle of the
# profiles relative to the reference point in seconds.
# The last part is the function that computes the profiles of some vectors from their samples
# (vector, sample).
_Bands = tuple[Tensor, Tensor, Callable[[Tensor, slice], Tensor]]


def read_cphd(path: str | Path, dtype: torch.dtype = torch.complex64, channel: str | None = None) -> Recording:
    """Read a channel of a file of compensated phase history data (CPHD, versions 1.0.1 and 1.1.0).

    >>> from torchsar import io
    >>> recording = io.read_cphd("flight.cphd")  # doctest: +SKIP
    >>> recording.signal.names, recording.aux["transmitter_m"].shape  # doctest: +SKIP
    (('pulse', 'range'), torch.Size([8, 3]))

    In the domain FX a sample at the frequency f has the phase SGN 2 pi f dt of a target whose echo
    arrives dt after that of the reference point (SRP) of its vector; in the domain TOA the peak of
    a target has the phase SGN 2 pi f_c dt, f_c the middle of FX1 and FX2. Both signs are accepted.
    Samples are multiplied by AmpSF, those of the domain FX beyond FX1 and FX2 are set to zero, as
    are vectors with SIGNAL = 0, and vectors without finite parameters are left out. Vectors whose
    SC0 or SCSS differ are resampled to a common band (chirp-z, in the domain FX only). Delays by
    the troposphere and the ionosphere are taken as those of the reference point.

    Args:
        path: Path of the file.
        dtype: complex64 or complex128, dtype of the profiles.
        channel: Identifier of the channel; None for the reference channel of the file, where a
            warning names the others.

    Returns:
        Recording of range profiles as by `read_path`, in the frame east, north, up (`LocalFrame`)
        about the reference point of the scene (IARP). Side data are those of
        `AntennaPath.side_data` and `frequency_hz`; `origin_deg_m` (3,), latitude and longitude in
        degrees and height in metres of the IARP; `pulse_time_s` (pulse,), the times of transmission
        since the start of the collection; `scene_reference_m` (pulse, 3), the reference points;
        `scene_corners_m` (4, 3), the corners of the imaged area in the horizontal plane through the
        IARP. Two antennas that the file calls
        monostatic become one in the middle between them where that changes no path over the area by
        more than a thousandth of a wavelength.

    Raises:
        ModuleNotFoundError: If sarkit is not installed (extra `formats`).
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or of another kind, the channel does not exist, the
            samples are compressed, or vectors differ in a way that is not supported.
    """
    path = Path(path)
    sarkit = library("sarkit.cphd", "formats", f"reading {path}")
    with reading(path, "CPHD"), path.open("rb") as file:
        _refuse_version(file.read(64))
        file.seek(0)
        reader = sarkit.Reader(file)
        head = _Head(sarkit.XmlHelper(reader.metadata.xmltree), path)
        name = head("Channel/RefChId") if channel is None else channel
        channels = _refuse_channel(head, name, path.stat().st_size)
        if channel is None and len(channels) > 1:
            warnings.warn(
                f"{path} holds the channels {', '.join(channels)}, of which {name}, its reference channel, is read; "
                "channel (data.channel in a config) chooses another",
                stacklevel=2,
            )
        samples, vectors = reader.read_channel(name)
        return _recording(head, samples, vectors, dtype)


class _Head(NamedTuple):
    """Entries of the XML header of a file, and the path of the file."""

    xml: Any
    path: Path

    def __call__(self, name: str) -> Any:
        """Value of an element; raise ValueError if there is none."""
        value = self.xml.load("/".join(f"{{*}}{part}" for part in name.split("/")))
        if value is None:
            raise ValueError(f"{self.path} lacks the element {name}")
        return value


def _refuse_version(start: bytes) -> None:
    """Raise ValueError unless a file begins with a version of CPHD that this module can read."""
    kind, _, version = start.partition(b"\n")[0].decode("latin-1").strip().partition("/")
    if kind != "CPHD":
        page = start.lstrip()[:1] == b"<"
        raise ValueError(
            f"it begins with {start[:24]!r} instead of CPHD/ and a version"
            + (", as a page of the web does that was saved in place of the file; download it again" if page else "")
        )
    if version not in ("1.0.1", "1.1.0"):
        raise ValueError(f"its version is {version}, and 1.0.1 and 1.1.0 are read; convert it")


def _refuse_channel(head: _Head, name: str, size: int) -> list[str]:
    """Names of all channels, after checks of the channel with the given name.

    Raises ValueError if it does not exist, has compressed samples, or needs more bytes than the
    file has.
    """
    channels = {node.findtext("{*}Identifier"): node for node in head.xml.element_tree.findall("{*}Data/{*}Channel")}
    if name not in channels:
        raise ValueError(f"{head.path} has no channel {name!r}; it has {list(channels)}")
    if channels[name].find("{*}CompressedSignalSize") is not None:
        raise ValueError(f"{head.path} holds compressed samples; decompress it with the tools of its producer")
    form = head("Data/SignalArrayFormat")
    counts = [int(channels[name].findtext(f"{{*}}{key}")) for key in ("NumVectors", "NumSamples")]
    needed = counts[0] * (counts[1] * {"CI2": 2, "CI4": 4, "CF8": 8}[form] + int(head("Data/NumBytesPVP")))
    if not (min(counts) >= 2 and needed <= size):
        raise ValueError(
            f"{head.path} is cut off or damaged: {counts[0]} vectors of {counts[1]} samples {form} with their "
            f"parameters take {needed} bytes, and the file has {size}"
        )
    return list(channels)


def _recording(head: _Head, samples: np.ndarray, vectors: np.ndarray, dtype: torch.dtype) -> Recording:
    """Make the recording of a channel from its samples and the parameters of its vectors."""
    domain, sign, path = head("Global/DomainType"), int(head("Global/SGN")), head.path
    if domain not in ("FX", "TOA") or sign not in (-1, 1):
        raise ValueError(f"{path} must have the domain FX or TOA and the sign +1 or -1, got {domain!r} and {sign}")
    finite = np.all([np.isfinite(vectors[name]).reshape(len(vectors), -1).all(-1) for name in _NEEDED], 0)
    if finite.sum() < 2:
        raise ValueError(f"{path} has {finite.sum()} vectors with finite parameters; an image needs two or more")
    if not finite.all():
        lost = np.flatnonzero(~finite)
        warnings.warn(
            f"{path}: {len(lost)} of {len(finite)} vectors have no finite time, position or band and are left out, the "
            f"first of them {', '.join(map(str, lost[:5]))}",
            stacklevel=3,
        )
        samples, vectors = samples[finite], vectors[finite]
    of = {name: torch.from_numpy(np.ascontiguousarray(vectors[name], "f8")) for name in _NEEDED}
    time = of["TxTime"]
    if not bool((time.diff() > 0).all()):
        raise ValueError(f"{path} must have rising times of transmission, got a least step of {time.diff().min():g} s")
    frame = LocalFrame(*np.asarray(head("SceneCoordinates/IARP/LLH"), float).tolist())
    transmitter, receiver, point = (frame.local_m(of[name]) for name in _POSITIONS)
    frequency, shift_s, formed = (_of_frequencies if domain == "FX" else _of_delays)(samples.shape[-1], of, path)
    legs = [torch.linalg.vector_norm(place - point, dim=-1) for place in (transmitter, receiver)]
    edges = torch.tensor(np.asarray(head("SceneCoordinates/ImageAreaCornerPoints"), float))
    height = torch.full((len(edges),), frame.height_m, dtype=torch.float64)
    corners = frame.local_m(geocentric(edges[:, 0], edges[:, 1], height))
    # corners are moved into the plane through the reference point, since the surface of the Earth
    # falls below it
    corners[:, 2] = 0
    antennas = AntennaPath(transmitter, receiver, legs[0] + legs[1] + LIGHT_M_S * shift_s)
    if head("CollectionID/CollectType") == "MONOSTATIC":
        antennas = _in_one_place(antennas, point, corners, float(frequency[-1]))
    prf_hz = (len(time) - 1) / float(time[-1] - time[0])
    radar = history_radar(frequency, prf_hz, float(antennas.reference_m.mean()) / 2)
    names = vectors.dtype.names or ()
    scale = vectors["AmpSF"].astype("f8") if "AmpSF" in names else np.ones(len(vectors))
    scale = scale * (vectors["SIGNAL"] != 0) if "SIGNAL" in names else scale
    profiles = torch.empty(len(time), len(frequency), dtype=dtype)
    for first in range(0, len(time), block := max(1, _BLOCK // len(frequency))):
        rows = slice(first, first + block)
        held = samples[rows]
        held = held["real"].astype("f8") + 1j * held["imag"].astype("f8") if held.dtype.names else held.astype("c16")
        history = torch.from_numpy(held * scale[rows, None])
        refuse_non_finite(history, f"{path}: samples")
        profiles[rows] = formed(history if sign < 0 else history.conj().resolve_conj(), rows).to(dtype)
    aux: dict[str, Any] = {
        "frequency_hz": frequency,
        **antennas.side_data(),
        "origin_deg_m": torch.tensor([frame.latitude_deg, frame.longitude_deg, frame.height_m], dtype=torch.float64),
        "pulse_time_s": time,
        "scene_reference_m": point,
        "scene_corners_m": corners,
    }
    return Recording.from_arrays(profiles, radar, dtype=dtype, start_s=float(time[0]), what=str(path), **aux)


def _of_frequencies(n: int, of: dict[str, Tensor], path: Path) -> _Bands:
    """Conversion of vectors of n samples of the domain FX to range profiles."""
    start, step, k = of["SC0"], of["SCSS"], torch.arange(n, dtype=torch.float64)
    if not bool((step > 0).all() and (start > 0).all()):
        raise ValueError(
            f"{path} must have positive SC0 and SCSS, got a least SC0 of {start.min():g} and SCSS {step.min():g}"
        )
    last = start + (n - 1) * step
    alike = max(float(v.max() - v.min()) for v in (start, last)) <= _SAME_STEP * float(step.min())
    if alike:
        frequency = start[0] + step[0] * k
    else:
        wide, low, high = float(step.max()), float(start.min()), float(last.max())
        count = int(np.ceil((high - low) / wide)) + 1
        if count > 4 * n:
            raise ValueError(
                f"{path}: the bands of its vectors reach from {low:g} to {high:g} Hz, more than 4 times the band of "
                "one; split the file into groups of vectors of similar bands"
            )
        frequency = low + wide * torch.arange(count, dtype=torch.float64)

    def profiles(history: Tensor, rows: slice) -> Tensor:
        begin, grid = start[rows, None], step[rows, None]
        f = begin + grid * k
        inside = (f >= (of["FX1"] - step / 2)[rows, None]) & (f <= (of["FX2"] + step / 2)[rows, None])
        history = torch.where(inside, history, 0)
        if alike:
            return range_profiles(history)
        count, middle = len(frequency), len(frequency) // 2
        wide = frequency[1] - frequency[0]
        delay = 1 / (count * wide)  # width of a range cell in seconds
        turns = (delay * grid)[:, 0]
        found = chirp_z(history, middle * turns, -turns, count, centre=n // 2)
        cells = torch.arange(count, dtype=torch.float64) - middle
        shift = (begin + n // 2 * grid - frequency[middle]) * delay
        return found * unit_phasor(shift * cells, found.dtype) * (grid / wide) / count**0.5

    return frequency, torch.zeros((), dtype=torch.float64), profiles


def _of_delays(n: int, of: dict[str, Tensor], path: Path) -> _Bands:
    """Conversion of vectors of n samples of the domain TOA to range profiles.

    Cell m lies at the delay SC0 + m SCSS and has the carrier phase of a range profile with its
    middle at the reference point. The middle n // 2 of the cells may have another delay; the
    carrier phase is then corrected by f_c times this delay in cycles.
    """
    step, carrier = of["SCSS"], (of["FX1"] + of["FX2"]) / 2
    for name, value, scale in (("SCSS", step, step[0] / n), ("FX1 + FX2", carrier, 1 / (n * step[0]))):
        if not bool(step[0] > 0) or float((value - value[0]).abs().max()) > _SAME_STEP * float(scale):
            raise ValueError(
                f"{path}: vectors of the domain TOA must share one positive SCSS and one FX1 + FX2, got {name} of "
                f"{float(value.min()):.9g} to {float(value.max()):.9g}"
            )
    shift = of["SC0"] + n // 2 * step
    # a difference from zero is due to rounding
    shift = torch.where(shift.abs() < 1e-9 * step, 0, shift)
    frequency = carrier[0] + (torch.arange(n, dtype=torch.float64) - n // 2) / (n * step[0])
    return frequency, shift, lambda x, rows: x * unit_phasor((carrier[0] * shift)[rows, None], x.dtype)


def _in_one_place(pair: AntennaPath, point: Tensor, corners: Tensor, highest_hz: float) -> AntennaPath:
    """Replace two antennas by one in the middle between them if this changes the paths only
    slightly.

    The largest allowed change over the area is a thousandth of a wavelength, by choice. If it is
    larger, both antennas are returned.
    """
    transmitter, receiver = pair.places
    middle = (transmitter + receiver) / 2
    apart = 2 * torch.linalg.vector_norm(middle - point, dim=-1) - torch.linalg.vector_norm(transmitter - point, dim=-1)
    reference = pair.reference_m + apart - torch.linalg.vector_norm(receiver - point, dim=-1)
    one = AntennaPath(middle, None, reference)
    error = (one.path_m(corners) - pair.path_m(corners)).abs().max()
    return one if float(error) * highest_hz <= 1e-3 * LIGHT_M_S else pair
