"""Estimators of motion and pointing, and the correctors that use them."""

from torchsar.compensate.ambiguity import DopplerCentroid, ambiguity_evidence, line_doppler
from torchsar.compensate.aperture import complete_aperture_centroid
from torchsar.compensate.doppler import (
    EnergyCentre,
    PhaseIncrement,
    RangeDependentCentroid,
    energy_centre,
    fit_over_range,
    lag_products,
    phase_increment,
    plain_energy_centre,
    point_doppler,
)
from torchsar.compensate.point import PointDoppler, doppler_at, peak_time_s
from torchsar.compensate.velocity import EffectiveVelocity, minimum_entropy_velocity, velocity_objective

__all__ = [
    "DopplerCentroid",
    "EffectiveVelocity",
    "EnergyCentre",
    "PhaseIncrement",
    "PointDoppler",
    "RangeDependentCentroid",
    "ambiguity_evidence",
    "complete_aperture_centroid",
    "doppler_at",
    "energy_centre",
    "fit_over_range",
    "lag_products",
    "line_doppler",
    "minimum_entropy_velocity",
    "peak_time_s",
    "phase_increment",
    "plain_energy_centre",
    "point_doppler",
    "velocity_objective",
]
