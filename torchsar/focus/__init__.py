"""Range compression, image formation, and predictions of the errors of simplified processing.

=====================================  =============================================================
data or task                           what to use
=====================================  =============================================================
raw strip, swath of moderate width     `omega_k`; many recordings of one geometry `StoredOmegaK`
raw strip, wide swath or large squint  `omega_k_stolt`
raw strip, baseline and reference      `range_doppler`; `backproject_strip`, exact, for patches
the steps of range-Doppler             `RangeCompress`, `DopplerTransform`, `CorrectRangeMigration`,
                                       `AzimuthCompress`
strip longer than memory               `plan_strip`, `focus_strip`, `write_strip`; overlap
                                       `reach_lines`
strip: zero padding, other axes        `PaddedLines`; `closest_range`
raw lines, range only                  `range_compress`
dechirped pulses                       `compress_dechirped`
rotating target                        `azimuth_transform`; from profiles `TargetImage`
target with non-uniform rotation       `range_phase`, then `matched_fourier`
                                       (`MatchedFourierOperator`)
its image lines, its sums              `DopplerLines`, `CrossRangeLines`; `Gridding`,
                                       `CompiledNufft`, `ExplicitSum`, `Resampling`
sweeps of a triangular ladar           `compress_sweeps`, `deramp_azimuth`, `azimuth_matched_filter`
any path                               `TileImage`; `DirectImage` and `backproject`, exact and slow;
                                       base class `PathImage`
any path, grid from its geometry       `SpotlightImage`
any path, several histories            `TilePlan`; `image_tiles` for one history; pixels `ImageGrid`
nearly straight path                   `OmegaKImage`; `compensated_omega_k`, `MotionCompensation`;
                                       beam `ProcessedBeam`
spotlight, small scene                 `PolarFormat`, `PolarOperator`; exact `backproject_spotlight`
transforms                             `nufft_type1`, `nufft_type2`, `chirp_z`, `keystone`
amplitude and pictures of an image     `amplitude`, `multilook`, `to_db`; `Detect`, `QuickLook`
errors predicted before processing     `requirements`, `inverse_requirements`, `ladar_requirements`,
                                       `ladar_limits`
=====================================  =============================================================

Most functions are stages of chains, too: `OmegaK` calls `omega_k`, and so on. `Backproject` calls
`backproject_strip`, and `SpotlightBackprojection` calls `backproject_spotlight`.
"""

from torchsar.core.kinds import check_kinds
from torchsar.focus.backprojection import backproject
from torchsar.focus.chirp_z import Keystone, chirp_z, keystone
from torchsar.focus.coordinates import ClosestRange, PaddedLines, closest_range
from torchsar.focus.dechirped import AzimuthTransform, CompressDechirped, azimuth_transform, compress_dechirped
from torchsar.focus.detection import Detect, QuickLook, amplitude, multilook, to_db
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.image_lines import CrossRangeLines, DopplerLines
from torchsar.focus.inverse_requirements import inverse_requirements
from torchsar.focus.ladar_requirements import ladar_limits, ladar_requirements
from torchsar.focus.matched_fourier import (
    MatchedFourier,
    MatchedFourierOperator,
    RangePhase,
    matched_fourier,
    range_phase,
)
from torchsar.focus.motion_compensation import MotionCompensation, compensated_omega_k
from torchsar.focus.nufft import nufft_type1, nufft_type2
from torchsar.focus.omega_k import OmegaK, omega_k
from torchsar.focus.path_image import DirectImage, OmegaKImage, PathImage, TileImage
from torchsar.focus.polar import PolarFormat, PolarOperator
from torchsar.focus.processed_beam import ProcessedBeam
from torchsar.focus.range_doppler import (
    AzimuthCompress,
    CorrectRangeMigration,
    DopplerTransform,
    RangeDoppler,
    range_doppler,
)
from torchsar.focus.reference import RangeCompress, range_compress
from torchsar.focus.requirements import requirements
from torchsar.focus.spotlight import SpotlightBackprojection, backproject_spotlight
from torchsar.focus.spotlight_image import SpotlightImage
from torchsar.focus.stolt import OmegaKStolt, omega_k_stolt
from torchsar.focus.stored_omega_k import StoredOmegaK
from torchsar.focus.strip import FocusStrip, focus_strip, plan_strip, reach_lines, write_strip
from torchsar.focus.strip_backprojection import Backproject, backproject_strip
from torchsar.focus.target import TargetImage
from torchsar.focus.tiles import TilePlan, image_tiles
from torchsar.focus.transforms import CompiledNufft, ExplicitSum, Gridding, Resampling
from torchsar.focus.triangular import (
    AzimuthMatchedFilter,
    CompressSweeps,
    DerampAzimuth,
    azimuth_matched_filter,
    compress_sweeps,
    deramp_azimuth,
)

__all__ = [
    "AzimuthCompress",
    "AzimuthMatchedFilter",
    "AzimuthTransform",
    "Backproject",
    "ClosestRange",
    "CompiledNufft",
    "CompressDechirped",
    "CompressSweeps",
    "CorrectRangeMigration",
    "CrossRangeLines",
    "DerampAzimuth",
    "Detect",
    "DirectImage",
    "DopplerLines",
    "DopplerTransform",
    "ExplicitSum",
    "FocusStrip",
    "Gridding",
    "ImageGrid",
    "Keystone",
    "MatchedFourier",
    "MatchedFourierOperator",
    "MotionCompensation",
    "OmegaK",
    "OmegaKImage",
    "OmegaKStolt",
    "PaddedLines",
    "PathImage",
    "PolarFormat",
    "PolarOperator",
    "ProcessedBeam",
    "QuickLook",
    "RangeCompress",
    "RangeDoppler",
    "RangePhase",
    "Resampling",
    "SpotlightBackprojection",
    "SpotlightImage",
    "StoredOmegaK",
    "TargetImage",
    "TileImage",
    "TilePlan",
    "amplitude",
    "azimuth_matched_filter",
    "azimuth_transform",
    "backproject",
    "backproject_spotlight",
    "backproject_strip",
    "chirp_z",
    "closest_range",
    "compensated_omega_k",
    "compress_dechirped",
    "compress_sweeps",
    "deramp_azimuth",
    "focus_strip",
    "image_tiles",
    "inverse_requirements",
    "keystone",
    "ladar_limits",
    "ladar_requirements",
    "matched_fourier",
    "multilook",
    "nufft_type1",
    "nufft_type2",
    "omega_k",
    "omega_k_stolt",
    "plan_strip",
    "range_compress",
    "range_doppler",
    "range_phase",
    "reach_lines",
    "requirements",
    "to_db",
    "write_strip",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
