"""Import of recorded data in the formats of other programs, which a sidecar describes.

A sidecar is a small YAML file, or a mapping in Python, that says where the samples and the numbers
of the radar are. The result is an archive (.npz) for `read_stripmap`, `read_inverse` or
`read_path`.
"""

from __future__ import annotations

import math
import re
import shutil
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchsar.core import Recording, StoredArray
from torchsar.io.containers import Container, flat_array, open_container
from torchsar.io.extras import write_whole
from torchsar.io.fields import Described, Level, complex_type, joined, naming, parted
from torchsar.io.history import describe_inverse, describe_path
from torchsar.io.strip import describe_stripmap, offset_of
from torchsar.spelling import did_you_mean

# size in bytes of a block of complex samples, large enough for fast reading
_BLOCK_BYTES = 32 << 20


class _Kind(NamedTuple):
    """Description of a kind of sample array.

    Fields: `dims` has its dims. `radar` has the keys of the radar parameters with their units.
    `side` has the keys of side arrays, each with its unit and the dim that gives its length.
    `describe` checks the archive.
    """

    dims: tuple[str, str]
    radar: dict[str, str]
    side: dict[str, tuple[str, str]]
    describe: Callable[[Mapping[str, StoredArray], Path], Described]


_PRF, _FREQUENCY = {"prf_hz": "Hz"}, {"freq_hz": ("Hz", "frequency")}
# kinds of sample arrays that the readers accept, by the key of the samples
_KINDS = {
    "iq": _Kind(
        ("pulse", "range"),
        {
            **{"fs_hz": "Hz", "prf_hz": "Hz", "f0_hz": "Hz", "chirp_rate_hz_s": "Hz/s", "pulse_s": "s"},
            **{"slant_range_cell1_m": "m", "v_eff_m_s": "m/s", "first_cell": "", "c_m_s": "m/s", "integration_s": "s"},
        },
        {
            **{"agc_db": ("dB", "pulse"), "line_number": ("", "pulse"), "line_time_s": ("s", "pulse")},
            "pilot": ("", "range"),
        },
        describe_stripmap,
    ),
    "profiles": _Kind(
        ("range", "pulse"),
        {"range_step_m": "m", "bandwidth_hz": "Hz", "prf_hz": "Hz", "f0_hz": "Hz"},
        {},
        describe_inverse,
    ),
    "sig": _Kind(("frequency", "pulse"), _PRF, {**_FREQUENCY, "angle_deg": ("deg", "pulse")}, describe_inverse),
    "fp": _Kind(
        ("frequency", "pulse"),
        _PRF,
        {**_FREQUENCY, **dict.fromkeys(("x_m", "y_m", "z_m", "r0_m"), ("m", "pulse"))},
        describe_inverse,
    ),
    "history": _Kind(
        ("frequency", "pulse"),
        _PRF,
        {
            **_FREQUENCY,
            **{"transmitter_m": ("m", ""), "receiver_m": ("m", ""), "path_reference_m": ("m", "pulse")},
            **{"pulse_time_s": ("s", "pulse"), "transmitter_time_s": ("s", ""), "receiver_time_s": ("s", "")},
            "origin_deg_m": ("", ""),
        },
        describe_path,
    ),
}
_SYSTEMS = {"stripmap": ("iq",), "isal": ("profiles", "sig", "fp"), "path": ("history", "fp")}
# accepted units for each unit of a key, with the factors of conversion
_UNITS = {
    "Hz": {"Hz": 1.0, "kHz": 1e3, "MHz": 1e6, "GHz": 1e9, "THz": 1e12},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "ps": 1e-12},
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9},
    "m/s": {"m/s": 1.0, "km/s": 1e3, "km/h": 1 / 3.6},
    "Hz/s": {"Hz/s": 1.0, "kHz/s": 1e3, "MHz/s": 1e6, "GHz/s": 1e9, "THz/s": 1e12, "kHz/us": 1e9, "MHz/us": 1e12},
    "deg": {"deg": 1.0, "rad": 180 / math.pi},
    "dB": {"dB": 1.0},
}
# keys of sidecars for the names that the same numbers have in Python
_PYTHON_NAMES = {
    **{"carrier_hz": "f0_hz", "sampling_hz": "fs_hz", "velocity_m_s": "v_eff_m_s"},
    **{"near_range_m": "slant_range_cell1_m", "frequency_hz": "freq_hz", "reference_m": "path_reference_m"},
}
_WITH_UNIT = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?) *([A-Za-z/]+)")
_DTYPES = (
    *("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "float16", "float32", "float64"),
    *("complex64", "complex128"),
)
# accepted keys of a section, each with the type of its value and with this type in words
_Keys = Mapping[str, tuple[Any, str]]
_BYTES = (int, "a number of bytes")
_FLAT: _Keys = {
    "dtype": (str, "the name of a type"),
    "byte_order": (str, "little or big"),
    **dict.fromkeys(("header_bytes", "line_prefix_bytes", "line_suffix_bytes"), _BYTES),
    "shape": ((list, tuple), "a list of numbers of at least 1"),
}
_NAMED: _Keys = {"name": (str, "the name of an array in the file")}
_SAMPLES: _Keys = {
    **_NAMED,
    "key": (str, "the name of the sample array in the archive"),
    "dims": ((list, tuple), "the dims of the array in the order of the file"),
    "choose": (Mapping, "a mapping of further dims to the index to read, counted from 0"),
    "imag": (str, "the name of an array or file"),
    "order": (str, "a group of I and Q as they follow each other in the file, such as iq or iiqq"),
    "table": (str, "the name of an array in the file, of which samples are indices"),
    "offset": ((int, float, list, tuple), "a number that I and Q exceed their true values by, or one for each"),
    "conjugate": (bool, "true or false"),
    **_FLAT,
}
_ENTRY: _Keys = {
    **_NAMED,
    "file": (str, "the name of a file"),
    "unit": (str, "a unit"),
    "transpose": (bool, "true or false"),
    **dict.fromkeys(("first", "step"), ((int, float), "a number")),
    **_FLAT,
}
_SECTIONS: _Keys = {
    "system": (str, "stripmap, isal or path"),
    **dict.fromkeys(("samples", "radar", "side"), (Mapping, "a mapping")),
}


def import_recording(path: str | Path, sidecar: Mapping[str, Any], out: str | Path, name: str = "sidecar") -> Path:
    """Write recorded data of another format as an archive for the readers of this package.

    >>> import numpy, pathlib, tempfile
    >>> from torchsar import io
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "raw.npz"
    >>> numpy.savez(path, echo=numpy.ones((4, 8), "complex64"))
    >>> sidecar = {
    ...     "system": "isal",
    ...     "samples": {"key": "profiles", "name": "echo", "dims": ["pulse", "range"]},
    ...     "radar": {"range_step_m": 0.3, "bandwidth_hz": 5e8, "prf_hz": 200, "f0_hz": "10 GHz"},
    ... }
    >>> io.read(io.import_recording(path, sidecar, path.with_name("new.npz"))).radar.carrier_hz
    10000000000.0

    The data are in an HDF5 file, a MATLAB file (5 to 7.3), a numpy file, or in flat binary form.
    The sidecar has these sections:
    - `system`: stripmap, isal or path.
    - `samples`: where the samples are. `key` is the name of the sample array in the archive, which
      says what the data are: `iq` (stripmap), `profiles`, `sig` or `fp` (isal), `history` or `fp`
      (path). `name` is the name of the array in the file. `dims` has the names of the dimensions
      of this array in the order of the file: `pulse` and `range` or, for `sig`, `fp` and `history`,
      `pulse` and `frequency`, and `iq` for a dimension with real and imaginary part. `imag` is the
      name of a second array (or flat binary file) with the imaginary part. `conjugate: true` is for
      data with the phases exp(+2j pi f tau). Further dims have any name, and `choose`, such as
      `{receiver: 0}`, says which of them is read. `order` is the order of I and Q along the last
      dim iq where it is not I Q I Q, such as `iiqq`. `offset` is subtracted from I and Q, as 15.5
      of samples of 5 bits without sign or 127.5 of bytes, and `table` is the array of the values
      that samples are indices of.
    - `radar`: numbers by the keys that the reader takes, such as `prf_hz`.
    - `side`: arrays by the keys that the reader takes, such as `freq_hz`.
    A number or array is given by a number, a list, a text like `9.65 GHz`, the name of an array in
    the file, or a mapping with `name`, `unit` (of the numbers in the file), `file` (another file,
    relative to the folder of the data) and `transpose`, or with `first` and `step` of numbers in
    equal steps. For flat binary files `dtype`, `byte_order` (little or big), `header_bytes` and
    `shape` take the place of `name`; `line_prefix_bytes` and `line_suffix_bytes` are those before
    and after each entry of the first dim, such as the headers of lines. A file with one array
    needs no `name`.

    All keys are checked before samples are read. Samples are read and written in blocks of 32 MiB
    (or of one line, if it is longer): less than 256 MiB and the side arrays are in memory at a
    time. Only from a MATLAB 5 or a compressed numpy file all samples are read at once.

    Args:
        path: Path of the data.
        sidecar: Content of the sidecar.
        out: Path of the new archive, which must not exist.
        name: Name of the sidecar, for messages.

    Returns:
        The path of the archive, whose samples are complex64, or complex128 where that is needed to
        hold them exactly.

    Raises:
        FileNotFoundError: If a file does not exist.
        FileExistsError: If `out` exists.
        ValueError: If the sidecar or a file is invalid, or a sample is not finite. Nothing is
            written then.
        ModuleNotFoundError: If the library of the format is not installed.
    """
    path, out, name = Path(path), Path(out), str(Path(name))
    if out.suffix != ".npz":
        raise ValueError(f"{out}: the name of the new archive must end in .npz")
    if out.exists() or out.is_symlink():
        raise FileExistsError(f"{out} exists and is not replaced; move it, or choose another name")
    tree = _section(sidecar, name, _SECTIONS)
    keys = _SYSTEMS[_choice(tree.get("system"), f"{name}: system", _SYSTEMS)]
    layout = _section(tree.get("samples"), f"{name}: samples", _SAMPLES, ("dims",))
    key = _choice(layout.get("key", keys[0] if "profiles" not in keys else None), f"{name}: samples.key", keys)
    kind = _KINDS[key]
    with ExitStack() as stack:
        file = _File(path, cache(partial(open_container, stack=stack)))
        samples, slow, unsigned = _samples(file, layout, f"{name}: samples", kind.dims)
        turned = slow != kind.dims[0]
        shape = samples.shape[::-1] if turned else samples.shape
        lengths, arrays, stored = dict(zip(kind.dims, shape, strict=True)), {}, {}
        sections = {"radar": {one: (unit, "") for one, unit in kind.radar.items()}, "side": kind.side}
        for section, known in sections.items():
            where, held = f"{name}: {section}", tree.get(section)
            accepted = dict.fromkeys(known, (object, ""))
            for one, value in _section({} if held is None else held, where, accepted).items():
                unit, along = known[one]
                x = _value(file, value, f"{where}.{one}", unit, lengths.get(along))
                arrays[one] = x = x.reshape(()) if section == "radar" and x.size == 1 else x
                stored[one] = _stored(f"{where}.{one}", x)
        stored[key] = StoredArray(f"{name}: samples", shape, samples.dtype, samples.part)
        found = kind.describe(stored, Path(name))
        # adds the name of the sidecar to errors of side data that are only checked when a recording
        # is made
        with naming(name):
            lines = torch.ones(lengths["pulse"], 1, dtype=torch.complex64)
            Recording.from_arrays(lines, found.radar, what=name, **found.aux)
        level = Level()
        write_whole(out, lambda part: _write(part, key, samples, slow, turned, arrays, level))
    # no check of a signed phase history, in which a target may cause a constant
    if key == "iq" or unsigned:
        level.warn(samples.what, f"{name}: samples.offset")
    return out


class _File(NamedTuple):
    """Path of the data file, and a function that opens this or another file only once."""

    path: Path
    opened: Callable[[Path], Container | None]


def _samples(file: _File, tree: Mapping[str, Any], where: str, order: tuple[str, str]) -> tuple[StoredArray, str, bool]:
    """Combine the sample arrays in the file into one complex array in the order of the file.

    Returns the array, the name of its slow dim, which is its first one, and whether the stored
    numbers are unsigned.
    """
    dims, choose = [str(one) for one in tree["dims"]], dict(tree.get("choose", {}))
    further, pair = [one for one in dims if one not in (*order, "iq")], "iq" in dims
    if not {*order} <= {*dims} or len({*dims}) < len(dims):
        raise ValueError(
            f"{where}.dims must be the dims of the array in the order of the file, {order[0]} and {order[1]}, iq if "
            f"there is one for real and imaginary part, and further ones of which choose names one index, got "
            f"{list(tree['dims'])}"
        )
    parts = [_array(file, file.path, tree, where)]
    if "imag" in tree:
        flat = "dtype" in tree
        path, held = (file.path.parent / tree["imag"], tree) if flat else (file.path, {"name": tree["imag"]})
        parts.append(_array(file, path, held, where))
    shape, kinds = dict(zip(dims, parts[0].shape)), {part.dtype.kind for part in parts}
    for part in parts:
        if part.shape != parts[0].shape or len(part.shape) != len(dims) or 0 in part.shape:
            raise ValueError(f"{part.what} has the shape {part.shape}, and {where}.dims are {dims}")
    for one in (*further, *choose):
        index = choose.get(one, 0 if shape.get(one) == 1 else None)
        if one not in further or type(index) is not int or not 0 <= index < shape[one]:
            lengths = {one: shape[one] for one in further}
            raise ValueError(
                f"{where}.choose must name one index, from 0, for each further dim of {lengths}, got {choose}; write "
                "for instance " + ("choose: {" + ", ".join(f"{one}: 0" for one in further) + "}" if further else "none")
            )
        choose[one] = index
    if pair and (shape["iq"] != 2 or "c" in kinds):
        raise ValueError(
            f"{where}.dims: the dim iq must have 2 real numbers, got {parts[0].dtype.name} of shape "
            f"{parts[0].shape} for the dims {dims}"
        )
    if pair + len(parts) != 1 + ("c" not in kinds) or (len(parts) == 2 and "c" in kinds):
        raise ValueError(
            f"{where}: samples must be complex, or real with one dim iq or one array imag, got "
            f"{parts[0].dtype.name} with the dims {dims}{' and imag' if len(parts) == 2 else ''}"
        )
    slow = next(one for one in dims if one in order)
    turn, offset = (
        _order(tree, where, dims, shape, slow),
        offset_of(_stored(f"{where}.offset", _numbers(tree.get("offset", 0), f"{where}.offset", ""))),
    )
    table = None if "table" not in tree else _array(file, file.path, {"name": tree["table"]}, where).load().ravel()
    if table is not None and not kinds <= {"i", "u"}:
        raise ValueError(f"{where}.table: samples must be whole numbers, indices of it, got {parts[0].dtype.name}")

    def complex_part(slices: tuple[slice, ...]) -> np.ndarray:
        index = {**{one: slice(i, i + 1) for one, i in choose.items()}, slow: slices[0]}
        held = [part.read(tuple(index.get(one, slice(None)) for one in dims)) for part in parts]
        if table is not None and any(x.min() < 0 or x.max() >= len(table) for x in held):
            ends = [(int(x.min()), int(x.max())) for x in held]
            raise ValueError(f"{where}.table has {len(table)} entries, and samples are from and to {ends}")
        held = held if table is None else [table[x] for x in held]
        real_imag = turn(held[0]) if pair else held
        block = joined(*real_imag) if len(real_imag) == 2 and "c" not in kinds else held[0]
        left = [one for one in dims if one != "iq"]
        block = block.squeeze(tuple(left.index(one) for one in further)) - offset
        return np.conj(block) if tree.get("conjugate", False) else block

    types = (part.dtype if table is None else table.dtype for part in parts)
    lengths = tuple(shape[one] for one in dims if one in order)
    dtype = complex_type(np.result_type(*types))
    found = StoredArray(parts[0].what, lengths, dtype, complex_part)
    return found, slow, kinds == {"u"}


def _order(
    tree: Mapping[str, Any], where: str, dims: list[str], shape: Mapping[str, int], slow: str
) -> Callable[[np.ndarray], Sequence[np.ndarray]]:
    """Function that separates I and Q according to their order in the file."""
    order, before = tree.get("order", "iq"), dims[-2]
    if "iq" not in dims and "order" in tree:
        raise ValueError(f"{where}.order is for samples with a dim iq, got the dims {dims}")
    if len(order) != 2 and (dims[-1] != "iq" or before == slow or before in tree.get("choose", {})):
        raise ValueError(f"{where}.order {order!r} needs iq as the last dim, after the fast one, got {dict(shape)}")
    with naming(f"{where}.order"):
        parted(np.empty((shape[before], 2)), order)
    return lambda x: parted(np.moveaxis(x, dims.index("iq"), -1), order)


def _stored(what: str, array: np.ndarray) -> StoredArray:
    """An array in memory, for the functions that check arrays in files."""
    return StoredArray(what, array.shape, array.dtype, array.__getitem__)


def _array(file: _File, path: Path, tree: Mapping[str, Any], where: str) -> StoredArray:
    """Find the array that `name` or the layout of a flat binary file describes."""
    container = file.opened(path)
    flat = [key for key in _FLAT if key in tree]
    if container is not None:
        if flat:
            raise ValueError(f"{where}.{flat[0]}: {path} is a {container.kind} file; give name instead")
        with naming(where):
            return container.array(tree.get("name"))
    if "name" in tree or not flat:
        raise ValueError(
            f"{where}: {path} is no HDF5, MATLAB, numpy or .csv file; if it is flat binary, give dtype and shape, and "
            "no name"
        )
    dtype = np.dtype(_choice(tree.get("dtype"), f"{where}.dtype", _DTYPES))
    order = _choice(tree.get("byte_order", "little"), f"{where}.byte_order", ("little", "big"))
    shape = tree.get("shape")
    spare = [tree.get(key, 0) for key in ("header_bytes", "line_prefix_bytes", "line_suffix_bytes")]
    if not shape or not all(type(n) is int and n > 0 for n in shape) or min(spare) < 0:
        raise ValueError(
            f"{where}: shape must be a list of numbers of at least 1, and numbers of bytes at least 0, got {shape!r} "
            f"and {spare}"
        )
    with naming(where):
        return flat_array(path, dtype.newbyteorder("<" if order == "little" else ">"), tuple(shape), *spare)


def _value(file: _File, value: Any, where: str, own: str, n: int | None) -> np.ndarray:
    """Load the numbers of a key and convert them to its unit.

    own: unit of the key. n: expected count of numbers, or None if it is not the length of a dim.
    """
    unit = None
    if isinstance(value, str):
        match = _WITH_UNIT.fullmatch(value.strip())
        value, unit = (float(match[1]), match[2]) if match else ({"name": value}, None)
    if isinstance(value, Mapping):
        steps = {"first", "step"} & set(value)
        tree = _section(value, where, _ENTRY, ("first", "step") if steps else ())
        unit, path = tree.get("unit"), file.path.parent / tree["file"] if "file" in tree else file.path
        array = _steps(tree, where, n) if steps else _array(file, path, tree, where).load()
        array = array.T if tree.get("transpose", False) else array
    else:
        array = _numbers(value, where, own)
    # MATLAB stores numbers and vectors as matrices
    array = array.reshape(-1) if array.size == max(array.shape, default=0) else array
    if unit in (None, own):
        return array
    accepted = _UNITS.get(own, {})
    if unit not in accepted:
        expected = f"{own} is expected" if own else "numbers without a unit are expected"
        raise ValueError(f"{where} has the unit {unit!r}, and {expected}{did_you_mean(unit, accepted)}")
    return array.astype(np.float64) * accepted[unit]


def _section(tree: Any, where: str, accepted: _Keys, needed: Sequence[str] = ()) -> dict[str, Any]:
    """Check the keys of a mapping and the types of its values.

    Raises ValueError if a needed key is missing, a key is not accepted, or a value has the wrong
    type.
    """
    if not isinstance(tree, Mapping):
        got = "nothing" if tree is None else repr(tree)
        raise ValueError(f"{where} must be a mapping with some of the keys {', '.join(accepted)}, got {got}")
    for key, value in tree.items():
        if key not in accepted:
            hint = did_you_mean(_PYTHON_NAMES.get(key, str(key)), accepted)
            raise ValueError(f"{where}: key {key!r} is not known{hint}")
        kind, words = accepted[key]
        if (
            words
            and value is not None
            and (
                not isinstance(value, kind)
                or (isinstance(value, bool) and kind is not bool)
                or (isinstance(value, int) and abs(value) >= 2**63)
            )
        ):
            raise ValueError(f"{where}.{key} must be {words}, got {value!r}")
    for key in needed:
        if tree.get(key) is None:
            raise ValueError(f"{where} lacks the key {key!r}, {accepted[key][1]}")
    return {key: value for key, value in tree.items() if value is not None}


def _numbers(value: Any, where: str, unit: str) -> np.ndarray:
    """Convert numbers that are written in the sidecar to an array."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists have different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"{where} must be numbers{f' in {unit}' if unit else ''}, a text such as '9.65 GHz', or the name of an "
            f"array, got {value!r}"
        )
    return array


def _steps(tree: Mapping[str, Any], where: str, n: int | None) -> np.ndarray:
    """Numbers in equal steps, as many as the length of a dim of the samples."""
    other = sorted(set(tree) - {"first", "step", "unit"})
    if n is None or other:
        what = f"{other[0]} is given too" if other else "this key has no length of its own"
        raise ValueError(f"{where}: first and step cannot be used here, since {what}; give the name of an array")
    return tree["first"] + tree["step"] * np.arange(n, dtype=np.float64)


def _choice(value: Any, where: str, accepted: Sequence[str] | Mapping[str, Any]) -> str:
    """Check that a value is one of the accepted words."""
    if not isinstance(value, str) or value not in accepted:
        got = "is missing" if value is None else f"has the value {value!r}"
        raise ValueError(f"{where} {got}{did_you_mean(str(value), accepted)}")
    return value


def _write(
    path: Path,
    key: str,
    samples: StoredArray,
    slow: str,
    turned: bool,
    arrays: Mapping[str, np.ndarray],
    level: Level,
) -> None:
    """Write the archive; the samples are stored in the order of the source file, (slow, fast).

    `turned` says that the slow dim is the second one of the array in the archive. The array is then
    stored in Fortran order.
    """
    needed, free = math.prod(samples.shape) * samples.dtype.itemsize, shutil.disk_usage(path.parent).free
    if needed > free:
        raise ValueError(
            f"{samples.what} becomes an archive of {needed / 1e9:.3g} GB, and {free / 1e9:.3g} GB are free in "
            f"{path.parent}; make room, or choose another folder"
        )
    with zipfile.ZipFile(path, "x") as archive:
        for name, array in arrays.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
        with archive.open(zipfile.ZipInfo(f"{key}.npy"), "w", force_zip64=True) as member:
            shape = samples.shape[::-1] if turned else samples.shape
            np.lib.format.write_array_header_2_0(
                member, {"descr": samples.dtype.str, "fortran_order": turned, "shape": shape}
            )
            rows = max(1, _BLOCK_BYTES // (samples.shape[1] * samples.dtype.itemsize))
            for first in range(0, samples.shape[0], rows):
                block = samples.read((slice(first, first + rows),))
                bad = int((~np.isfinite(block)).sum())
                if bad:
                    raise ValueError(
                        f"{samples.what}: {bad} samples are NaN or Inf at indices {first} to {first + len(block) - 1} "
                        f"of the dim {slow!r}; set missing samples to zero"
                    )
                level.add(block)
                member.write(np.ascontiguousarray(block).data)
