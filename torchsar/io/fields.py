"""Fields of an archive of recorded data: checks before they are loaded, and the recording."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchsar.core import ArrayFile, Recording, StoredArray
from torchsar.radar import LIGHT_M_S

_ACCEPTED: dict[str, Callable[[float], bool]] = {
    "positive number": lambda x: x > 0,
    "number other than zero": bool,
    "whole number": float.is_integer,
}


class Described(NamedTuple):
    """What an archive holds, before its samples are loaded.

    Args:
        samples: The sample array.
        radar: Description of the instrument.
        aux: Side data by name, as for `Recording.from_arrays`.
        formed: Function that forms the matrix (pulse, range) of the samples, whole or some of the
            pulses.
    """

    samples: StoredArray
    radar: Any
    aux: dict[str, Any]
    formed: Callable[[np.ndarray], Tensor | np.ndarray]


def read_described(
    path: str | Path, dtype: torch.dtype, content: str, describe: Callable[[Mapping[str, StoredArray], Path], Described]
) -> Recording:
    """Read the recording in an archive of one kind.

    Args:
        path: Path of the archive.
        dtype: complex64 or complex128, dtype of the samples.
        content: What the archive should hold, for messages.
        describe: Function that checks the fields of such an archive.

    Returns:
        The recording.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not such an archive.
    """
    path = Path(path)
    found = describe(archive(path, content), path)
    with naming(path):
        data = found.formed(found.samples.load())
        return Recording.from_arrays(data, found.radar, dtype=dtype, what=str(path), **found.aux)


def refuse_absent(path: Path, wanted: str) -> None:
    """Check that a file exists.

    Args:
        path: Path of the file.
        wanted: What the file should be, for the message.

    Raises:
        FileNotFoundError: If there is no such file.
    """
    if not path.is_file():
        what = "is no file" if path.exists() else "does not exist"
        raise FileNotFoundError(f"{path} {what}; give the path of {wanted}")


def archive(path: Path, content: str) -> ArrayFile:
    """Open an archive of recorded data.

    Args:
        path: Path of the archive.
        content: What it should hold, for messages.

    Returns:
        Its fields by name, not loaded.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is not an archive.
    """
    refuse_absent(path, f"an .npz file with {content}")
    fields = ArrayFile(path)
    if "" in fields:
        raise ValueError(f"{path} must be a numpy archive (.npz) with {content}, but it holds a single array (.npy)")
    return fields


@contextmanager
def naming(what: str | Path) -> Iterator[None]:
    """Put the name of a file or a field before each ValueError that does not begin with it.

    Args:
        what: Path of the file, or path and name of the field.

    Yields:
        Nothing.
    """
    try:
        yield
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(str(what)) else f"{what}: {text}") from None


def refuse_missing(fields: Mapping[str, StoredArray], path: Path, keys: tuple[str, ...], kind: str) -> None:
    """Check that an archive has all keys that one of its kind must have.

    Args:
        fields: The fields of the archive.
        path: Path of the archive, for messages.
        keys: The required keys.
        kind: Kind of the archive, for messages.

    Raises:
        ValueError: If a key is missing.
    """
    missing = [key for key in keys if key not in fields]
    if missing:
        raise ValueError(
            f"{path} lacks the keys {missing}; {kind} must hold {list(keys)}, got the keys {sorted(fields)}"
        )


def number(field: StoredArray, accepted: str = "positive number") -> float:
    """Load one number.

    Args:
        field: The field.
        accepted: "positive number", "number other than zero" or "whole number".

    Returns:
        The number, which is finite.

    Raises:
        ValueError: If the field holds anything else.
    """
    real = field.shape == () and field.dtype.kind in "iuf"
    value = float(field.load()) if real else math.nan
    if not (math.isfinite(value) and _ACCEPTED[accepted](value)):
        raise ValueError(f"{field.what} must be one {accepted}, got {value if real else shown(field)}")
    return value


def vector(field: StoredArray, n: int) -> Tensor:
    """Load finite real numbers.

    Args:
        field: The field.
        n: How many numbers it must hold.

    Returns:
        The numbers, shape (n,), float64.

    Raises:
        ValueError: If the field holds anything else.
    """
    if field.shape != (n,) or field.dtype.kind not in "iuf":
        raise ValueError(f"{field.what} must be {n} finite real numbers, got {shown(field)}")
    value = field.load().astype(np.float64)
    if not np.isfinite(value).all():
        raise ValueError(f"{field.what} must be {n} finite real numbers, got NaN or Inf among them")
    return torch.from_numpy(value)


def shown(field: StoredArray) -> str:
    """Describe a field for messages.

    Args:
        field: The field.

    Returns:
        The values of a short field, the type and the shape of any other.
    """
    # largest number of bytes of values that are shown in a message
    short = len(field.shape) < 2 and field.dtype.itemsize * math.prod(field.shape) <= 64
    return repr(field.load().tolist()) if short else field.described


def complex_type(dtype: np.dtype) -> np.dtype:
    """Return the type of complex samples, of single precision if that holds the numbers exactly.

    Args:
        dtype: Type of the samples, or of their real and imaginary parts.

    Returns:
        complex64 or complex128.
    """
    return np.dtype(np.complex64 if np.result_type(dtype, np.complex64) == np.complex64 else np.complex128)


def joined(real: np.ndarray, imag: np.ndarray) -> np.ndarray:
    """Return complex samples with given real and imaginary parts.

    Args:
        real: Real parts.
        imag: Imaginary parts, of the same shape.

    Returns:
        The samples, of the type that `complex_type` gives.
    """
    samples = np.empty(real.shape, complex_type(np.result_type(real, imag)))
    samples.real, samples.imag = real, imag
    return samples


def parted(pairs: np.ndarray, order: str) -> list[np.ndarray]:
    """Part I and Q that follow each other in groups.

    Args:
        pairs: Numbers, (..., n, 2).
        order: A group, such as "iq" or "iiqq", whose number of i divides n.

    Returns:
        I and Q, each (..., n).

    Raises:
        ValueError: If the order is none.
    """
    i, q = ([at for at, one in enumerate(order.lower()) if one == kind] for kind in "iq")
    if not i or len(i) != len(q) or 2 * len(i) != len(order) or pairs.shape[-2] % len(i):
        raise ValueError(
            f"order must have as many i as q, such as iq, qi or iiqq, whose number divides that of the samples, "
            f"{pairs.shape[-2]}, got {order!r}"
        )
    groups = pairs.reshape(*pairs.shape[:-2], -1, len(order))
    return [groups[..., place].reshape(pairs.shape[:-1]) for place in (i, q)]


def likely_unit(value: float, low: float, high: float, units: Mapping[str, float]) -> str:
    """The end of a sentence about a value that is not plausible: the unit in which it would be.

    Args:
        value: The value.
        low: Least plausible value.
        high: Largest plausible value.
        units: Factors of units by name.

    Returns:
        The end of the sentence.
    """
    found = next((unit for unit, factor in units.items() if low <= value * factor <= high), None)
    return f"; if it is in {found}, say so or convert it" if found else "; check it"


def refuse_carrier(frequency_hz: Tensor, name: str) -> None:
    """Check the unit of frequencies by physics.

    Args:
        frequency_hz: Frequencies, (frequency,).
        name: Their name, for the message.

    Raises:
        ValueError: If the carrier is not that of a radar or ladar.
    """
    low, high = 1e6, 3e15  # limits in Hz; the wavelengths are 300 m and 100 nm
    carrier = float(frequency_hz.mean())
    if not low <= carrier <= high:
        unit = likely_unit(carrier, 1e8, 1e12, {"GHz": 1e9, "MHz": 1e6, "kHz": 1e3, "THz": 1e12})
        raise ValueError(f"{name} is {carrier:.4g} Hz in the middle, and should be {low:g} to {high:g} Hz{unit}")


def refuse_implausible(frequency_hz: Tensor, position_m: Tensor, reference_m: Tensor, names: tuple[str, str]) -> None:
    """Check the unit of the positions of a phase history by physics.

    Args:
        frequency_hz: Frequencies, (frequency,).
        position_m: Positions of the moving antenna, (pulse, 3).
        reference_m: Reference ranges, (pulse,).
        names: Names of positions and reference ranges for messages.

    Raises:
        ValueError: If distance from the origin and reference range differ by a factor of 1000, or
            if the whole path is shorter than a quarter of a wavelength.
    """
    distance = float(torch.linalg.vector_norm(position_m, dim=-1).median())
    reference, extent = float(reference_m.median()), position_m.amax(0) - position_m.amin(0)
    ratio = reference / distance if distance > 0 else 0.0
    # in the same unit, a path and its reference range differ by some percent
    for factor, of, other in ((1e3, *names), (1e-3, *reversed(names))):
        # up to a factor of 2 because a one-way range may be given instead of the whole path
        if 0.4 * factor < ratio < 2.5 * factor:
            near, far = (distance, reference) if factor > 1 else (reference, distance)
            raise ValueError(
                f"{of} has a distance of {near:.4g} m, and {other} one of {far:.4g} m, about 1000 times as much; {of} "
                "is probably in km, say so or convert it"
            )
    wavelength = LIGHT_M_S / float(frequency_hz.mean())
    if 0 < float(extent.norm()) < wavelength / 4:
        middle = position_m.mean(0).tolist()
        degrees = abs(middle[0]) <= 90 and abs(middle[1]) <= 180 and abs(middle[2]) > 100
        likely = (
            "latitude and longitude in degrees in place of metres, give origin_deg_m and geocentric metres"
            if degrees
            else "in km"
        )
        raise ValueError(
            f"{names[0]} moves by {float(extent.norm()):.3g} m over all pulses, less than a quarter of the wavelength "
            f"of {wavelength:.3g} m, about {', '.join(f'{x:.6g}' for x in middle)}; it is probably {likely}"
        )


class Level:
    """Mean and standard deviation of samples that are added in blocks, to detect an offset of I or
    Q.
    """

    def __init__(self) -> None:
        self._moments = np.zeros(4)

    def add(self, samples: np.ndarray) -> None:
        """Add the moments of a block of complex samples."""
        i, q = (part.astype(np.float64) for part in (np.real(samples), np.imag(samples)))
        self._moments += np.array([i.size, i.sum(), q.sum(), np.vdot(i, i) + np.vdot(q, q)])

    def warn(self, what: str, key: str) -> None:
        """Warn of a mean above half the standard deviation, which the samples of a receiver do not
        have.

        The message advises the user to set `key`, which removes the offset.
        """
        n, *sums, square = self._moments.tolist()
        i, q = (x / n for x in sums)
        deviation = math.sqrt(max(square / n - i**2 - q**2, 0) / 2)
        if max(abs(i), abs(q)) > deviation / 2:
            warnings.warn(
                f"{what}: samples have a mean of I {i:.4g} and Q {q:.4g} and a standard deviation of {deviation:.3g}; "
                f"if this is the offset of numbers without sign, give its exact value, about {(i + q) / 2:.3g}, as "
                f"{key}",
                stacklevel=2,
            )
