"""Autofocus: the phase error of every pulse, estimated from the range-compressed data alone."""

from torchsar.compensate.pulse_phase.imaging import Imaging
from torchsar.compensate.pulse_phase.linking import LinkPhases, link_phases
from torchsar.compensate.pulse_phase.pga import Pga, PgaSca, Sca, pga, pga_sca, sca
from torchsar.compensate.pulse_phase.recommended import Autofocus, EntropyFixedPoint, autofocus, entropy_fixed_point
from torchsar.compensate.pulse_phase.sharpest import SharpestPhase, sharpest_phase
from torchsar.compensate.pulse_phase.stages import CorrectPulsePhase, correct_pulse_phase

__all__ = [
    "Autofocus",
    "CorrectPulsePhase",
    "EntropyFixedPoint",
    "Imaging",
    "LinkPhases",
    "Pga",
    "PgaSca",
    "Sca",
    "SharpestPhase",
    "autofocus",
    "correct_pulse_phase",
    "entropy_fixed_point",
    "link_phases",
    "pga",
    "pga_sca",
    "sca",
    "sharpest_phase",
]
__dir__ = __all__.copy
