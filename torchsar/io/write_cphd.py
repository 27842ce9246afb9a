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
