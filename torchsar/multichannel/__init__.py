"""Azimuth-multichannel SAR: reconstruction and focusing, velocity estimation, and calibration.

The receiver has several channels along track and a low pulse rate. The full Doppler spectrum of a
stationary scene is reconstructed from the channels with zero velocity, that of a moving target with
the velocity of the target.
"""

from torchsar.multichannel.azimuth import (
    FocusAzimuth,
    FocusPlan,
    azimuth_filter,
    focus_azimuth,
    known_motion_chain,
)
from torchsar.multichannel.balance import CorrectBalance, EstimateBalance, correct_balance, estimate_balance
from torchsar.multichannel.body import Body, body_echo, find_body
from torchsar.multichannel.chip import Extraction
from torchsar.multichannel.migration import (
    CorrectMigration,
    Frame,
    Keystone,
    NoMigration,
    StaticBulk,
    ambiguity_number,
    correct_migration,
)
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import Reconstruct, reconstruct, reconstruct_lines
from torchsar.multichannel.requirements import MultichannelUse, multichannel_limits, multichannel_requirements
from torchsar.multichannel.response import (
    ElementPattern,
    FlatBand,
    LeastSquares,
    MinimumMeanSquare,
    band_matrix,
    condition_number,
    doppler_offsets,
    noise_gain_db,
)
from torchsar.multichannel.scene_image import Detection, Detector, ImageMovers, MoversImage, SceneImage, detect
from torchsar.multichannel.stationary import StationaryImage, stationary_image
from torchsar.multichannel.synchronise import EstimateSynchronisation, RemoveSynchronisation
from torchsar.multichannel.transmit import (
    AzimuthScaling,
    CompressChannels,
    RemoveTransmitRange,
    remove_transmit_range,
    scale_azimuth,
)
from torchsar.multichannel.velocity import (
    AlongTrackAutofocus,
    Dwell,
    ElementBeam,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
    Search,
    SignalIntensityRatio,
    WalkAmbiguity,
    Whitening,
    along_track_velocity,
    explained_energy,
    gradient_likelihood,
    interferometry,
    line_whitening,
    maximum_likelihood,
    moving_point_velocity,
    sample_whitening,
)
from torchsar.multichannel.velocity.walk import MigratingLines

__all__ = [
    "AlongTrackAutofocus",
    "AzimuthScaling",
    "Body",
    "CompressChannels",
    "CorrectBalance",
    "CorrectMigration",
    "Detection",
    "Detector",
    "Dwell",
    "ElementBeam",
    "ElementPattern",
    "EstimateBalance",
    "EstimateSynchronisation",
    "Extraction",
    "FlatBand",
    "FocusAzimuth",
    "FocusPlan",
    "Frame",
    "GradientVelocity",
    "ImageMovers",
    "Interferometry",
    "Keystone",
    "LeastSquares",
    "LikelihoodVelocity",
    "MigratingLines",
    "MinimumMeanSquare",
    "MoversImage",
    "MovingPointVelocity",
    "MultichannelUse",
    "NoMigration",
    "PointMotion",
    "Reconstruct",
    "RemoveSynchronisation",
    "RemoveTransmitRange",
    "SceneImage",
    "Search",
    "SignalIntensityRatio",
    "StaticBulk",
    "StationaryImage",
    "WalkAmbiguity",
    "Whitening",
    "along_track_velocity",
    "ambiguity_number",
    "azimuth_filter",
    "band_matrix",
    "body_echo",
    "condition_number",
    "correct_balance",
    "correct_migration",
    "detect",
    "doppler_offsets",
    "estimate_balance",
    "explained_energy",
    "find_body",
    "focus_azimuth",
    "gradient_likelihood",
    "interferometry",
    "known_motion_chain",
    "line_whitening",
    "maximum_likelihood",
    "moving_point_velocity",
    "multichannel_limits",
    "multichannel_requirements",
    "noise_gain_db",
    "reconstruct",
    "reconstruct_lines",
    "remove_transmit_range",
    "sample_whitening",
    "scale_azimuth",
    "stationary_image",
]
