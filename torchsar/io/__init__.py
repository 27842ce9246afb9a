"""Readers and writers of recorded radar data and of images."""

from torchsar.io.arrays import read_images, write_arrays
from torchsar.io.cphd import read_cphd
from torchsar.io.export import export_images, export_recording
from torchsar.io.formats import FORMATS, Format, format_of, read, read_history
from torchsar.io.geotiff import write_geotiff, write_strip_geotiff
from torchsar.io.inverse import read_inverse
from torchsar.io.netcdf import write_netcdf
from torchsar.io.path import read_path
from torchsar.io.recorded import read_stripmap
from torchsar.io.sicd import read_sicd
from torchsar.io.sidecar import import_recording
from torchsar.io.strip import StripImage, StripRecording, samples_checksum
from torchsar.io.write_cphd import write_cphd
from torchsar.io.write_sicd import write_sicd

__all__ = [
    "FORMATS",
    "Format",
    "StripImage",
    "StripRecording",
    "export_images",
    "export_recording",
    "format_of",
    "import_recording",
    "read",
    "read_cphd",
    "read_history",
    "read_images",
    "read_inverse",
    "read_path",
    "read_sicd",
    "read_stripmap",
    "samples_checksum",
    "write_arrays",
    "write_cphd",
    "write_geotiff",
    "write_netcdf",
    "write_sicd",
    "write_strip_geotiff",
]
