"""Reader and writer of complex images in the format SICD, NGA.STND.0024."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Recording, Signal, refuse_non_finite, unit_phasor
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.path_image import PathImage, spatial_band
from torchsar.focus.spotlight import window_weights
from torchsar.io.cphd import UNKNOWN_START
from torchsar.io.extras import library, quiet, reading, write_whole
from torchsar.io.geometry import antennas_of, frame_of, image_samples, pulse_time_s, single
from torchsar.radar import LIGHT_M_S, LocalFrame


def read_sicd(path: str | Path, dtype: torch.dtype = torch.complex64) -> Signal:
    """Read a complex image from a file in the format SICD (NITF).

    >>> from torchsar import io
    >>> io.read_sicd("image.nitf").names  # doctest: +SKIP
    ('azimuth', 'range')

    Rows, which the standard orders by range, become the axis of range, and columns that of
    azimuth. Samples are those of the file: the spectrum of the image lies about zero, and the
    spatial frequencies KCtr of the file are not restored.

    Args:
        path: Path of the file.
        dtype: complex64 or complex128, dtype of the samples.

    Returns:
        Image with the axes (azimuth, range) in metres along the plane of the file, from its centre
        point (SCP).

    Raises:
        ModuleNotFoundError: If sarkit is not installed (extra `formats`).
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or of another kind.
    """
    path = Path(path)
    sarkit = library("sarkit.sicd", "formats", f"reading {path}")
    with reading(path, "SICD"), path.open("rb") as file:
        # the header of NITF 2.1 has the length of the file here
        start, held = file.read(354), path.stat().st_size
        length = start[342:]
        if not start.startswith((b"NITF", b"NSIF")):
            raise ValueError(f"it begins with {start[:24]!r} instead of NITF; give the file of a SICD image")
        if length.isdigit() and int(length) > held:
            raise ValueError(f"it is cut off: its header counts {int(length)} bytes, and it has {held}; copy it again")
        file.seek(0)
        reader = sarkit.NitfReader(file)
        xml = sarkit.XmlHelper(reader.metadata.xmltree)
        counts = [int(xml.load(f"{{*}}ImageData/{{*}}{name}")) for name in ("NumRows", "NumCols")]
        pixel = xml.load("{*}ImageData/{*}PixelType")
        needed = counts[0] * counts[1] * sarkit.PIXEL_TYPES[pixel]["bytes"]
        stored = sum(int(segment["Data"].size) for segment in reader.jbp["ImageSegments"])
        if min(counts) < 1 or not needed <= stored <= path.stat().st_size:
            raise ValueError(
                f"it is cut off or damaged: {counts[0]} rows of {counts[1]} samples take {needed} bytes, its header "
                f"counts {stored}, and the file has {path.stat().st_size}"
            )
        samples = torch.from_numpy(_complex(reader.read_image(), xml)).T.contiguous()
        first = [int(xml.load(f"{{*}}ImageData/{{*}}First{name}")) for name in ("Row", "Col")]
        centre = [int(v) for v in xml.load("{*}ImageData/{*}SCPPixel")]
        axes = [
            Axis(name, count, (offset - middle) * step, step, "m")
            for name, count, offset, middle, step in zip(
                ("range", "azimuth"),
                counts,
                first,
                centre,
                (float(xml.load(f"{{*}}Grid/{{*}}{name}/{{*}}SS")) for name in ("Row", "Col")),
                strict=True,
            )
        ]
        refuse_non_finite(samples, str(path))
    return Signal(samples.to(dtype), (axes[1], axes[0]))


def _complex(image: np.ndarray, xml: Any) -> np.ndarray:
    """Convert pixels of any type to complex samples in the byte order of the machine."""
    if not image.dtype.names:
        return image.astype("c8")
    first, second = (image[name].astype("f4") for name in image.dtype.names)
    if xml.load("{*}ImageData/{*}PixelType") != "AMP8I_PHS8I":
        return first + 1j * second
    table = xml.load("{*}ImageData/{*}AmpTable")
    amplitude = first if table is None else np.asarray(table, "f4")[image[image.dtype.names[0]]]
    return (amplitude * np.exp(2j * np.pi * second / 256)).astype("c8")


_NAMESPACE = "urn:SICD:1.4.0"
# _POINTS: number of points along each axis at which spatial frequencies are fitted, by choice
# _ORDER: order of the fitted polynomials, by choice
_POINTS, _ORDER = 7, 2
# for each window: its name in SICD, and its -3 dB width times the bandwidth
_WINDOWS = {"none": ("UNIFORM", 0.885892941378905), "hann": ("HANNING", 1.4405)}


@quiet()
def write_sicd(
    signal: Signal,
    path: str | Path,
    recording: Recording,
    image: PathImage,
    frame: LocalFrame | None = None,
    start: datetime = UNKNOWN_START,
    mode: str = "SPOTLIGHT",
) -> None:
    """Write a complex image with its geometry as a SICD file (version 1.4.0, NITF).

    >>> from torchsar import Draws, echo, focus, io, radar, scene
    >>> flight = scene.Flight(scene.StraightPath([-5e3, 0.0, 3e3], [0.0, 100.0, 0.0]))
    >>> world = scene.PathWorld(scene.Points(azimuth_m=[0.0], range_m=[0.0]), flight)
    >>> recording, _ = echo.simulate_path(radar.InverseRadar(1e10, 1e8, 100), world, 8, 8, Draws(1))
    >>> image = (stage := focus.SpotlightImage(recording.aux))(recording.signal)
    >>> io.write_sicd(image, "a.nitf", recording, stage, radar.LocalFrame(48, 11))  # doctest: +SKIP

    The grid is of type PLANE on the imaged plane, and its centre point (SCP) is the middle sample.
    Rows are along the axis of the image that is closest to the line of sight and point away from
    the radar; columns follow a quarter turn later, so that the normal points up. With Sgn = -1 a
    phase of +2 pi K x has the spatial frequency K: a scatterer is summed with K = f times the
    gradient of its path over c. KCtr is the middle of these at the SCP, and samples are multiplied
    by exp(-2j pi KCtr x), so that their spectrum lies about zero; DeltaKCOAPoly is the change of
    the middle over the image, DeltaK1 and DeltaK2 are the limits of the spectrum with it.
    Positions of the antennas are polynomials of time of order 9 at most.

    Args:
        signal: Image of one trial with the axes (azimuth, range), as `image` returns it.
        path: Path of the file.
        recording: Recording of which the image was formed.
        image: Stage that formed the image.
        frame: Frame of the positions; None for that in `origin_deg_m` of the side data.
        start: Time of the start of the collection.
        mode: Mode of the radar, "SPOTLIGHT", "STRIPMAP" or "DYNAMIC STRIPMAP".

    Raises:
        ModuleNotFoundError: If sarkit is not installed (extra `formats`).
        FileNotFoundError: If the folder does not exist.
        ValueError: If the image or the recording has several trials, the image is not of the
            stage, or no frame is known.
    """
    sarkit, wgs84, etree = (
        library(name, "formats", f"writing {path}") for name in ("sarkit.sicd", "sarkit.wgs84", "lxml.etree")
    )
    data = image_samples(signal, image)
    scene = _Scene(recording, image, frame_of(recording, frame))
    tree = etree.Element(f"{{{_NAMESPACE}}}SICD").getroottree()
    root = sarkit.ElementWrapper(tree.getroot())
    root.from_dict(_content(scene, image.windows, wgs84, start, mode))
    known = sarkit.compute_scp_coa(tree)
    for node in known.iter():  # an antenna at rest has no cone angle, and the library writes NaN
        if node.text == "nan" and etree.QName(node).localname == "DopplerConeAng":
            node.text = "90.0"
    root["SCPCOA"] = known
    samples = scene.samples(data)
    security = sarkit.NitfSecurityFields(clas="U")
    metadata = sarkit.NitfMetadata(
        xmltree=tree,
        file_header_part=sarkit.NitfFileHeaderPart(ostaid="torchsar", security=security),
        im_subheader_part=sarkit.NitfImSubheaderPart(isorce="torchsar", security=security),
        de_subheader_part=sarkit.NitfDeSubheaderPart(security=security),
    )

    def write(part: Path) -> None:
        with part.open("wb") as file, sarkit.NitfWriter(file, metadata) as writer:
            writer.write_image(samples)

    write_whole(path, write)


@dataclass(frozen=True)
class _Pixels:
    """Pixels in an order in which the directions of rows, of columns and up are right-handed.

    Args:
        corner_m: Position of the first pixel.
        down: Direction in which rows are counted.
        right: Direction in which columns are counted.
        counts: Number of rows and columns.
        step_m: Spacing of rows and columns.
        turns: Quarter turns by `torch.rot90` that bring the transposed image into this order.
    """

    corner_m: Tensor
    down: Tensor
    right: Tensor
    counts: tuple[int, int]
    step_m: float
    turns: int = 0

    @property
    def middle(self) -> tuple[int, int]:
        """Row and column of the scene centre point."""
        return self.counts[0] // 2, self.counts[1] // 2

    def at(self, row: Tensor | float, column: Tensor | float) -> Tensor:
        """Positions of pixels in metres, (..., 3)."""
        row, column = (torch.as_tensor(v, dtype=torch.float64)[..., None] for v in (row, column))
        return self.corner_m + self.step_m * (row * self.down + column * self.right)


def _away_from(grid: ImageGrid, position_m: Tensor) -> _Pixels:
    """Order of the pixels of an image in which the rows point away from a position most
    directly.
    """
    down, right, (columns, rows) = grid.axes[1], grid.axes[0], grid.counts
    orders = [(down, right), (-right, down), (-down, -right), (right, -down)]  # after 0 to 3 quarter turns
    sight = grid.origin_m + grid.step_m * (rows // 2 * down + columns // 2 * right) - position_m
    turns = max(range(4), key=lambda k: float(orders[k][0] @ sight))
    corner = (turns in (2, 3)) * (rows - 1) * down + (turns in (1, 2)) * (columns - 1) * right
    counts = (columns, rows) if turns % 2 else (rows, columns)
    return _Pixels(grid.origin_m + grid.step_m * corner, *orders[turns], counts, grid.step_m, turns)


class _Scene:
    """An image with the antennas that see it.

    Args:
        recording: Recording of which the image was formed.
        image: Stage that formed it.
        frame: Frame of the positions.

    Attributes:
        time: Times of the pulses after the first in seconds.
        lit: First and last pulse that see the points and, at the end, the centre, (point, 2).
        low, high: Limits of the spatial frequencies along rows and columns there, (point, 2).
    """

    def __init__(self, recording: Recording, image: PathImage, frame: LocalFrame) -> None:
        self.frame, self.antennas = frame, antennas_of(recording)
        self.frequency = single(recording.aux["frequency_hz"], 1, "frequency_hz")
        time = pulse_time_s(recording)
        self.time = time - time[0]
        self.pixels = _away_from(image.grid, torch.stack([place.mean(0) for place in self.antennas.places]).mean(0))
        self.scp_m = self.pixels.at(*self.pixels.middle)
        # points from the first to the last row and column, so that the corners are included
        along = [torch.tensor(np.linspace(0, n - 1, _POINTS), dtype=torch.float64).round() for n in self.pixels.counts]
        rows, columns = (v.reshape(-1) for v in torch.meshgrid(*along, indexing="ij"))
        self.row_m, self.column_m = (
            (v - n) * self.pixels.step_m for v, n in zip((rows, columns), self.pixels.middle, strict=True)
        )
        points = torch.cat([self.pixels.at(rows, columns), self.scp_m[None]])
        of, last = image.lit(self.antennas), self.antennas.pulses - 1
        ends = torch.tensor([[0, last + 1]]).expand(len(points), 2) if of is None else of(points)
        self.lit = torch.stack([ends[:, 0], ends[:, 1] - 1], -1).clamp(0, last)
        axes = torch.stack([self.pixels.down, self.pixels.right])
        edges = self.lit + torch.tensor([0, 1])
        self.low, self.high = spatial_band(points, axes, self.antennas, self.frequency, edges)

    def samples(self, data: Tensor) -> np.ndarray:
        """Samples (row, column), shifted to baseband: their spectrum is centred about zero."""
        data = torch.rot90(data.T, self.pixels.turns)
        for dim, middle in enumerate((self.low[-1] + self.high[-1]) / 2):
            x = self.pixels.step_m * (torch.arange(data.shape[dim], dtype=torch.float64) - self.pixels.middle[dim])
            carrier = unit_phasor(-float(middle) * x, data.dtype)
            data = data * (carrier[:, None] if dim == 0 else carrier)
        return data.to(torch.complex64).contiguous().numpy()

    def direction(self, dim: int, window: str) -> dict[str, Any]:
        """SICD parameters of the rows (dim 0) or of the columns (dim 1); frequencies are in cycles
        per metre.
        """
        low, high, nyquist = self.low[:, dim], self.high[:, dim], 0.5 / self.pixels.step_m
        middle, width = (low + high) / 2, min(float(high[-1] - low[-1]), 2 * nyquist)
        poly = self.fitted(middle[:-1] - middle[-1], 0.0)
        corners = [i * (_POINTS - 1) + j * (_POINTS - 1) * _POINTS for i in (0, 1) for j in (0, 1)]
        change = np.polynomial.polynomial.polyval2d(self.row_m.numpy(), self.column_m.numpy(), poly)[corners]
        limits = (float(change.min()) - width / 2, float(change.max()) + width / 2)
        if max(-limits[0], limits[1]) > nyquist:  # the spectrum is aliased
            limits = (-nyquist, nyquist)
        axis = (self.pixels.down, self.pixels.right)[dim]
        along = self.frame.geocentric_m(axis) - self.frame.geocentric_m(torch.zeros_like(axis))
        name, spread = _WINDOWS[window]
        return {
            "UVectECF": (along / torch.linalg.vector_norm(along)).numpy(),
            "SS": self.pixels.step_m,
            "ImpRespWid": spread / width,
            "Sgn": -1,
            "ImpRespBW": width,
            "KCtr": float(middle[-1]),
            "DeltaK1": limits[0],
            "DeltaK2": limits[1],
            "DeltaKCOAPoly": poly,
            "WgtType": {"WindowName": name},
            **({} if window == "none" else {"WgtFunct": window_weights(window, 65).numpy()}),
        }

    def fitted(self, values: Tensor, at_centre: float) -> np.ndarray:
        """Fit a polynomial of row and column in metres to values at the points.

        At the centre point the polynomial has the value `at_centre`.
        """
        row, column, power = self.row_m.numpy(), self.column_m.numpy(), np.arange(_ORDER + 1)
        scale, total = max(np.abs(row).max(), np.abs(column).max(), 1e-9), power[:, None] + power
        used = (total > 0) & (total <= _ORDER)
        terms = np.polynomial.polynomial.polyvander2d(row / scale, column / scale, (_ORDER, _ORDER))[:, used.ravel()]
        poly = np.zeros(total.shape)
        poly[used] = np.linalg.lstsq(terms, values.numpy() - at_centre, rcond=None)[0]
        poly[0, 0] = at_centre
        return poly / scale**total

    def time_poly(self) -> np.ndarray:
        """Polynomial of row and column in metres for the time in seconds of the middle of the
        aperture.
        """
        times = self.time[self.lit].mean(-1)
        if bool((self.lit == self.lit[0]).all()):
            return np.array([[float(times[-1])]])
        return self.fitted(times[:-1], float(times[-1]))

    def positions(self) -> dict[str, Any]:
        """Polynomials of the antenna positions by their SICD names."""
        places = self.antennas.places
        if len(places) == 1:
            return {"ARPPoly": self._poly(self.time, places[0])}
        away = [place - self.scp_m for place in places]
        ranges = [torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in away]
        middle = away[0] / ranges[0] + away[1] / ranges[1]
        # position on the bisector of both antenna directions, at their mean range
        bisector = self.scp_m + (ranges[0] + ranges[1]) / 2 * middle / torch.linalg.vector_norm(
            middle, dim=-1, keepdim=True
        )
        delay = [r[:, 0] / LIGHT_M_S for r in ranges]
        return {
            "ARPPoly": self._poly(self.time, bisector),
            "GRPPoly": self.frame.geocentric_m(self.scp_m).numpy()[None],
            "TxAPCPoly": self._poly(self.time - delay[0], places[0]),
            "RcvAPC": [self._poly(self.time + delay[1], places[1])],
        }

    def _poly(self, time: Tensor, position: Tensor) -> np.ndarray:
        """Fit a polynomial of time in seconds to geocentric positions, (power, 3).

        Its order is the lowest with an rms distance of at most 0.1 mm, and at most 9, by choice.
        """
        earth = self.frame.geocentric_m(position).numpy()
        scale, orders = max(float(time.abs().max()), 1e-9), range(min(2, len(time)), min(9, len(time) - 1) + 2)
        powers = np.polynomial.polynomial.polyvander(time.numpy() / scale, orders.stop)
        for n in orders:
            found = np.linalg.lstsq(powers[:, :n], earth, rcond=None)[0]
            if np.sqrt(((powers[:, :n] @ found - earth) ** 2).sum(-1).mean()) <= 1e-4:
                break
        return found / scale ** np.arange(len(found))[:, None]


def _content(scene: _Scene, windows: Sequence[str], wgs84: Any, start: datetime, mode: str) -> dict[str, Any]:
    """Entries of the XML by element, without SCPCOA.

    windows: names of the windows along azimuth and along range.
    """
    pixels, frame, antennas = scene.pixels, scene.frame, scene.antennas
    rows, columns = pixels.counts
    ends = torch.tensor([[0, 0], [0, columns - 1], [rows - 1, columns - 1], [rows - 1, 0]])
    corners = wgs84.cartesian_to_geodetic(frame.geocentric_m(pixels.at(ends[:, 0], ends[:, 1])).numpy())[:, :2]
    centre = frame.geocentric_m(scene.scp_m).numpy()
    low, high = float(scene.frequency[0]), float(scene.frequency[-1])
    bistatic = antennas.receiver_m is not None
    names = {"CollectorName": "receiver", "IlluminatorName": "transmitter"} if bistatic else {"CollectorName": "radar"}
    channel = {"@index": 1, "TxRcvPolarization": "UNKNOWN", **({"RcvAPCIndex": 1} if bistatic else {})}
    return {
        "CollectionInfo": {
            **names,
            "CoreName": "torchsar",
            "CollectType": "BISTATIC" if bistatic else "MONOSTATIC",
            "RadarMode": {"ModeType": mode},
            "Classification": "UNCLASSIFIED",
        },
        "ImageData": {
            "PixelType": "RE32F_IM32F",
            "NumRows": rows,
            "NumCols": columns,
            "FirstRow": 0,
            "FirstCol": 0,
            "FullImage": {"NumRows": rows, "NumCols": columns},
            "SCPPixel": list(pixels.middle),
        },
        "GeoData": {
            "EarthModel": "WGS_84",
            "SCP": {"ECF": centre, "LLH": wgs84.cartesian_to_geodetic(centre)},
            "ImageCorners": corners,
        },
        "Grid": {
            "ImagePlane": "GROUND",
            "Type": "PLANE",
            "TimeCOAPoly": scene.time_poly(),
            "Row": scene.direction(0, windows[1]),
            "Col": scene.direction(1, windows[0]),
        },
        "Timeline": {"CollectStart": start, "CollectDuration": float(scene.time[-1])},
        "Position": scene.positions(),
        "RadarCollection": {
            "TxFrequency": {"Min": low, "Max": high},
            "TxPolarization": "UNKNOWN",
            "RcvChannels": {"@size": 1, "ChanParameters": [channel]},
        },
        "ImageFormation": {
            "RcvChanProc": {"NumChanProc": 1, "ChanIndex": [1]},
            "TxRcvPolarizationProc": "UNKNOWN",
            "TStartProc": 0.0,
            "TEndProc": float(scene.time[-1]),
            "TxFrequencyProc": {"MinProc": low, "MaxProc": high},
            "ImageFormAlgo": "OTHER",
            "STBeamComp": "NO",
            "ImageBeamComp": "NO",
            "AzAutofocus": "NO",
            "RgAutofocus": "NO",
        },
    }
