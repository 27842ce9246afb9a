"""Radial motion of a triangular-FMCW ladar, estimated from up and down sweeps and compensated.

A period is an up sweep followed by a down sweep. Velocities refer to the turning points, the times
at which the up sweeps end and the down sweeps begin, and are positive for receding targets (dR/dt).
"""

from torchsar.compensate.radial.compensate import compensate_motion
from torchsar.compensate.radial.correlation import spectrum_correlation
from torchsar.compensate.radial.equalise import equalise_pulses, pulse_gain
from torchsar.compensate.radial.mirror import mirror_product
from torchsar.compensate.radial.peak import ml_peak
from torchsar.compensate.radial.polish import phase_polish
from torchsar.compensate.radial.recommended import radial_motion, range_error
from torchsar.compensate.radial.segmented import segmented_interference
from torchsar.compensate.radial.stages import (
    CompensateMotion,
    EqualisePulses,
    MirrorProduct,
    MlPeak,
    PhasePolish,
    PulseGain,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
)
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s, integrated_range, turning_points

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
    "geometric_velocity_m_s",
    "integrated_range",
    "mirror_product",
    "ml_peak",
    "phase_polish",
    "pulse_gain",
    "radial_motion",
    "range_error",
    "segmented_interference",
    "spectrum_correlation",
    "turning_points",
]
