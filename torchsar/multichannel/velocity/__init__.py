"""Velocity and position estimation of moving points with several channels along track."""

from torchsar.multichannel.velocity.along_track import along_track_velocity, interferometry
from torchsar.multichannel.velocity.aperture import Dwell, ElementBeam
from torchsar.multichannel.velocity.bank import Search
from torchsar.multichannel.velocity.likelihood import explained_energy, maximum_likelihood
from torchsar.multichannel.velocity.recommended import moving_point_velocity
from torchsar.multichannel.velocity.sir import SignalIntensityRatio
from torchsar.multichannel.velocity.stages import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
    gradient_likelihood,
)
from torchsar.multichannel.velocity.walk import WalkAmbiguity
from torchsar.multichannel.velocity.whitening import Whitening, line_whitening, sample_whitening

__all__ = [
    "AlongTrackAutofocus",
    "Dwell",
    "ElementBeam",
    "GradientVelocity",
    "Interferometry",
    "LikelihoodVelocity",
    "MovingPointVelocity",
    "Search",
    "SignalIntensityRatio",
    "WalkAmbiguity",
    "Whitening",
    "along_track_velocity",
    "explained_energy",
    "gradient_likelihood",
    "interferometry",
    "line_whitening",
    "maximum_likelihood",
    "moving_point_velocity",
    "sample_whitening",
]
