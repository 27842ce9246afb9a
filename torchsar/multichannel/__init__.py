"""Azimuth-multichannel SAR: reconstruction and focusing, velocity estimation, and calibration.

The receiver has several channels along track and a low pulse rate. The full Doppler spectrum of a
stationary scene is reconstructed from the channels with zero velocity, that of a moving target with
the velocity of the target.

=================================  =================================================================
task                               what to use
=================================  =================================================================
before data are processed          `multichannel_limits`, `multichannel_requirements` of a
                                   `MultichannelUse`
range compression, transmit range  `CompressChannels`; `remove_transmit_range`, as published
                                   `AzimuthScaling`
errors of channels and clocks      `estimate_balance`, `correct_balance`; `EstimateSynchronisation`,
                                   `ClutterSynchronisation`, `RemoveSynchronisation`
image of a stationary scene        `stationary_image`
scene and its moving targets       `MoversImage` in chains; `ImageMovers` in programs gives a
                                   `SceneImage`; settings `Detector`, `Extraction`
bright targets of an image         `detect`
velocity of a moving point         `moving_point_velocity`, within a `Search`
the same, from a start             `LikelihoodVelocity`, `GradientVelocity`
the same, baselines                `interferometry`, `AlongTrackAutofocus`, `SignalIntensityRatio`
velocity, lines still migrate      `MigratingLines`, `WalkAmbiguity`
expected amplitude over slow time  `Dwell`, `ElementBeam`
range migration                    `correct_migration` by `Keystone`, `StaticBulk` or `NoMigration`,
                                   on a `Frame`
full Doppler band of a point       `reconstruct` with `LeastSquares` or `MinimumMeanSquare`, for a
                                   `PointMotion`
expected power over Doppler        `FlatBand`, `ElementPattern`
quality of a reconstruction        `condition_number`, `noise_gain_db`; `doppler_offsets` of its
                                   bins
azimuth image of a point           `focus_azimuth`; for one known motion `FocusPlan`
=================================  =================================================================

Most functions are stages of chains, too: `Reconstruct` calls `reconstruct`, and so on.
"""

from torchsar.core.kinds import check_kinds
from torchsar.multichannel.azimuth import (
    FocusAzimuth,
    FocusPlan,
    focus_azimuth,
)
from torchsar.multichannel.balance import CorrectBalance, EstimateBalance, correct_balance, estimate_balance
from torchsar.multichannel.chip import Extraction, detect
from torchsar.multichannel.limits import multichannel_limits
from torchsar.multichannel.migration import (
    CorrectMigration,
    Frame,
    Keystone,
    NoMigration,
    StaticBulk,
    correct_migration,
)
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import (
    LeastSquares,
    MinimumMeanSquare,
    Reconstruct,
    condition_number,
    noise_gain_db,
    reconstruct,
)
from torchsar.multichannel.requirements import MultichannelUse, multichannel_requirements
from torchsar.multichannel.response import ElementPattern, FlatBand, doppler_offsets
from torchsar.multichannel.scene_image import Detector, ImageMovers, MoversImage, SceneImage
from torchsar.multichannel.stationary import StationaryImage, stationary_image
from torchsar.multichannel.synchronise import (
    ClutterSynchronisation,
    EstimateSynchronisation,
    RemoveSynchronisation,
    clutter_synchronisation,
)
from torchsar.multichannel.transmit import (
    AzimuthScaling,
    CompressChannels,
    RemoveTransmitRange,
    remove_transmit_range,
)
from torchsar.multichannel.velocity.along_track import interferometry
from torchsar.multichannel.velocity.aperture import Dwell, ElementBeam
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.recommended import moving_point_velocity
from torchsar.multichannel.velocity.sir import SignalIntensityRatio
from torchsar.multichannel.velocity.stages import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MigratingLines,
    MovingPointVelocity,
    WalkAmbiguity,
)

__all__ = [
    "AlongTrackAutofocus",
    "AzimuthScaling",
    "ClutterSynchronisation",
    "CompressChannels",
    "CorrectBalance",
    "CorrectMigration",
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
    "clutter_synchronisation",
    "condition_number",
    "correct_balance",
    "correct_migration",
    "detect",
    "doppler_offsets",
    "estimate_balance",
    "focus_azimuth",
    "interferometry",
    "moving_point_velocity",
    "multichannel_limits",
    "multichannel_requirements",
    "noise_gain_db",
    "reconstruct",
    "remove_transmit_range",
    "stationary_image",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
