"""Estimators of motion, pointing and phase errors, and the stages that correct data with them.

=================================  ==============================================================
to find or correct                 what to use
=================================  ==============================================================
Doppler centroid of a strip        `DopplerCentroid`; within one PRF `energy_centre`,
                                   `phase_increment`
Doppler from a known bright point  `PointDoppler`, `point_doppler`, `doppler_at`
effective velocity of a strip      `EffectiveVelocity`, `minimum_entropy_velocity`
phase of each pulse                `autofocus`; faster `sca`, `pga`, `pga_sca`; baselines
                                   `entropy_fixed_point`, `sharpest_phase`
phase, homogeneous scene           `link_phases`
correction of the phase            `correct_pulse_phase`
misaligned range profiles          `align_envelopes`, then `shift_range`
non-uniform rotation of a target   `uneven_rotation`; its first step `coarse_rotation`; baselines
                                   `entropy_rotation` and `chirplet_clean`
phase, known non-uniform rotation  `rotation_autofocus`
entropy as a function of rotation  `ImageEntropy`, with the settings `EntropyObjective`
radial motion seen by a ladar      `radial_motion`, then `compensate_motion`; baselines
                                   `segmented_interference`, `mirror_product`, `ml_peak`,
                                   `spectrum_correlation`; range error at any time `range_error`
residual phase after it            `phase_polish`
amplitude of each pulse            `pulse_gain`, then `equalise_pulses`
errors of a recorded path          `path_autofocus`, of a strip `strip_autofocus`, then
                                   `CorrectPath`
phase of each pulse on any path    `path_phase`
motion within sweeps               `correct_sweep_motion`
=================================  ==============================================================

Most functions are stages of chains, too: `Autofocus` calls `autofocus`, and so on.
"""

from torchsar.compensate.ambiguity import DopplerCentroid
from torchsar.compensate.doppler import (
    EnergyCentre,
    PhaseIncrement,
    energy_centre,
    phase_increment,
    point_doppler,
)
from torchsar.compensate.envelope import (
    AlignEnvelopes,
    ShiftRange,
    align_envelopes,
    shift_range,
)
from torchsar.compensate.path import (
    CorrectPath,
    CorrectSweepMotion,
    PathAutofocus,
    PathPhase,
    StripAutofocus,
    correct_sweep_motion,
    path_autofocus,
    path_phase,
    strip_autofocus,
)
from torchsar.compensate.point import PointDoppler, doppler_at
from torchsar.compensate.pulse_phase import (
    Autofocus,
    CorrectPulsePhase,
    EntropyFixedPoint,
    LinkPhases,
    Pga,
    PgaSca,
    Sca,
    SharpestPhase,
    autofocus,
    correct_pulse_phase,
    entropy_fixed_point,
    link_phases,
    pga,
    pga_sca,
    sca,
    sharpest_phase,
)
from torchsar.compensate.radial import (
    CompensateMotion,
    EqualisePulses,
    MirrorProduct,
    MlPeak,
    PhasePolish,
    PulseGain,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
    compensate_motion,
    equalise_pulses,
    mirror_product,
    ml_peak,
    phase_polish,
    pulse_gain,
    radial_motion,
    range_error,
    segmented_interference,
    spectrum_correlation,
)
from torchsar.compensate.rotation import (
    ChirpletClean,
    CoarseRotation,
    EntropyObjective,
    EntropyRotation,
    ImageEntropy,
    RotationAutofocus,
    UnevenRotation,
    chirplet_clean,
    coarse_rotation,
    entropy_rotation,
    rotation_autofocus,
    uneven_rotation,
)
from torchsar.compensate.velocity import (
    EffectiveVelocity,
    minimum_entropy_velocity,
)
from torchsar.core.kinds import check_kinds

__all__ = [
    "AlignEnvelopes",
    "Autofocus",
    "ChirpletClean",
    "CoarseRotation",
    "CompensateMotion",
    "CorrectPath",
    "CorrectPulsePhase",
    "CorrectSweepMotion",
    "DopplerCentroid",
    "EffectiveVelocity",
    "EnergyCentre",
    "EntropyFixedPoint",
    "EntropyObjective",
    "EntropyRotation",
    "EqualisePulses",
    "ImageEntropy",
    "LinkPhases",
    "MirrorProduct",
    "MlPeak",
    "PathAutofocus",
    "PathPhase",
    "Pga",
    "PgaSca",
    "PhaseIncrement",
    "PhasePolish",
    "PointDoppler",
    "PulseGain",
    "RadialMotion",
    "RotationAutofocus",
    "Sca",
    "SegmentedInterference",
    "SharpestPhase",
    "ShiftRange",
    "SpectrumCorrelation",
    "StripAutofocus",
    "UnevenRotation",
    "align_envelopes",
    "autofocus",
    "chirplet_clean",
    "coarse_rotation",
    "compensate_motion",
    "correct_pulse_phase",
    "correct_sweep_motion",
    "doppler_at",
    "energy_centre",
    "entropy_fixed_point",
    "entropy_rotation",
    "equalise_pulses",
    "link_phases",
    "minimum_entropy_velocity",
    "mirror_product",
    "ml_peak",
    "path_autofocus",
    "path_phase",
    "pga",
    "pga_sca",
    "phase_increment",
    "phase_polish",
    "point_doppler",
    "pulse_gain",
    "radial_motion",
    "range_error",
    "rotation_autofocus",
    "sca",
    "segmented_interference",
    "sharpest_phase",
    "shift_range",
    "spectrum_correlation",
    "strip_autofocus",
    "uneven_rotation",
]
__dir__ = __all__.copy
globals().update(check_kinds(globals()[name] for name in __all__))
