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
from torchsar.compensate.envelope import AlignEnvelopes, ShiftRange, align_envelopes, align_mean, align_running, drift_cells, refine_alignment, shift_range
from torchsar.compensate.point import PointDoppler, doppler_at, peak_time_s
from torchsar.compensate.pulse_phase.descent import maximum_contrast, minimum_entropy, sharpest_phase
from torchsar.compensate.pulse_phase.gradient import Listed, Measured, Shrinking, pga, pga_sca
from torchsar.compensate.pulse_phase.pairs import sca
from torchsar.compensate.pulse_phase.recommended import autofocus
from torchsar.compensate.pulse_phase.sharpen import entropy_fixed_point
from torchsar.compensate.pulse_phase.stages import Autofocus, CorrectPulsePhase, EntropyFixedPoint, Pga, PgaSca, Sca, SharpestPhase, correct_pulse_phase
from torchsar.compensate.velocity import EffectiveVelocity, minimum_entropy_velocity, velocity_objective

__all__ = [
    "AlignEnvelopes",
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
    "SharpestPhase",
    "ShiftRange",
    "Shrinking",
    "align_envelopes",
    "align_mean",
    "align_running",
    "ambiguity_evidence",
    "autofocus",
    "complete_aperture_centroid",
    "correct_pulse_phase",
    "doppler_at",
    "drift_cells",
    "energy_centre",
    "entropy_fixed_point",
    "fit_over_range",
    "lag_products",
    "line_doppler",
    "maximum_contrast",
    "minimum_entropy",
    "minimum_entropy_velocity",
    "peak_time_s",
    "pga",
    "pga_sca",
    "phase_increment",
    "plain_energy_centre",
    "point_doppler",
    "refine_alignment",
    "sca",
    "sharpest_phase",
    "shift_range",
    "velocity_objective",
]
