"""Store of the arrays of a run, arrays.zarr."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Axis, Signal
from torchsar.core.stored import refuse_beyond_memory
from torchsar.io.extras import library, reading
from torchsar.io.seal import files_checksum, group_attributes, plain_files, sealed

# chunks of zeros are written as well, so that a missing chunk is known to be lost
WRITE_ALL = {"write_empty_chunks": True}


def write_arrays(
    path: Path, images: Mapping[str, Signal], truth: Mapping[str, Tensor], estimates: Mapping[str, Mapping[str, Tensor]]
) -> None:
    """Write a zarr store of version 3: `METHOD/image` with its axes, `truth/NAME`, and
    `estimate/METHOD/STAGE.VALUE`.

    Args:
        path: Folder of the store.
        images: Images without trials, by path of their group.
        truth: True values by name.
        estimates: Estimates by method and name.

    Raises:
        ModuleNotFoundError: If zarr is not installed (extra `study`).
    """
    root = library("zarr", "study", f"writing {path}").open_group(str(path), mode="w", zarr_format=3)
    for name, signal in images.items():
        group = root.create_group(name)
        for axis in signal.axes:
            put(group, axis.name, axis.values(), (axis.name,), unit=axis.unit, step=axis.step)
        put(group, "image", signal.data, signal.names, unit="1")
    if truth:
        group = root.create_group("truth")
        for name, value in truth.items():
            put(group, name, value)
    if any(estimates.values()):
        group = root.create_group("estimate")
        for method, values in estimates.items():
            inner = group.create_group(method)
            for name, value in values.items():
                put(inner, name, value)
    seal_files(root, Path(path))


def read_images(path: str | Path) -> dict[str, Signal]:
    """Read the images in the store of a run.

    >>> import tempfile, torch
    >>> from torchsar import Axis, Signal, io
    >>> from torchsar.io.arrays import write_arrays
    >>> axes = Axis("azimuth", 8, 0.0, 2.0, "m"), Axis("range", 4, 9000.0, 3.0, "m")
    >>> write_arrays(path := tempfile.mkdtemp(), {"rda": Signal(torch.ones(8, 4), axes)}, {}, {})
    >>> {method: image.names for method, image in io.read_images(path).items()}
    {'rda': ('azimuth', 'range')}

    Args:
        path: Folder of the store, arrays.zarr in the folder of a run.

    Returns:
        Images by path of their group, METHOD or CASE/METHOD, with their axes.

    Raises:
        FileNotFoundError: If there is no such store.
        ModuleNotFoundError: If zarr is not installed (extra `study`).
        ValueError: If any file of the store is damaged, missing or no plain file.
    """
    path = Path(path)
    if not (path / "zarr.json").is_file():
        raise FileNotFoundError(f"{path} holds no images; give the store of a run, arrays.zarr in its folder")
    zarr = library("zarr", "study", f"reading {path}")
    with reading(path, "the arrays of a run"):
        refuse_changed_files(path)
        return dict(_images(zarr, zarr.open_group(str(path), mode="r"), ""))


def _images(zarr: Any, group: Any, name: str) -> Iterator[tuple[str, Signal]]:
    """Yield the names and the images of a group and of all groups below it."""
    image = group.get("image")
    if isinstance(image, zarr.Array):
        refuse_missing_chunks(image)
        refuse_beyond_memory(image.name, image.shape, image.dtype)
        yield name, Signal(torch.from_numpy(image[...]), axes_of(group, image))
    for below, inner in sorted(group.groups()):
        yield from _images(zarr, inner, f"{name}/{below}".strip("/"))


def axes_of(group: Any, image: Any) -> tuple[Axis, ...]:
    """Return the axes of an image.

    Args:
        group: Open zarr group with the coordinates of the axes.
        image: Array of the group.

    Returns:
        The axes, in the order of the dimensions.
    """
    held = [(name, group[name]) for name in image.metadata.dimension_names]
    return tuple(Axis(name, x.shape[0], float(x[0]), float(x.attrs["step"]), str(x.attrs["unit"])) for name, x in held)


def seal_files(root: Any, path: Path, free: str = "", **attributes: Any) -> None:
    """Give the root of a store attributes, and a checksum of all files of the store.

    Args:
        root: Open zarr group.
        path: Folder of the store.
        free: Folder of the store whose files may change, such as "image/c".
        **attributes: Values that JSON can hold.
    """
    kept = _kept(path, free)
    about = {"free": free, "bytes": _bytes_of(kept), "files": files_checksum(path, kept)}
    root.update_attributes(sealed({**attributes, **about}))


def refuse_changed_files(path: Path) -> dict[str, Any]:
    """Check the files of a store against the checksum that `seal_files` gave it.

    Args:
        path: Folder of the store.

    Returns:
        The attributes of the root.

    Raises:
        ValueError: If a file was changed, added or removed, or is no plain file.
    """
    held = group_attributes(path)
    if not {"free", "files"} <= {*held}:
        raise ValueError("it has no checksum of its files, and was not written by this version of torchsar")
    kept = _kept(path, held["free"])
    # sizes first, because a file may have become too large to be read
    if held.get("bytes") not in (None, _bytes_of(kept)) or held["files"] != files_checksum(path, kept):
        raise ValueError("its files differ from their checksum, since one of them is damaged, missing or replaced")
    return held


def refuse_missing_chunks(array: Any) -> None:
    """Check that an array has all of its chunks, since zarr reads a missing one as zeros.

    Args:
        array: The array.

    Raises:
        ValueError: If a chunk is missing.
    """
    if array.nchunks_initialized < array.nchunks:
        raise ValueError(
            f"{array.nchunks_initialized} of {array.nchunks} chunks of {array.basename!r} are there; finish it by "
            "torchsar focus --resume, or restore what is missing"
        )


def _kept(path: Path, free: str) -> list[Path]:
    """All files but the metadata of the root, which hold the checksum, and free ones."""
    files = [file for file in plain_files(path) if file != path / "zarr.json"]
    return [file for file in files if not (free and file.is_relative_to(path / free))]


def _bytes_of(files: list[Path]) -> int:
    return sum(file.stat().st_size for file in files)


def put(group: Any, name: str, value: Tensor, dims: tuple[str, ...] | None = None, **attributes: Any) -> None:
    """Write an array into a group.

    Args:
        group: Open zarr group.
        name: Name of the array.
        value: Its numbers.
        dims: Names of its dimensions.
        **attributes: Attributes of the array.
    """
    data = torch.as_tensor(value).detach().cpu().resolve_conj().numpy()
    chunks = tuple(min(n, 1024) for n in data.shape)
    made = {"shape": data.shape, "dtype": data.dtype, "chunks": chunks or "auto", "config": WRITE_ALL}
    array = group.create_array(name, dimension_names=dims, attributes=attributes, **made)
    array[...] = data
