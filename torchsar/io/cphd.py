"""Reader and writer of compensated phase history data (CPHD), NGA.STND.0068-1."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, refuse_non_finite, unit_phasor
from torchsar.focus.chirp_z import chirp_z
from torchsar.io.extras import library, quiet, reading, write_whole
from torchsar.io.geometry import antennas_of, frame_of, pulse_time_s, single
from torchsar.io.history import history_radar
from torchsar.radar import LIGHT_M_S, AntennaPath, LocalFrame, frequency_samples, geocentric, range_profiles
from torchsar.radar.spotlight import frequency_step_hz

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


_NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_CHANNEL = "1"
# start of the collection in a file if it is not known
UNKNOWN_START = datetime(1970, 1, 1, tzinfo=UTC)
# ratio of the unambiguous delays to the swath of delays in the file; the standard recommends 1.2
_OVERSAMPLING = 1.25


@quiet()
def write_cphd(
    recording: Recording,
    path: str | Path,
    frame: LocalFrame | None = None,
    start: datetime = UNKNOWN_START,
    mode: str = "SPOTLIGHT",
) -> None:
    """Write range profiles with the positions of their antennas as a CPHD file, version 1.1.0.

    >>> from torchsar import Draws, echo, io, radar, scene
    >>> flight = scene.Flight(scene.StraightPath([-5e3, 0.0, 3e3], [0.0, 100.0, 0.0]))
    >>> world = scene.PathWorld(scene.Points(azimuth_m=[0.0], range_m=[0.0]), flight)
    >>> recording, _ = echo.simulate_path(radar.InverseRadar(1e10, 1e8, 100), world, 8, 8, Draws(1))
    >>> io.write_cphd(recording, "flight.cphd", radar.LocalFrame(48, 11))  # doctest: +SKIP
    >>> io.read_cphd("flight.cphd").aux["transmitter_m"].shape  # doctest: +SKIP
    torch.Size([8, 3])

    Samples are written in the domain FX as CF8, with SGN = -1. They are the frequency samples of
    the profiles, rounded to single precision; their phases refer to `scene_reference_m` of the side
    data, by default the origin. If the recording has other reference paths, its samples are turned
    to these. Antennas in one place are written as monostatic. The imaged area is the rectangle
    around `scene_corners_m`, or a square of the side of the unambiguous range. Velocities are
    differences of the positions.

    Args:
        recording: Recording of one trial with the axes (pulse, range), as by `read_path`,
            `read_cphd` or `simulate_path`.
        path: Path of the file.
        frame: Frame of the positions, such as LocalFrame(latitude_deg, longitude_deg, height_m);
            None for that in `origin_deg_m` of the side data.
        start: Time of the start of the collection, to which the times of pulses are relative.
        mode: Mode of the radar, "SPOTLIGHT", "STRIPMAP" or "DYNAMIC STRIPMAP".

    Raises:
        ModuleNotFoundError: If sarkit is not installed (extra `formats`).
        FileNotFoundError: If the folder does not exist.
        ValueError: If the recording has several trials, or no positions, or no frame is known, or
            the mode does not exist.
    """
    if mode not in ("SPOTLIGHT", "STRIPMAP", "DYNAMIC STRIPMAP"):
        raise ValueError(f"mode must be 'SPOTLIGHT', 'STRIPMAP' or 'DYNAMIC STRIPMAP', got {mode!r}")
    sarkit, etree = (library(name, "formats", f"writing {path}") for name in ("sarkit.cphd", "lxml.etree"))
    frame, antennas = frame_of(recording, frame), antennas_of(recording)
    frequency = single(recording.aux["frequency_hz"], 1, "frequency_hz")
    point = torch.zeros_like(antennas.transmitter_m)
    if "scene_reference_m" in recording.aux:
        point = single(recording.aux["scene_reference_m"], 2, "scene_reference_m")
    legs = [torch.linalg.vector_norm(place - point, dim=-1) for place in antennas.places]
    samples = frequency_samples(single(recording.signal.data, 2, "the signal").to(torch.complex128))
    longer = antennas.reference_m - (legs[0] + legs[-1])
    # limit in metres, above which the phases refer to another point
    if float(longer.abs().max()) > 1e-8:
        samples = samples * unit_phasor(-longer[:, None] * frequency / LIGHT_M_S, samples.dtype)
    samples = samples.to(torch.complex64).numpy()
    half = LIGHT_M_S / (4 * frequency_step_hz(frequency) * _OVERSAMPLING)
    corners = torch.tensor([[-half, -half], [half, half]], dtype=torch.float64)
    if "scene_corners_m" in recording.aux:
        corners = single(recording.aux["scene_corners_m"], 2, "scene_corners_m")[:, :2]
    vectors = _vectors(antennas, legs, frequency, point, pulse_time_s(recording), frame)
    tree = etree.Element(f"{{{_NAMESPACE}}}CPHD").getroottree()
    root = sarkit.ElementWrapper(tree.getroot())
    root.from_dict(_content(samples.shape, vectors, antennas, corners, frame, start, mode))
    packed: Any = np.zeros(len(samples), sarkit.get_pvp_dtype(tree))
    for name, value in vectors.items():
        packed[name] = value
    seen = sarkit.compute_t_ref_from_pvps(packed[[0, -1]])
    root["Dwell"] = {  # every vector contributes to all points of the scene
        "NumCODTimes": 1,
        "CODTime": [{"Identifier": _CHANNEL, "CODTimePoly": np.array([[seen.mean()]])}],
        "NumDwellTimes": 1,
        "DwellTime": [{"Identifier": _CHANNEL, "DwellTimePoly": np.array([[math.fabs(seen[1] - seen[0])]])}],
    }
    dwell = root["Dwell"].elem
    tree.getroot().find("{*}PVP").addnext(dwell)
    # the cone angle of an antenna at rest is undefined, and the header has 90 degrees for it
    with np.errstate(invalid="ignore"):
        dwell.addnext(sarkit.compute_reference_geometry(tree, packed))

    def write(part: Path) -> None:
        with part.open("wb") as file, sarkit.Writer(file, sarkit.Metadata(xmltree=tree)) as writer:
            writer.write_signal(_CHANNEL, samples)
            writer.write_pvp(_CHANNEL, packed)

    write_whole(path, write)


def _vectors(
    antennas: AntennaPath, legs: list[Tensor], frequency: Tensor, point: Tensor, time: Tensor, frame: LocalFrame
) -> dict[str, Any]:
    """Parameters of the vectors by name, in the order of the CPHD schema."""
    step = frequency_step_hz(frequency)
    swath = 1 / (_OVERSAMPLING * step)
    sent = (time - time[0] if float(time[0]) < 0 else time).numpy()
    found: dict[str, Any] = {}
    for side, index in (("Tx", 0), ("Rcv", -1)):
        clock = sent if side == "Tx" else sent + ((legs[0] + legs[-1]) / LIGHT_M_S).numpy()
        earth = frame.geocentric_m(antennas.places[index]).numpy()
        # a single antenna has one position per pulse, at the time of transmission
        moved = sent if len(antennas.places) == 1 else clock
        speed = np.gradient(earth, moved, axis=0, edge_order=2 if len(moved) > 2 else 1)
        found |= {f"{side}Time": clock, f"{side}Pos": earth, f"{side}Vel": speed}
    return {
        **found,
        "SRPPos": frame.geocentric_m(point).numpy(),
        **dict.fromkeys(("aFDOP", "aFRR1", "aFRR2"), 0.0),
        **{"FX1": float(frequency[0]), "FX2": float(frequency[-1]), "TOA1": -swath / 2, "TOA2": swath / 2},
        **{"TDTropoSRP": 0.0, "SC0": float(frequency[0]), "SCSS": step},
    }


def _content(
    shape: tuple[int, ...],
    vectors: dict[str, Any],
    antennas: AntennaPath,
    corners: Tensor,
    frame: LocalFrame,
    start: datetime,
    mode: str,
) -> dict[str, Any]:
    """Entries of the XML header by element, without dwell and reference geometry.

    corners: two opposite corners of the imaged area in metres, (corner, 2).
    """
    wgs84 = library("sarkit.wgs84", "formats", "geodetic coordinates")
    origin = frame.geocentric_m(torch.zeros(3, dtype=torch.float64))
    east, north, _ = (frame.geocentric_m(torch.eye(3, dtype=torch.float64)) - origin).numpy()
    # south-west and north-east corner
    low, high = corners.amin(0).tolist(), corners.amax(0).tolist()
    ring = [low, (low[0], high[1]), high, (high[0], low[1])]
    edges = frame.geocentric_m(torch.tensor([[*point, 0.0] for point in ring], dtype=torch.float64)).numpy()
    sizes = [3 if np.ndim(value) == 2 else 1 for value in vectors.values()]
    offsets = np.cumsum([0, *sizes]).tolist()
    band, swath = vectors["FX2"] - vectors["FX1"], vectors["TOA2"] - vectors["TOA1"]
    fixed = bool((vectors["SRPPos"] == vectors["SRPPos"][0]).all())
    bistatic = {} if antennas.receiver_m is None else {"IlluminatorName": "transmitter"}
    # image grid of the area, whose spacing is the resolution and whose lines follow each other
    # eastward
    spacing = LIGHT_M_S / (2 * band)
    counts = [max(1, math.ceil((high[i] - low[i]) / spacing)) for i in (0, 1)]
    grid = {
        # line and sample of the origin of the scene coordinates
        "IARPLocation": [round(-low[i] / spacing - 0.5) for i in (0, 1)],
        "IAXExtent": {"LineSpacing": spacing, "FirstLine": 0, "NumLines": counts[0]},
        "IAYExtent": {"SampleSpacing": spacing, "FirstSample": 0, "NumSamples": counts[1]},
    }
    return {
        "CollectionID": {
            "CollectorName": "receiver" if bistatic else "radar",
            **bistatic,
            "CoreName": "torchsar",
            "CollectType": "BISTATIC" if bistatic else "MONOSTATIC",
            "RadarMode": {"ModeType": mode},
            "Classification": "UNCLASSIFIED",
            "ReleaseInfo": "UNRESTRICTED",
        },
        "Global": {
            "DomainType": "FX",
            "SGN": -1,
            "Timeline": {
                "CollectionStart": start,
                "TxTime1": float(vectors["TxTime"][0]),
                "TxTime2": float(vectors["TxTime"][-1]),
            },
            "FxBand": {"FxMin": vectors["FX1"], "FxMax": vectors["FX2"]},
            "TOASwath": {"TOAMin": vectors["TOA1"], "TOAMax": vectors["TOA2"]},
        },
        "SceneCoordinates": {
            "EarthModel": "WGS_84",
            "IARP": {"ECF": origin.numpy(), "LLH": [frame.latitude_deg, frame.longitude_deg, frame.height_m]},
            "ReferenceSurface": {"Planar": {"uIAX": east, "uIAY": north}},
            "ImageArea": {"X1Y1": low, "X2Y2": high},
            "ImageAreaCornerPoints": wgs84.cartesian_to_geodetic(edges)[:, :2],
            "ImageGrid": grid,
        },
        "Data": {
            "SignalArrayFormat": "CF8",
            "NumBytesPVP": 8 * offsets[-1],
            "NumCPHDChannels": 1,
            "Channel": [
                {
                    "Identifier": _CHANNEL,
                    "NumVectors": shape[0],
                    "NumSamples": shape[1],
                    "SignalArrayByteOffset": 0,
                    "PVPArrayByteOffset": 0,
                }
            ],
            "NumSupportArrays": 0,
        },
        "Channel": {
            "RefChId": _CHANNEL,
            "FXFixedCPHD": True,
            "TOAFixedCPHD": True,
            "SRPFixedCPHD": fixed,
            "Parameters": [
                {
                    "Identifier": _CHANNEL,
                    "RefVectorIndex": shape[0] // 2,
                    "FXFixed": True,
                    "TOAFixed": True,
                    "SRPFixed": fixed,
                    "Polarization": {"TxPol": "UNSPECIFIED", "RcvPol": "UNSPECIFIED"},
                    "FxC": (vectors["FX1"] + vectors["FX2"]) / 2,
                    "FxBW": band,
                    "TOASaved": swath,
                    "DwellTimes": {"CODId": _CHANNEL, "DwellId": _CHANNEL},
                }
            ],
        },
        "PVP": {
            name: {"Offset": at, "Size": size, "dtype": np.dtype("f8" if size == 1 else "3f8")}
            for name, size, at in zip(vectors, sizes, offsets, strict=False)
        },
    }
