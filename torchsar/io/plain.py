"""Arrays in text files and in files of numpy: a table of times and values, and a single array."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchsar.core import ArrayFile


def read_track(file: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a track of times in seconds and displacements in metres.

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
    if not path.is_file():
        raise ValueError(
            f"{path}: no such file; a measured track is a text, .csv, .npy or .npz file of times "
            "(s) and displacements (m)"
        )
    expected = f"{path}: expected two columns, time in s and displacement in m"
    try:
        if path.suffix not in (".npy", ".npz"):
            table = _text(path)
        else:
            stored = ArrayFile(path)
            if "" not in stored:
                return stored["time_s"].load("iuf"), stored["displacement_m"].load("iuf")
            table = stored[""].load("iuf")
    except (KeyError, OSError, ValueError) as problem:
        raise ValueError(f"{expected} (.npz: time_s and displacement_m), but {problem}") from None
    if table.ndim != 2 or table.shape[1] != 2:
        raise ValueError(f"{expected}, got an array of shape {table.shape}")
    return table[:, 0], table[:, 1]


def _text(path: Path) -> np.ndarray:
    """Numbers of a text file without its comments and its line of names."""
    plain = path.read_text().replace(",", " ").replace(";", " ").splitlines()
    lines = [line for line in plain if line.strip() and not line.lstrip().startswith("#")]
    try:
        return np.loadtxt(lines, ndmin=2)
    except ValueError:  # a line of names
        return np.loadtxt(lines[1:], ndmin=2)


def read_array(file: str | Path, key: str | None = None) -> np.ndarray:
    """Read an array of numbers from a .npy or .npz file.

    Args:
        file: Path of the file.
        key: Name of the array in an .npz file, not needed if it holds only one.

    Returns:
        The array, real or complex.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If the file holds no array of plain numbers with the name `key`, or several
            arrays and no `key` is given.
    """
    path = Path(file)
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the path of a .npy or .npz file")
    arrays = ArrayFile(path)
    name = next(iter(arrays)) if key is None and len(arrays) == 1 else key
    if name is None or name not in arrays:
        raise ValueError(
            f"{path} holds the arrays {list(arrays)}; give the name of one of them as key, got key={key!r}"
        )
    return arrays[name].load("biufc")
