"""Reader of complex images in the format SICD, NGA.STND.0024."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Axis, Signal, refuse_non_finite
from torchsar.io.extras import library, reading


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
