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
from torchsar.compensate.pulse_phase.gradient import Listed, Measured, Shrinking, pga, pga_sca
from torchsar.compensate.pulse_phase.pairs import sca
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.sharpen import entropy_fixed_point
from torchsar.compensate.pulse_phase.stages import Autofocus, CorrectPulsePhase, EntropyFixedPoint, Pga, PgaSca, Sca, correct_pulse_phase
from torchsar.compensate.velocity import EffectiveVelocity, minimum_entropy_velocity, velocity_objective

__all__ = [
    "Autofocus",
    "CorrectPulsePhase",
    "DopplerCentroid",
    "EffectiveVelocity",
    "EnergyCentre",
    "EntropyFixedPoint",
    "Listed",
    "Measured",
    "Pga",
    "PgaSca",
    "PhaseIncrement",
    "PointDoppler",
    "RangeDependentCentroid",
    "Sca",
    "Shrinking",
    "ambiguity_evidence",
    "autofocus",
    "complete_aperture_centroid",
    "correct_pulse_phase",
    "doppler_at",
    "energy_centre",
    "entropy_fixed_point",
    "fit_over_range",
    "lag_products",
    "line_doppler",
    "minimum_entropy_velocity",
    "peak_time_s",
    "pga",
    "pga_sca",
    "phase_increment",
    "plain_energy_centre",
    "point_doppler",
    "sca",
    "velocity_objective",
]
