"""Motion logs: recorded times and positions of a platform, read from tables."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchsar.core import ArrayFile
from torchsar.radar.local_frame import LocalFrame, geocentric

# accepted names of the columns, in lower case and without unit
_NAMES = {
    "time": "t time timestamp seconds sec gps_time gpstime gps_seconds tow utc utc_time time_utc",
    "x": "x east easting e pos_x x_enu",
    "y": "y north northing n pos_y y_enu",
    "z": "z up u pos_z z_enu",
    "latitude": "lat latitude phi",
    "longitude": "lon long lng longitude lambda",
    "height": "h height alt altitude ellipsoidal_height elevation hgt altitude_msl height_msl alt_msl",
}
# accepted units after a name, as in time_ms, x (km) or lat[deg], with their factors
_UNITS = {
    **{"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3},
    **{"ft": 0.3048, "deg": 1.0, "degree": 1.0, "rad": 180 / np.pi},
    **{"second": 1.0, "millisecond": 1e-3, "meter": 1.0, "metre": 1.0},
}
_COLUMN = re.compile(r"(?P<name>.*?)(?:[_ ]*[(\[](?P<unit>\w+)[)\]]|_(?P<suffix>[a-z]+))?")


@dataclass(frozen=True, eq=False)
class Track:
    """Recorded positions of a platform in local Cartesian coordinates.

    >>> import torch
    >>> from torchsar import radar
    >>> time_s = torch.arange(5).double()
    >>> radar.Track(time_s, torch.stack([0 * time_s, 9 * time_s, 0 * time_s], -1)).position_m[-1]
    tensor([ 0., 36.,  0.], dtype=torch.float64)

    Args:
        time_s: Times of the records in seconds, rising, float64 (record,).
        position_m: Positions in metres, float64 (record, 3); of a log with latitudes these are
            east, north and up from the origin of the frame.
        frame: Frame of the positions; None for a log that holds Cartesian coordinates.
    """

    time_s: Tensor
    position_m: Tensor
    frame: LocalFrame | None = None


def read_track(file: str | Path, origin: Sequence[float] | None = None) -> Track:
    """Read a motion log: times with positions, as Cartesian coordinates or latitude and longitude.

    >>> import pathlib, tempfile
    >>> from torchsar import radar
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time_s,lat,lon,alt_m\\n0,48.0,11.0,500\\n1,48.001,11.0,500\\n")
    >>> log = radar.read_track(path, origin=(48.0, 11.0, 450.0))
    >>> [round(x) for x in log.position_m[1].tolist()]
    [0, 111, 50]

    The file is a table in text (commas, semicolons or blanks, with a line of names, which may begin
    with #), or a numpy archive (.npz) with one array per column. Its columns are:
    - `time` in seconds, dates such as 2024-05-17T10:15:30.5, or times of one day as 10:15:30.5;
    - `x`, `y`, `z` in metres, or `latitude` and `longitude` in degrees with `height` in metres.
    Common other names such as `t`, `east`, `lat`, `alt` are known, and units behind them, as in
    `time_ms`, `x (km)` or `time(milliseconds)`. A table of four numbers without names has the
    columns time, x, y, z; it is refused where x and y might be degrees, and change by less than a
    hundredth of z, and a warning names the doubt where they change by less than 2 cm/s. Other
    columns are ignored. Records with NaN are left out, and a warning names
    them.

    Args:
        file: Path of the log.
        origin: Origin of the coordinates: x, y, z in metres, or latitude and longitude in degrees
            and height in metres, above the same level as in the log. None for that of the file, or
            for the place of the first record at height 0.

    Returns:
        The track.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If columns are missing, or without names and possibly degrees, fewer than two
            records are left, times do not rise, or latitudes and longitudes are none.
    """
    path = Path(file)
    held = read_table(path)
    unnamed = [*held] == ["0", "1", "2", "3"]
    columns = _known(dict(zip("txyz", held.values())) if unnamed else held)
    earth = "latitude" in columns
    wanted = ("time", *(("latitude", "longitude", "height") if earth else ("x", "y", "z")))
    missing = [name for name in wanted if name not in columns]
    if missing or len({len(columns[name]) for name in wanted}) > 1:
        raise ValueError(
            f"{path} must hold columns of one length with time and x, y, z, or time, latitude, longitude and height, "
            f"got {', '.join(f'{name} ({len(x)})' for name, x in columns.items())}; name the columns in its first line"
            + "".join(f"; {name} may be called {', '.join(_NAMES[name].split())}" for name in missing)
        )
    table = np.stack([columns[name] for name in wanted], -1)
    bad = np.flatnonzero(~np.isfinite(table).all(-1))
    if len(bad):
        shown = ", ".join(map(str, bad[:5] + 1)) + (", ..." if len(bad) > 5 else "")
        warnings.warn(f"{path}: {len(bad)} of {len(table)} records hold NaN and are left out: {shown}", stacklevel=2)
        table = np.delete(table, bad, 0)
    time_s, place = torch.from_numpy(table[:, 0].copy()), torch.from_numpy(table[:, 1:].copy())
    steps = time_s.diff()
    if len(time_s) < 2 or not bool((steps > 0).all()):
        at = 0 if len(time_s) < 2 else int(steps.argmin()) + 1
        advice = "remove the repeated record" if at and float(steps.min()) == 0 else "sort them"
        raise ValueError(
            f"{path} must hold two records or more whose times rise, got {len(time_s)}"
            + (f", and {float(time_s[at]):.9g} s after {float(time_s[at - 1]):.9g} s; {advice}" if at else "")
        )
    if not earth:
        size, reach = place.abs().amax(0).tolist(), (place.amax(0) - place.amin(0))[:2]
        if unnamed and size[0] <= 90 and size[1] <= 360 and float(reach.max()) < 0.01 * size[2]:
            raise ValueError(
                f"{path} has no line of names, and columns 2 and 3 ({place[0, 0]:g}, {place[0, 1]:g}) hardly change, "
                "as degrees do; write time,lat,lon,height or time,x,y,z into its first line"
            )
        # Coordinates that change by less than 2 cm/s are those of a slow rail in metres, or of any
        # other platform in degrees, of which one is 111 km.
        if unnamed and size[0] <= 90 and size[1] <= 360 and float(reach.max()) < 0.02 * float(time_s[-1] - time_s[0]):
            warnings.warn(
                f"{path} has no line of names and is read as time, x, y, z in metres, which move by "
                f"{float(reach.max()):.3g} m in {float(time_s[-1] - time_s[0]):.4g} s; if columns 2 and 3 are degrees, "
                "write time,lat,lon,height into its first line, else time,x,y,z",
                stacklevel=2,
            )
        return Track(time_s, place if origin is None else place - place.new_tensor(list(origin)))
    if float(place[:, 0].abs().max()) > 90 or float(place[:, 1].abs().max()) > 360:
        low, high = place.amin(0).tolist(), place.amax(0).tolist()
        raise ValueError(
            f"{path}: latitude is {low[0]:g} to {high[0]:g} and longitude {low[1]:g} to {high[1]:g}, and must be "
            "degrees of at most 90 and 360; check their order, and whether they are scaled by 1e7"
        )
    if origin is None:
        warnings.warn(
            f"{path}: no origin is given, and the scene is taken to lie at height 0 under the first record; give "
            "origin=(latitude, longitude, height) of its middle",
            stacklevel=2,
        )
    frame = LocalFrame(*(origin or (*place[0, :2].tolist(), 0.0)))
    return Track(time_s, frame.local_m(geocentric(*place.unbind(-1))), frame)


def read_table(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a table of numbers.

    Args:
        path: Path of a text or .csv file, or of an .npz file of one-dimensional arrays.

    Returns:
        Columns by name, float64; without a line of names the names are "0", "1", ...

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file holds no table.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the path of a .csv, text or .npz file")
    with path.open("rb") as opened:
        archived = opened.read(4) in (b"PK\x03\x04", b"\x93NUM")
    if archived:
        held = {name: array.load("iuf").astype(np.float64) for name, array in ArrayFile(path).items()}
        return {name: x for name, x in held.items() if x.ndim == 1} or _numbered(next(iter(held.values())))
    try:
        lines = [line.strip() for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise ValueError(f"{path} is no table of numbers in text") from None
    decimal = "," if lines and ";" in lines[-1] else "."  # decimal comma of some countries
    mark = next((mark for mark in (";", ",", "\t") if lines and mark in lines[-1]), None)
    rows, names = [], []
    for number, line in enumerate(lines, 1):
        cells = [cell.strip().strip('"').replace(decimal, ".") for cell in line.lstrip("# ").split(mark)]
        try:
            values = [_value(cell) for cell in cells]
        except ValueError:
            if rows and not line.startswith("#"):
                raise ValueError(f"{path}: row {number} is no row of numbers: {line[:60]!r}") from None
            names = names if rows else cells
            continue
        if line.startswith("#"):
            continue
        if rows and len(values) != len(rows[0]):
            raise ValueError(f"{path}: row {number} has {len(values)} numbers, and others have {len(rows[0])}")
        rows.append(values)
    if not rows:
        raise ValueError(f"{path} holds no rows of numbers{f'; it begins with {lines[0][:60]!r}' if lines else ''}")
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(f"{path}: several columns have the name {min(twice)!r}; give each a name of its own")
    table = np.array(rows)
    return dict(zip(names, table.T)) if len(names) == table.shape[1] else _numbered(table)


def _numbered(table: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of a table without names; their keys are their numbers."""
    return {} if table.ndim != 2 else dict(zip(map(str, range(table.shape[1])), table.T))


def _value(cell: str) -> float:
    """Number in a cell; a date or a time of day is converted to seconds, an empty cell to NaN."""
    if not cell:
        return float("nan")
    if clock := re.fullmatch(r"(\d\d?):(\d\d):(\d\d(?:\.\d*)?)", cell):
        return 3600 * int(clock[1]) + 60 * int(clock[2]) + float(clock[3])
    try:
        return float(cell)
    except ValueError:
        if not re.match(r"\d{4}-\d\d-\d\d[T ]", cell):
            raise
        return int(np.datetime64(cell.rstrip("Z").replace(" ", "T"), "ns").astype(np.int64)) / 1e9


def _known(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rename columns to the names of `_NAMES` and convert them to seconds, metres and degrees.

    Columns with other names are not changed.
    """
    found: dict[str, np.ndarray] = {}
    for name, values in columns.items():
        text = re.sub(r"\s+", "_", name.strip().lower())
        parts = _COLUMN.fullmatch(text)
        unit = parts and (parts["unit"] or parts["suffix"])
        unit = unit if unit in _UNITS else unit and unit.removesuffix("s")
        plain, factor = (parts["name"].strip("_"), _UNITS[unit]) if parts and unit in _UNITS else (text, 1.0)
        known = next((key for key, names in _NAMES.items() if plain in names.split()), name)
        found.setdefault(known, values * factor if known != name or plain != text else values)
    return found
