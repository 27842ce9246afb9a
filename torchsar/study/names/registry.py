"""Every name that a config may use: stages, scenes, motions, beams, paths and impairments.

A user's own stage joins through the entry point group `torchsar.stages` (name =
"package.module:Class"); a config has no other way to run code.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any

from torchsar.compensate.ambiguity import DopplerCentroid
from torchsar.compensate.doppler import EnergyCentre, PhaseIncrement, RangeDependentCentroid
from torchsar.compensate.envelope import AlignEnvelopes, ShiftRange
from torchsar.compensate.point import PointDoppler
from torchsar.compensate.pulse_phase.stages import CorrectPulsePhase, EntropyFixedPoint, Pga, PgaSca, Sca, SharpestPhase
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
)
from torchsar.compensate.rotation import (
    ChirpletClean,
    CoarseRotation,
    PhaseFitRotation,
    RotationAutofocus,
    RotationDescent,
    RotationEvolution,
    RotationGenetic,
    RotationNewton,
    RotationSearch,
    UnevenRotation,
)
from torchsar.echo.channel_errors import ChannelErrors
from torchsar.echo.channels import ChannelImbalance
from torchsar.echo.interference import Quantiser, Tone, WideInterferer
from torchsar.echo.jitter import PeriodicJitter
from torchsar.echo.lines import CorruptedNumbers, LostGaps, LostLines, RepeatedLines
from torchsar.echo.pulse_phase import PhaseSinusoid, PhaseWalk, WhitePhase
from torchsar.echo.sweep_error import PolynomialSweepError, SinusoidSweepError
from torchsar.echo.turntable import LostPulses
from torchsar.focus import (
    AzimuthTransform,
    Backproject,
    ClosestRange,
    CompressDechirped,
    OmegaK,
    OmegaKStolt,
    RangeCompress,
    RangeDoppler,
    TargetImage,
)
from torchsar.focus.matched_fourier import MatchedFourier, RangePhase
from torchsar.focus.triangular import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.multichannel.azimuth import FocusAzimuth
from torchsar.multichannel.balance import CorrectBalance
from torchsar.multichannel.compress import CompressChannels
from torchsar.multichannel.synchronise import EstimateSynchronisation, RemoveSynchronisation
from torchsar.multichannel.transmit import AzimuthScaling, RemoveTransmitRange
from torchsar.multichannel.velocity.walk import WalkAmbiguity
from torchsar.repair.channels import CorrectImbalance, EstimateImbalance
from torchsar.repair.fill import BandLimitedFill, LinearFill, SparseFill, ZeroFill
from torchsar.repair.interference import DropInterference, NotchInterference, SubtractInterference
from torchsar.repair.jitter_blind import BlindJitter
from torchsar.repair.jitter_pilot import PilotJitter
from torchsar.repair.lines import LineIntegrity
from torchsar.repair.response import CorrectResponse
from torchsar.repair.triangle import BlankTurningPoints, CircularShift, SplitSweeps
from torchsar.repair.triangle_calibrate import CalibrateSweeps
from torchsar.scene import (
    Aircraft,
    AlwaysLit,
    Antenna,
    BandLimited,
    CalibrationFibre,
    Dwell,
    EverySample,
    ExactRange,
    Hyperbola,
    LetterE,
    LinearInSweep,
    LogAmplitude,
    OnePerPeriod,
    OnePerSweep,
    Parabola,
    PathFluctuation,
    Pattern,
    PhaseOnly,
    Points,
    Polynomial,
    QuadraticInSweep,
    RandomPoints,
    RetroAndBrokenLine,
    Satellite,
    Sinusoid,
    Speckle,
    SpreadRows,
    StartPhase,
    TaylorRange,
    UniformStartPhase,
    VibrationSpectrum,
)
from torchsar.study.names import channels, factories
from torchsar.study.settings.signature import Catalogue

SCENES = Catalogue(
    "scene",
    "kind",
    {
        "points": Points,
        "random_points": RandomPoints,
        "speckle": Speckle,
        "aircraft": Aircraft,
        "satellite": Satellite,
        "spread_rows": SpreadRows,
        "letter_e": LetterE,
        "retro_and_broken_line": RetroAndBrokenLine,
    },
)
BEAMS = Catalogue("beam", "kind", {"always_lit": AlwaysLit, "dwell": Dwell, "antenna": Antenna})
PATHS = Catalogue("path", "kind", {"hyperbola": Hyperbola, "parabola": Parabola})
MOTIONS = Catalogue(
    "motion", "kind", {"vibration": factories.vibration, "sinusoid": Sinusoid, "polynomial": Polynomial}
)
RADIAL_MOTIONS = Catalogue(
    "motion of the line of sight",
    "kind",
    {
        **MOTIONS.entries,
        "drift": factories.drift,
        "path_fluctuation": PathFluctuation,
        "vibration_spectrum": VibrationSpectrum,
        "measured_track": factories.measured_track,
    },
)
START_PHASES = Catalogue("start phase", "kind", {"normal": StartPhase, "uniform": UniformStartPhase})
FIDELITIES = Catalogue("fidelity", "kind", {"phase_only": PhaseOnly, "dechirped": factories.dechirped})
SWEEP_FIDELITIES = Catalogue(
    "fidelity of a sweep",
    "kind",
    {
        "linear_in_sweep": LinearInSweep,
        "quadratic_in_sweep": QuadraticInSweep,
        "every_sample": EverySample,
        "one_per_sweep": OnePerSweep,
        "one_per_period": OnePerPeriod,
    },
)
LOG_AMPLITUDES = Catalogue("log-amplitude", "kind", {"scintillation": LogAmplitude})
SWEEP_ERRORS = Catalogue("sweep error", "kind", {"polynomial": PolynomialSweepError, "sinusoid": SinusoidSweepError})
CALIBRATIONS = Catalogue("calibration", "kind", {"fibre": CalibrationFibre})
GATES = Catalogue("gate", "kind", {"band_limited": BandLimited, "pattern": Pattern})
SEAS = Catalogue("sea", "kind", {"k_sea": factories.k_sea, "image": factories.image_sea})
RECEIVE_RANGES = Catalogue("receive range", "kind", {"exact": ExactRange, "taylor": TaylorRange})
MULTICHANNEL_IMPAIRMENTS = Catalogue(
    "impairment of a multichannel recording",
    "kind",
    {"channel_errors": ChannelErrors, "clock_errors": factories.clock_errors},
)
IMPAIRMENTS = Catalogue(
    "impairment",
    "kind",
    {
        "channel_imbalance": ChannelImbalance,
        "channel_response": factories.channel_response,
        "tone": Tone,
        "wide_interferer": WideInterferer,
        "quantiser": Quantiser,
        "periodic_jitter": PeriodicJitter,
        "lost_lines": LostLines,
        "lost_gaps": LostGaps,
        "repeated_lines": RepeatedLines,
        "corrupted_numbers": CorruptedNumbers,
        "lost_pulses": LostPulses,
        "white_phase": WhitePhase,
        "phase_walk": PhaseWalk,
        "phase_sinusoid": PhaseSinusoid,
    },
)

TARGET_IMPAIRMENTS = Catalogue(
    "impairment of range profiles of a target",
    "kind",
    {
        name: IMPAIRMENTS.entries[name]
        for name in ("lost_pulses", "white_phase", "phase_walk", "phase_sinusoid", "quantiser")
    },
)
LADAR_IMPAIRMENTS = Catalogue(
    "impairment of a ladar recording", "kind", {"quantiser": IMPAIRMENTS.entries["quantiser"]}
)
# what `torchsar list` shows besides stages, by the section of the world that names it
WORLD = {
    "SCENES (world.scene)": SCENES,
    "BEAMS (stripmap: world.beam)": BEAMS,
    "PATHS (stripmap: world.path)": PATHS,
    "MOTIONS (isal, isal_rotation: world.motion)": MOTIONS,
    "START PHASES (isal, isal_rotation: world.start_phase)": START_PHASES,
    "FIDELITIES (isal, isal_rotation: world.fidelity)": FIDELITIES,
    "MOTIONS (sal: world.motion)": RADIAL_MOTIONS,
    "LOG-AMPLITUDES (sal: world.log_amplitude)": LOG_AMPLITUDES,
    "FIDELITIES (sal: world.fidelity)": SWEEP_FIDELITIES,
    "SWEEP ERRORS (sal: world.sweep_error)": SWEEP_ERRORS,
    "CALIBRATIONS (sal: world.calibration)": CALIBRATIONS,
    "GATES (geo, geo_ocean: world.gate)": GATES,
    "SEAS (geo, geo_ocean: world.sea)": SEAS,
    "RECEIVE RANGES (geo: world.receive)": RECEIVE_RANGES,
    "IMPAIRMENTS (stripmap)": IMPAIRMENTS,
    "IMPAIRMENTS (isal, isal_rotation)": TARGET_IMPAIRMENTS,
    "IMPAIRMENTS (sal)": LADAR_IMPAIRMENTS,
    "IMPAIRMENTS (geo)": MULTICHANNEL_IMPAIRMENTS,
}

REPAIR: dict[str, Callable[..., Any]] = {
    "line_integrity": LineIntegrity,
    "zero_fill": ZeroFill,
    "linear_fill": LinearFill,
    "band_limited_fill": BandLimitedFill,
    "sparse_fill": SparseFill,
    "interference_subtract": SubtractInterference,
    "interference_notch": NotchInterference,
    "interference_drop": DropInterference,
    "jitter_pilot": PilotJitter,
    "jitter_blind": BlindJitter,
    "jitter_lagrange": factories.jitter_lagrange,
    "jitter_band_limited": factories.jitter_band_limited,
    "jitter_exact": factories.jitter_exact,
    "imbalance": EstimateImbalance,
    "imbalance_correct": CorrectImbalance,
    "response": factories.estimate_response,
    "response_flat_band": factories.FlatBandResponse,
    "response_correct": CorrectResponse,
    "split_sweeps": SplitSweeps,
    "circular_shift": CircularShift,
    "blank_turning_points": BlankTurningPoints,
    "calibrate_sweeps": CalibrateSweeps,
    "channel_balance": channels.channel_balance,
    "channel_balance_correct": CorrectBalance,
    "synchronisation": EstimateSynchronisation,
    "synchronisation_remove": RemoveSynchronisation,
}
COMPENSATE: dict[str, Callable[..., Any]] = {
    "phase_increment": PhaseIncrement,
    "energy_centre": EnergyCentre,
    "range_dependent_centroid": RangeDependentCentroid,
    "doppler_centroid": DopplerCentroid,
    "point_doppler": PointDoppler,
    "effective_velocity": factories.effective_velocity,
    "align_envelopes": AlignEnvelopes,
    "shift_range": ShiftRange,
    "sca": Sca,
    "pga": Pga,
    "pga_sca": PgaSca,
    "entropy_fixed_point": EntropyFixedPoint,
    "sharpest_phase": SharpestPhase,
    "autofocus": factories.AutofocusOfImage,
    "pulse_phase_correct": CorrectPulsePhase,
    "segmented_interference": SegmentedInterference,
    "mirror_product": MirrorProduct,
    "radial_motion": RadialMotion,
    "ml_peak": MlPeak,
    "spectrum_correlation": SpectrumCorrelation,
    "compensate_motion": CompensateMotion,
    "phase_polish": PhasePolish,
    "pulse_gain": PulseGain,
    "equalise_pulses": EqualisePulses,
    "rotation": UnevenRotation,
    "rotation_coarse": CoarseRotation,
    "rotation_phase_fit": PhaseFitRotation,
    "rotation_search": RotationSearch,
    "rotation_genetic": RotationGenetic,
    "rotation_evolution": RotationEvolution,
    "rotation_newton": RotationNewton,
    "rotation_descent": RotationDescent,
    "rotation_autofocus": RotationAutofocus,
    "rotation_and_phase": factories.rotation_and_phase,
    "transmit_range_remove": RemoveTransmitRange,
    "azimuth_scaling": AzimuthScaling,
    "walk_ambiguity": WalkAmbiguity,
    "migration_correct": channels.migration_correct,
    "moving_point_velocity": channels.moving_point_velocity,
    "interferometry": channels.interferometry,
    "along_track_autofocus": channels.along_track_autofocus,
    "likelihood_velocity": channels.likelihood_velocity,
    "gradient_velocity": channels.gradient_velocity,
    "intensity_ratio": channels.intensity_ratio,
    "alternate_velocity": channels.alternate_velocity,
}
FOCUS: dict[str, Callable[..., Any]] = {
    "range_compress": RangeCompress,
    "omega_k": OmegaK,
    "omega_k_padded": factories.omega_k_padded,
    "omega_k_stolt": OmegaKStolt,
    "range_doppler": RangeDoppler,
    "backproject": Backproject,
    "closest_range": ClosestRange,
    "compress_dechirped": CompressDechirped,
    "azimuth_transform": AzimuthTransform,
    "target_image": TargetImage,
    "compress_sweeps": CompressSweeps,
    "deramp_azimuth": DerampAzimuth,
    "azimuth_matched_filter": AzimuthMatchedFilter,
    "range_phase": RangePhase,
    "matched_fourier": MatchedFourier,
    "chirplet_clean": ChirpletClean,
    "compress_channels": CompressChannels,
    "rebuild_bands": channels.rebuild_bands,
    "stationary_image": channels.stationary_image,
    "movers_image": channels.movers_image,
    "focus_target": FocusAzimuth,
}
# keys of stages that choose a form, and that may be left to choose
_AUTOMATIC = (
    "migration_correct.kind",
    "transmit_range_remove.order",
    "stationary_image.form",
    "rotation.order",
    "matched_fourier.transform",
)
GROUPS = {"repair": REPAIR, "compensate": COMPENSATE, "focus": FOCUS}


@cache
def stages() -> Catalogue:
    """All stages, the user's own among them. A name taken twice is refused."""
    entries = {name: target for group in GROUPS.values() for name, target in group.items()}
    for point in entry_points(group="torchsar.stages"):
        if point.name in entries:
            raise ValueError(
                f"the entry point {point.value!r} takes the stage name {point.name!r}, which is in use; rename it"
            )
        entries[point.name] = point.load()
    return Catalogue("stage", "stage", entries, given=("radar", "geometry"), automatic=_AUTOMATIC)


def group_of(name: str) -> str:
    """repair, compensate, focus, or `own` for a user's stage."""
    return next((group for group, members in GROUPS.items() if name in members), "own")
