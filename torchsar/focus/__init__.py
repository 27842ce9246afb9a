"""Range compression, image formation, and predictions of the errors of simplified processing."""

from torchsar.focus.backprojection import backproject
from torchsar.focus.chirp_z import chirp_z, keystone
from torchsar.focus.coordinates import ClosestRange, PaddedLines, closest_range
from torchsar.focus.dechirped import AzimuthTransform, CompressDechirped, azimuth_transform, compress_dechirped
from torchsar.focus.defocus import InvertibleOmegaK, defocus_omega_k
from torchsar.focus.detection import Detect, QuickLook, amplitude, multilook, quicklook_looks, to_db
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.image_lines import CrossRangeLines, DopplerLines, cross_range_of, lines_for, mean_rate
from torchsar.focus.inverse_requirements import inverse_requirements
from torchsar.focus.ladar_requirements import Limit, ladar_limits, ladar_requirements
from torchsar.focus.matched_fourier import (
    MatchedFourier,
    MatchedFourierOperator,
    RangePhase,
    matched_fourier,
    range_phase,
)
from torchsar.focus.motion_compensation import MotionCompensation, ProcessedBeam, compensated_omega_k
from torchsar.focus.nufft import Nufft, nufft_type1, nufft_type2
from torchsar.focus.omega_k import OmegaK, StoredOmegaK, omega_k
from torchsar.focus.path_image import DirectImage, OmegaKImage, PathImage, TileImage
from torchsar.focus.polar import PolarFormat, PolarOperator
from torchsar.focus.range_doppler import RangeDoppler, range_doppler
from torchsar.focus.reference import RangeCompress, flat_reference, matched_reference, phase_reference, range_compress
from torchsar.focus.requirements import Requirement, recommended_form, requirements
from torchsar.focus.spotlight import GroundGrid, SpotlightBackprojection, backproject_spotlight
from torchsar.focus.spotlight_image import SceneGrid, SpotlightImage, scene_grid
from torchsar.focus.stolt import OmegaKStolt, omega_k_stolt
from torchsar.focus.strip import FocusStrip, StripPlan, focus_block, focus_strip, plan_strip, reach_lines, write_strip
from torchsar.focus.strip_backprojection import (
    Backproject,
    DopplerBand,
    EveryPulse,
    Integration,
    backproject_strip,
)
from torchsar.focus.target import TargetImage
from torchsar.focus.tile_operator import TileOperator
from torchsar.focus.tiles import TilePlan, image_tiles
from torchsar.focus.transforms import CompiledNufft, ExplicitSum, Gridding, Resampling
from torchsar.focus.triangular import (
    AzimuthMatchedFilter,
    CompressSweeps,
    DerampAzimuth,
    azimuth_matched_filter,
    compress_sweeps,
    deramp_azimuth,
    profile_axes,
)

__all__ = [
    "AzimuthMatchedFilter",
    "AzimuthTransform",
    "Backproject",
    "ClosestRange",
    "CompiledNufft",
    "CompressDechirped",
    "CompressSweeps",
    "CrossRangeLines",
    "DerampAzimuth",
    "Detect",
    "DirectImage",
    "DopplerBand",
    "DopplerLines",
    "EveryPulse",
    "ExplicitSum",
    "FocusStrip",
    "Gridding",
    "GroundGrid",
    "ImageGrid",
    "Integration",
    "InvertibleOmegaK",
    "Limit",
    "MatchedFourier",
    "MatchedFourierOperator",
    "MotionCompensation",
    "Nufft",
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
    "Requirement",
    "Resampling",
    "SceneGrid",
    "SpotlightBackprojection",
    "SpotlightImage",
    "StoredOmegaK",
    "StripPlan",
    "TargetImage",
    "TileImage",
    "TileOperator",
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
    "cross_range_of",
    "defocus_omega_k",
    "deramp_azimuth",
    "flat_reference",
    "focus_block",
    "focus_strip",
    "image_tiles",
    "inverse_requirements",
    "keystone",
    "ladar_limits",
    "ladar_requirements",
    "lines_for",
    "matched_fourier",
    "matched_reference",
    "mean_rate",
    "multilook",
    "nufft_type1",
    "nufft_type2",
    "omega_k",
    "omega_k_stolt",
    "phase_reference",
    "plan_strip",
    "profile_axes",
    "quicklook_looks",
    "range_compress",
    "range_doppler",
    "range_phase",
    "reach_lines",
    "recommended_form",
    "requirements",
    "scene_grid",
    "to_db",
    "write_strip",
]
__dir__ = __all__.copy
