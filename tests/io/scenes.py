"""A small recording of two points, and CPHD files that are built without `write_cphd`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Draws, Recording, Signal
from torchsar.echo import simulate_path
from torchsar.focus import PathImage
from torchsar.radar import LIGHT_M_S, InverseRadar, LocalFrame
from torchsar.scene import Flight, PathWorld, Points, StraightPath

FRAME = LocalFrame(48.0, 11.0, 500.0)
PULSES, SAMPLES = 48, 63
PRF = 200.0
# east, north and up in metres
POINT = np.array([-12.0, 10.0, 0.0])
_LEFT = ([-3535.0, -48.0, 3535.0], [0.0, 400.0, 0.0])
_RIGHT = ([-3000.0, 500.0, 2535.0], [20.0, 300.0, 0.0])
_XYZ, _F8 = "X=F8;Y=F8;Z=F8;", "F8"
_VECTORS = {"TxPos", "TxVel", "RcvPos", "RcvVel", "SRPPos"}


def recorded(bistatic: bool = False, trials: range | None = None) -> Recording:
    """Two points seen from the west, one of them `POINT`."""
    flights = [Flight(StraightPath(*_LEFT)), *([Flight(StraightPath(*_RIGHT))] if bistatic else [])]
    world = PathWorld(Points(azimuth_m=[0.0, POINT[1]], range_m=[0.0, POINT[0]], amplitude=[0.5, 1.0]), *flights)
    radar = InverseRadar(9.6e9, 300e6, PRF)
    return simulate_path(radar, world, PULSES, SAMPLES, Draws(1, trials=trials), dtype=torch.complex128)[0]


def element(name: str, content: Any) -> str:
    """XML of an element; the content is text, a mapping, or a list of these."""
    if isinstance(content, list):
        return "".join(element(name, one) for one in content)
    inner = "".join(element(key, value) for key, value in content.items()) if isinstance(content, dict) else content
    tag, _, attribute = name.partition(" ")
    return f"<{tag}{' ' if attribute else ''}{attribute}>{inner}</{tag}>"


def xyz(values: Any) -> dict[str, Any]:
    return dict(zip("XYZ", values))


def to_earth(local: np.ndarray) -> np.ndarray:
    """Geocentric positions by the ellipsoid of another library."""
    from sarkit import wgs84

    llh = [FRAME.latitude_deg, FRAME.longitude_deg, FRAME.height_m]
    axes = np.stack([wgs84.east(llh), wgs84.north(llh), wgs84.up(llh)])
    return wgs84.geodetic_to_cartesian(llh) + local @ axes


class Built:
    """Content of a CPHD file of one point, by the formulas of the standard.

    Args:
        domain: "FX" or "TOA".
        sign: SGN of the standard.
        bistatic: Whether the antennas are far apart; otherwise one antenna moves while the pulse
            travels.
        start: First frequency (FX) or delay (TOA) of each vector.
        step: Their step.
        form: Format of the samples.
    """

    def __init__(
        self,
        domain: str = "FX",
        sign: int = -1,
        bistatic: bool = False,
        start: np.ndarray | float | None = None,
        step: np.ndarray | float | None = None,
        form: str = "CF8",
    ) -> None:
        self.domain, self.sign, self.bistatic, self.form = domain, sign, bistatic, form
        self.time = 1.0 + np.arange(PULSES) / PRF
        left, right = (np.array(p) + np.outer(self.time - 1, v) for p, v in (_LEFT, _RIGHT))
        self.tx = left
        self.rx = right if bistatic else left + 2 * 5000 / LIGHT_M_S * np.array(_LEFT[1])
        self.srp = np.array([3.0, -2.0, 1.0]) + np.zeros((PULSES, 3))
        self.low, self.high = 9.45e9, 9.75e9
        default = (self.low, (self.high - self.low) / (SAMPLES - 1))
        if domain == "TOA":
            default = (-30.7 / 360e6, 1 / 360e6)
        self.start, self.step = (np.broadcast_to(d if v is None else v, PULSES) for d, v in zip(default, (start, step)))
        self.delay = (self.legs(POINT) - self.legs(self.srp)) / LIGHT_M_S

    def legs(self, x: np.ndarray) -> np.ndarray:
        """Path over points in metres."""
        return np.linalg.norm(self.tx - x, axis=-1) + np.linalg.norm(self.rx - x, axis=-1)

    def samples(self) -> np.ndarray:
        at = self.start[:, None] + self.step[:, None] * np.arange(SAMPLES)
        if self.domain == "FX":
            found = np.exp(self.sign * 2j * np.pi * at * self.delay[:, None])
        else:  # the sum over the band of the spectrum, demodulated to its middle
            middle = (self.low + self.high) / 2
            off = (np.arange(SAMPLES) - SAMPLES // 2) / (SAMPLES * self.step[0])
            off = off[np.abs(off) <= (self.high - self.low) / 2]
            spectrum = np.exp(self.sign * 2j * np.pi * (middle + off) * self.delay[:, None])
            found = (spectrum[:, None] * np.exp(-self.sign * 2j * np.pi * off * at[..., None])).sum(-1)
            found = found / SAMPLES**0.5
        if self.form == "CF8":
            return found.astype("c8")
        kind = np.dtype([("real", "i1"), ("imag", "i1")] if self.form == "CI2" else [("real", "i2"), ("imag", "i2")])
        scaled = np.zeros(found.shape, kind)
        scaled["real"], scaled["imag"] = (np.rint(part * 100) for part in (found.real, found.imag))
        return scaled

    def vectors(self) -> dict[str, Any]:
        velocities = [np.gradient(to_earth(place), self.time, axis=0) for place in (self.tx, self.rx)]
        return {
            "TxTime": self.time,
            "TxPos": to_earth(self.tx),
            "TxVel": velocities[0],
            "RcvTime": self.time + 5000 * 2 / LIGHT_M_S,
            "RcvPos": to_earth(self.rx),
            "RcvVel": velocities[1],
            "SRPPos": to_earth(self.srp),
            "AmpSF": 1.0 if self.form == "CF8" else 0.01,
            "aFDOP": 0.0,
            "aFRR1": 0.0,
            "aFRR2": 0.0,
            "FX1": self.start if self.domain == "FX" else self.low,
            "FX2": self.start + (SAMPLES - 1) * self.step if self.domain == "FX" else self.high,
            "TOA1": -5e-8,
            "TOA2": 5e-8,
            "TDTropoSRP": 0.0,
            "SC0": self.start,
            "SCSS": self.step,
        }

    def write(self, path: Path, vectors: dict[str, Any] | None = None) -> Path:
        import lxml.etree
        import sarkit.cphd as sarkit

        vectors = self.vectors() | (vectors or {})
        xml = element('CPHD xmlns="http://api.nsgreg.nga.mil/schema/cphd/1.0.1"', self._content(list(vectors))).replace(
            "</CPHD xmlns=", "</CPHD"
        )
        tree = lxml.etree.fromstring(xml).getroottree()
        packed = np.zeros(PULSES, sarkit.get_pvp_dtype(tree))
        for name, value in vectors.items():
            packed[name] = value
        with path.open("wb") as file, sarkit.Writer(file, sarkit.Metadata(xmltree=tree)) as writer:
            writer.write_signal("main", self.samples())
            writer.write_pvp("main", packed)
        return path

    def _content(self, names: list[str]) -> dict[str, Any]:
        sizes = [3 if name in _VECTORS else 1 for name in names]
        offsets = np.cumsum([0, *sizes]).tolist()
        corners = [(47.9995, 10.9995), (48.0005, 10.9995), (48.0005, 11.0005), (47.9995, 11.0005)]
        llh = dict(zip(("Lat", "Lon", "HAE"), (FRAME.latitude_deg, FRAME.longitude_deg, FRAME.height_m)))
        return {
            "CollectionID": {
                "CollectorName": "test",
                "CoreName": "test",
                "CollectType": "BISTATIC" if self.bistatic else "MONOSTATIC",
                "RadarMode": {"ModeType": "SPOTLIGHT"},
                "Classification": "UNCLASSIFIED",
                "ReleaseInfo": "UNRESTRICTED",
            },
            "Global": {"DomainType": self.domain, "SGN": f"{self.sign:+d}"},
            "SceneCoordinates": {
                "EarthModel": "WGS_84",
                "IARP": {"ECF": xyz(to_earth(np.zeros(3))), "LLH": llh},
                "ImageAreaCornerPoints": {
                    f'IACP index="{i}"': {"Lat": lat, "Lon": lon} for i, (lat, lon) in enumerate(corners, 1)
                },
            },
            "Data": {
                "SignalArrayFormat": self.form,
                "NumBytesPVP": 8 * offsets[-1],
                "NumCPHDChannels": 1,
                "Channel": {
                    "Identifier": "main",
                    "NumVectors": PULSES,
                    "NumSamples": SAMPLES,
                    "SignalArrayByteOffset": 0,
                    "PVPArrayByteOffset": 0,
                },
                "NumSupportArrays": 0,
            },
            "Channel": {"RefChId": "main"},
            "PVP": {
                name: {"Offset": at, "Size": size, "Format": _XYZ if size == 3 else ("I8" if name == "SIGNAL" else _F8)}
                for name, at, size in zip(names, offsets, sizes)
            },
        }


def imaged(stage: PathImage, recording: Recording) -> Signal:
    """The image of a recording by a stage."""
    used = ("frequency_hz", "transmitter_m", "receiver_m", "path_reference_m")
    return stage(recording.signal, **{name: recording.aux[name] for name in used if name in recording.aux})
