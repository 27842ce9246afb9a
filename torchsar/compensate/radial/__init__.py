"""Radial motion of a triangular-FMCW ladar, estimated from up and down sweeps and compensated.

A period is an up sweep followed by a down sweep. Velocities refer to the turning points, the times
at which the up sweeps end and the down sweeps begin, and are positive for receding targets (dR/dt).
"""

from torchsar.compensate.radial.beats import MlPeak, SpectrumCorrelation, ml_peak, spectrum_correlation
from torchsar.compensate.radial.equalise import EqualisePulses, PulseGain, equalise_pulses, pulse_gain
from torchsar.compensate.radial.mirror import MirrorProduct, mirror_product
from torchsar.compensate.radial.phases import PhasePolish, phase_polish
from torchsar.compensate.radial.recommended import RadialMotion, radial_motion, range_error
from torchsar.compensate.radial.segmented import SegmentedInterference, segmented_interference
from torchsar.compensate.radial.trajectory import CompensateMotion, compensate_motion

__all__ = [
    "CompensateMotion",
    "EqualisePulses",
    "MirrorProduct",
    "MlPeak",
    "PhasePolish",
    "PulseGain",
    "RadialMotion",
    "SegmentedInterference",
    "SpectrumCorrelation",
    "compensate_motion",
    "equalise_pulses",
    "mirror_product",
    "ml_peak",
    "phase_polish",
    "pulse_gain",
    "radial_motion",
    "range_error",
    "segmented_interference",
    "spectrum_correlation",
]
__dir__ = __all__.copy
