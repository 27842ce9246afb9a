"""Plain numbers in files: a table of times and values, a single array, and a cloud of points."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from torchsar.core import ArrayFile
from torchsar.core.stored import refuse_beyond_memory
from torchsar.io.containers import open_container
from torchsar.io.extras import library, reading
from torchsar.io.fields import refuse_absent
from torchsar.radar.track import read_table


def measured_displacement(file: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read times in seconds and displacements in metres.

    Args:
        file: Text or .csv file of two columns (separated by commas or blanks, a line of names is
            allowed), .npy file of shape (n, 2), or .npz file with `time_s` (n,) and
            `displacement_m` (..., n).

    Returns:
        Times, shape (n,), and displacements, shape (n,) or (..., n).

    Raises:
        ValueError: If the file does not exist or holds anything else; the message names the file.
    """
    path = Path(file)
    expected = f"{path}: expected two columns, time in s and displacement in m"
    try:
        stored = ArrayFile(path) if path.suffix == ".npz" else {}
        if "" not in stored and "displacement_m" in stored:
            return stored["time_s"].load("iuf"), stored["displacement_m"].load("iuf")
        columns = list(read_table(path).values())
    except (KeyError, OSError, ValueError) as problem:
        raise ValueError(f"{expected} (.npz: time_s and displacement_m), but {problem}") from None
    if len(columns) != 2:
        raise ValueError(f"{expected}, got {len(columns)} columns")
    return columns[0], columns[1]


def read_array(file: str | Path, key: str | None = None) -> np.ndarray:
    """Read one array of numbers, such as an image, from a file.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar import io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "image.npy"
    >>> numpy.save(path, [[0.0, 1.0], [2.0, 3.0]])
    >>> io.read_array(path).shape
    (2, 2)

    Args:
        file: Path of a .npy, .npz, HDF5 or MATLAB file, of a table of numbers (.csv, .txt), or of a
            picture (PNG, TIFF, JPEG). The lowest row of a picture becomes the first one of the
            array, since figures show images with their first line at the bottom; colours become
            their brightness.
        key: Name of the array in a file of several arrays.

    Returns:
        The array, real or complex.

    Raises:
        FileNotFoundError: If the file does not exist.
        ModuleNotFoundError: If the library of the format is not installed.
        ValueError: If the file is damaged, holds no array of plain numbers with the name `key`, or
            several arrays and no `key` is given.
    """
    path = Path(file)
    with ExitStack() as stack:
        held = open_container(path, stack)
        if held is None:
            pillow = library("PIL.Image", "study", f"reading {path}")
            with reading(path, "an array or a picture"):
                picture = stack.enter_context(pillow.open(path))
                refuse_beyond_memory(str(path), picture.size[::-1], np.dtype(np.float64))
                grey = picture if len(picture.getbands()) == 1 and picture.mode != "P" else picture.convert("L")
                return np.asarray(grey, np.float64)[::-1].copy()
        if held.kind == "table" and key is None:
            return np.stack(list(read_table(path).values()), -1)
        return held.array(key).load()


def read_points(
    file: str | Path, axes: Sequence[str] | None = None, scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read a cloud of points from a table, or the vertices of a mesh.

    >>> import pathlib, tempfile
    >>> from torchsar import io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "points.csv"
    >>> _ = path.write_text("azimuth_m,range_m,amplitude\\n0,10,1\\n5,20,2\\n")
    >>> place_m, amplitude = io.read_points(path)
    >>> place_m.tolist(), amplitude.tolist()
    ([[0.0, 10.0], [5.0, 20.0]], [1.0, 2.0])

    Args:
        file: Path of a table (.csv, text, .npy, or .npz with one array per column), or of a mesh
            (.ply, .obj), whose vertices have the columns x, y and z. A table without names has the
            columns 0, 1, ... A column may have the ending `_m`. The column `amplitude`, if there is
            one, holds the amplitudes.
        axes: Columns of azimuth (or cross range) and range, and of height if wanted; by default
            `azimuth`, `range` and, if there is one, `height`.
        scale: Length of one unit of the file in metres.

    Returns:
        Places in metres, shape (point, 2) or (point, 3), and amplitudes (point,), None if the file
        has none.

    Raises:
        FileNotFoundError: If the file does not exist.
        ModuleNotFoundError: If trimesh, which reads meshes, is not installed (extra `formats`).
        ValueError: If the file is damaged, lacks a column, or holds no points or numbers that are
            not finite.
    """
    path = Path(file)
    columns = {name.removesuffix("_m"): x for name, x in _columns(path).items()}
    wanted = [name.removesuffix("_m") for name in axes or ("azimuth", "range", *({"height"} & {*columns}))]
    if len(wanted) not in (2, 3) or not all(name in columns for name in wanted):
        raise ValueError(
            f"{path} has the columns {', '.join(columns) or '(none)'}, and axes must name those of azimuth and range, "
            f"and of height if wanted, got {', '.join(wanted)}; write for example axes: [{', '.join([*columns][:2])}]"
        )
    used = [columns[name] for name in (*wanted, *({"amplitude"} & {*columns}))]
    if len({len(x) for x in used}) != 1 or not len(used[0]) or not all(np.isfinite(x).all() for x in used):
        raise ValueError(
            f"{path} must hold one point or more with finite numbers in columns of one length, got "
            f"{', '.join(f'{np.isfinite(x).sum()} finite of {len(x)}' for x in used)}"
        )
    return scale * np.stack(used[: len(wanted)], -1), used[len(wanted)] if len(used) > len(wanted) else None


def _columns(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a table, or the coordinates of the vertices of a mesh."""
    refuse_absent(path, "a file of points")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("ply", "obj"):
        return read_table(path)
    trimesh = library("trimesh", "formats", f"reading {path}")
    with reading(path, "a mesh"), path.open("rb") as file:
        mesh = trimesh.load(file, file_type=kind, process=False, maintain_order=True)
        return dict(zip("xyz", np.asarray(getattr(mesh, "vertices", np.empty((0, 3))), np.float64).T, strict=True))
