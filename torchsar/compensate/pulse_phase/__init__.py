"""Autofocus: the phase error of every pulse, estimated from the range-compressed data alone."""

from torchsar.compensate.pulse_phase.descent import maximum_contrast, minimum_entropy, sharpest_phase
from torchsar.compensate.pulse_phase.gradient import Listed, Measured, Shrinking, pga, pga_sca, sca
from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.compensate.pulse_phase.linking import link_phases
from torchsar.compensate.pulse_phase.recommended import autofocus, entropy_fixed_point
from torchsar.compensate.pulse_phase.stages import (
    Autofocus,
    CorrectPulsePhase,
    EntropyFixedPoint,
    LinkPhases,
    Pga,
    PgaSca,
    Sca,
    SharpestPhase,
    TargetAutofocus,
    correct_pulse_phase,
)

__all__ = [
    "Autofocus",
    "CorrectPulsePhase",
    "EntropyFixedPoint",
    "Imaging",
    "LinkPhases",
    "Listed",
    "Measured",
    "Pga",
    "PgaSca",
    "Sca",
    "SharpestPhase",
    "Shrinking",
    "TargetAutofocus",
    "autofocus",
    "correct_pulse_phase",
    "entropy_fixed_point",
    "link_phases",
    "maximum_contrast",
    "minimum_entropy",
    "pga",
    "pga_sca",
    "sca",
    "sharpest_phase",
]
