"""Arrays in text files and in files of numpy: a table of times and values, and a single array."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchsar.core import ArrayFile
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
