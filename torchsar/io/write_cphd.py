"""Writer of compensated phase history data (CPHD), NGA.STND.0068-1."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Recording, unit_phasor
from torchsar.io.extras import library, quiet, write_whole
from torchsar.io.geometry import antennas_of, frame_of, pulse_time_s, single
from torchsar.radar import LIGHT_M_S, AntennaPath, LocalFrame, frequency_samples
from torchsar.radar.spotlight import frequency_step_hz

_NAMESPACE = "http://api.nsgreg.nga.mil/schema/cphd/1.1.0"
_CHANNEL = "1"
# start of the collection where none is known
UNKNOWN_START = datetime(1970, 1, 1, tzinfo=UTC)
# samples per delay that the file declares as valid: the recommendation of the standard is 1.2
_OVERSAMPLING = 1.25
# a reference path that differs by less from that over the reference point is the same, in metres
_SAME_M = 1e-8
# numbers per vector of each parameter, in the order of the schema
_SIZES: dict[str, int] = {
    **{"TxTime": 1, "TxPos": 3, "TxVel": 3, "RcvTime": 1, "RcvPos": 3, "RcvVel": 3, "SRPPos": 3, "aFDOP": 1},
    **{"aFRR1": 1, "aFRR2": 1, "FX1": 1, "FX2": 1, "TOA1": 1, "TOA2": 1, "TDTropoSRP": 1, "SC0": 1, "SCSS": 1},
}


@quiet()
def write_cphd(
    recording: Recording,
    path: str | Path,
    frame: LocalFrame | None = None,
    start: datetime = UNKNOWN_START,
    mode: str = "SPOTLIGHT",
) -> None:
    """Write range profiles with the positions of their antennas as a CPHD file, version 1.1.0.

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
    samples = _samples(single(recording.signal.data, 2, "the signal"), frequency, antennas, point)
    vectors = _vectors(antennas, frequency, point, pulse_time_s(recording), frame)
    tree = etree.Element(f"{{{_NAMESPACE}}}CPHD").getroottree()
    area = _area(recording, frequency, antennas)
    content = _content(samples.shape, vectors, antennas, area, frame, start, mode)
    sarkit.ElementWrapper(tree.getroot()).from_dict(content)
    packed: Any = np.zeros(len(samples), sarkit.get_pvp_dtype(tree))
    for name, value in vectors.items():
        packed[name] = value
    tree.getroot().find("{*}PVP").addnext(_dwell(sarkit, tree, packed))
    with np.errstate(invalid="ignore"):  # an antenna at rest has no cone angle, for which 90 degrees stand
        tree.getroot().find("{*}Dwell").addnext(sarkit.compute_reference_geometry(tree, packed))

    def write(part: Path) -> None:
        with part.open("wb") as file, sarkit.Writer(file, sarkit.Metadata(xmltree=tree)) as writer:
            writer.write_signal(_CHANNEL, samples)
            writer.write_pvp(_CHANNEL, packed)

    write_whole(path, write)


def _samples(data: Tensor, frequency: Tensor, antennas: AntennaPath, point: Tensor) -> np.ndarray:
    """Frequency samples whose phases refer to the reference point of each pulse."""
    history = frequency_samples(data.to(torch.complex128))
    over = torch.stack([torch.linalg.vector_norm(place - point, dim=-1) for place in antennas.places])
    longer = antennas.reference_m - over.sum(0) * (2 if len(over) == 1 else 1)
    if float(longer.abs().max()) > _SAME_M:
        history = history * unit_phasor(-longer[:, None] * frequency / LIGHT_M_S, history.dtype)
    return history.to(torch.complex64).numpy()


def _vectors(
    antennas: AntennaPath, frequency: Tensor, point: Tensor, time: Tensor, frame: LocalFrame
) -> dict[str, np.ndarray | float]:
    """Parameters of the vectors by name."""
    step = frequency_step_hz(frequency)
    one = len(antennas.places) == 1
    places = {"Tx": antennas.places[0], "Rcv": antennas.places[-1]}
    legs = {side: torch.linalg.vector_norm(place - point, dim=-1) for side, place in places.items()}
    if float(time[0]) < 0:
        time = time - time[0]
    times = {"Tx": time, "Rcv": time + (legs["Tx"] + legs["Rcv"]) / LIGHT_M_S}
    swath = 1 / (_OVERSAMPLING * step)
    found: dict[str, np.ndarray | float] = dict.fromkeys(("aFDOP", "aFRR1", "aFRR2", "TDTropoSRP"), 0.0)
    for side, place in places.items():
        earth = frame.geocentric_m(place).numpy()
        clock = times["Tx" if one else side].numpy()  # one antenna has one place for both times
        found |= {
            f"{side}Time": times[side].numpy(),
            f"{side}Pos": earth,
            f"{side}Vel": np.gradient(earth, clock, axis=0, edge_order=2 if len(clock) > 2 else 1),
        }
    return found | {
        "SRPPos": frame.geocentric_m(point).numpy(),
        "FX1": float(frequency[0]),
        "FX2": float(frequency[-1]),
        "TOA1": -swath / 2,
        "TOA2": swath / 2,
        "SC0": float(frequency[0]),
        "SCSS": step,
    }


def _area(recording: Recording, frequency: Tensor, antennas: AntennaPath) -> np.ndarray:
    """West, south, east and north limits of the imaged area in metres."""
    if "scene_corners_m" in recording.aux:
        corners = single(recording.aux["scene_corners_m"], 2, "scene_corners_m")[:, :2]
        return np.array([*corners.amin(0).tolist(), *corners.amax(0).tolist()])
    half = LIGHT_M_S / (4 * frequency_step_hz(frequency) * _OVERSAMPLING)
    return np.array([-half, -half, half, half])


def _content(
    shape: tuple[int, ...],
    vectors: dict[str, Any],
    antennas: AntennaPath,
    area: np.ndarray,
    frame: LocalFrame,
    start: datetime,
    mode: str,
) -> dict[str, Any]:
    """Content of the XML header by element, but for dwell and reference geometry."""
    origin = frame.geocentric_m(torch.zeros(3, dtype=torch.float64))
    east, north, _ = (frame.geocentric_m(torch.eye(3, dtype=torch.float64)) - origin).numpy()
    west_m, south_m, east_m, north_m = area.tolist()
    corners = [(west_m, south_m), (west_m, north_m), (east_m, north_m), (east_m, south_m)]
    offsets = np.cumsum([0, *_SIZES.values()]).tolist()
    band, swath = vectors["FX2"] - vectors["FX1"], vectors["TOA2"] - vectors["TOA1"]
    fixed = bool((vectors["SRPPos"] == vectors["SRPPos"][0]).all())
    bistatic = {} if antennas.receiver_m is None else {"IlluminatorName": "transmitter"}
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
            "ImageArea": {"X1Y1": [west_m, south_m], "X2Y2": [east_m, north_m]},
            "ImageAreaCornerPoints": _geodetic(frame, corners),
            "ImageGrid": _grid(area, LIGHT_M_S / (2 * band)),
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
            for (name, size), at in zip(_SIZES.items(), offsets, strict=False)
        },
    }


def _grid(area: np.ndarray, spacing_m: float) -> dict[str, Any]:
    """Grid of an image of the area with the spacing of the resolution, whose lines run east."""
    counts = [max(1, math.ceil((area[i + 2] - area[i]) / spacing_m)) for i in (0, 1)]
    first = [round(-area[i] / spacing_m - 0.5) for i in (0, 1)]  # lines before the origin
    return {
        "IARPLocation": first,
        "IAXExtent": {"LineSpacing": spacing_m, "FirstLine": 0, "NumLines": counts[0]},
        "IAYExtent": {"SampleSpacing": spacing_m, "FirstSample": 0, "NumSamples": counts[1]},
    }


def _geodetic(frame: LocalFrame, points: list[tuple[float, float]]) -> np.ndarray:
    """Latitudes and longitudes in degrees of points in the plane of a frame, (point, 2)."""
    wgs84 = library("sarkit.wgs84", "formats", "geodetic coordinates")
    local = torch.tensor([[*point, 0.0] for point in points], dtype=torch.float64)
    return wgs84.cartesian_to_geodetic(frame.geocentric_m(local).numpy())[:, :2]


def _dwell(sarkit: Any, tree: Any, vectors: np.ndarray) -> Any:
    """The element Dwell: all points of the scene are seen by all vectors."""
    seen = sarkit.compute_t_ref_from_pvps(vectors[[0, -1]])
    root = sarkit.ElementWrapper(tree.getroot())
    root["Dwell"] = {
        "NumCODTimes": 1,
        "CODTime": [{"Identifier": _CHANNEL, "CODTimePoly": np.array([[seen.mean()]])}],
        "NumDwellTimes": 1,
        "DwellTime": [{"Identifier": _CHANNEL, "DwellTimePoly": np.array([[math.fabs(seen[1] - seen[0])]])}],
    }
    return root["Dwell"].elem
