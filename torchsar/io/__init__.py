"""Readers and writers of recorded radar data and of images.

===================================  ========================================================
file or task                         what to use
===================================  ========================================================
file of any of these formats         `read`; a phase history with its antennas `read_history`
raw strip (.npz)                     `read_stripmap`
rotating target or turntable (.npz)  `read_inverse`
phase history on any path (.npz)     `read_path`
CPHD, a phase history                `read_cphd`, `write_cphd`
SICD, a complex image                `read_sicd`, `write_sicd`
HDF5, MATLAB, numpy, flat binary     `import_recording`, which writes an .npz file
sweeps of an FMCW board              `fmcw_recording`
image or points of a scene           `read_array`, `read_points`
images of a run (zarr)               `read_images`
image for other programs             `write_geotiff`, `write_netcdf`
strip longer than memory             `StripImage`, `write_strip_geotiff`
===================================  ========================================================
"""

from torchsar.core.kinds import check_kinds
from torchsar.io.arrays import read_images
from torchsar.io.cphd import read_cphd, write_cphd
from torchsar.io.export import write_geotiff, write_netcdf, write_strip_geotiff
from torchsar.io.fmcw import fmcw_recording
from torchsar.io.formats import read, read_history
from torchsar.io.history import read_inverse, read_path
from torchsar.io.plain import read_array, read_points
from torchsar.io.sicd import read_sicd, write_sicd
from torchsar.io.sidecar import import_recording
from torchsar.io.strip import StripImage, read_stripmap

__all__ = [
    "StripImage",
    "fmcw_recording",
    "import_recording",
    "read",
    "read_array",
    "read_cphd",
    "read_history",
    "read_images",
    "read_inverse",
    "read_path",
    "read_points",
    "read_sicd",
    "read_stripmap",
    "write_cphd",
    "write_geotiff",
    "write_netcdf",
    "write_sicd",
    "write_strip_geotiff",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
