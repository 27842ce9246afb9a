"""Every name that a config may use for stages and for parts of a world, such as scenes and motions.

A package of the user adds a stage by an entry point of the group `torchsar.stages` (name =
"package.module:Class"). A config has no other way to run code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import entry_points
from typing import Annotated, Any

from torchsar import compensate, echo, focus, multichannel, repair, scene
from torchsar.scene.fluctuation import RandomMotion
from torchsar.study.names import channels, factories
from torchsar.study.settings.errors import loading
from torchsar.study.settings.signature import Catalogue, Section

SCENES = Catalogue(
    "scene",
    "kind",
    {
        "points": scene.Points,
        "random_points": scene.RandomPoints,
        "speckle": scene.Speckle,
        "aircraft": scene.Aircraft,
        "satellite": scene.Satellite,
        "spread_rows": scene.SpreadRows,
        "letter_e": scene.LetterE,
        "retro_and_broken_line": scene.RetroAndBrokenLine,
    },
)
BEAMS = Catalogue("beam", "kind", {"always_lit": scene.AlwaysLit, "dwell": scene.Dwell, "antenna": scene.Antenna})
PATHS = Catalogue("path", "kind", {"hyperbola": scene.Hyperbola, "parabola": scene.Parabola})
MOTIONS = Catalogue(
    "motion", "kind", {"vibration": scene.Sinusoid.named, "sinusoid": scene.Sinusoid, "polynomial": scene.Polynomial}
)
RADIAL_MOTIONS = Catalogue(
    "motion of the line of sight",
    "kind",
    {
        **MOTIONS.entries,
        "drift": factories.drift,
        "path_fluctuation": scene.PathFluctuation,
        "vibration_spectrum": scene.VibrationSpectrum,
        "measured_track": factories.measured_track,
    },
)
FLIGHT_MOTIONS = Catalogue(
    "motion of an antenna",
    "kind",
    {**RADIAL_MOTIONS.entries, "offset": scene.Offset, "jitter": scene.Jitter, "random_walk": scene.RandomWalk},
)
NOMINAL_PATHS = Catalogue(
    "nominal path",
    "kind",
    {"straight": scene.StraightPath, "circular": scene.CircularPath, "recorded": factories.recorded_path},
)
GROUNDS = Catalogue("ground", "kind", {"plane": scene.PlaneGround})
START_PHASES = Catalogue("start phase", "kind", {"normal": scene.StartPhase, "uniform": scene.UniformStartPhase})
FIDELITIES = Catalogue("fidelity", "kind", {"phase_only": scene.PhaseOnly, "dechirped": factories.dechirped})
SWEEP_FIDELITIES = Catalogue(
    "fidelity of a sweep",
    "kind",
    {
        "linear_in_sweep": scene.LinearInSweep,
        "quadratic_in_sweep": scene.QuadraticInSweep,
        "every_sample": scene.EverySample,
        "one_per_sweep": scene.OnePerSweep,
        "one_per_period": scene.OnePerPeriod,
    },
)
LOG_AMPLITUDES = Catalogue("log-amplitude", "kind", {"scintillation": scene.LogAmplitude})
SWEEP_ERRORS = Catalogue(
    "sweep error", "kind", {"polynomial": echo.PolynomialSweepError, "sinusoid": echo.SinusoidSweepError}
)
CALIBRATIONS = Catalogue("calibration", "kind", {"fibre": scene.CalibrationFibre})
GATES = Catalogue("gate", "kind", {"band_limited": scene.BandLimited, "pattern": scene.Pattern})
SEAS = Catalogue("sea", "kind", {"k_sea": factories.k_sea, "image": factories.image_sea})
RECEIVE_RANGES = Catalogue("receive range", "kind", {"exact": scene.ExactRange, "taylor": scene.TaylorRange})
MULTICHANNEL_IMPAIRMENTS = Catalogue(
    "impairment of a multichannel recording",
    "kind",
    {"channel_errors": echo.ChannelErrors, "clock_errors": echo.SynchronisationError},
)
IMPAIRMENTS = Catalogue(
    "impairment",
    "kind",
    {
        "channel_imbalance": echo.ChannelImbalance,
        "channel_response": echo.smooth_response,
        "tone": echo.Tone,
        "wide_interferer": echo.WideInterferer,
        "quantiser": echo.Quantiser,
        "periodic_jitter": echo.PeriodicJitter,
        "lost_lines": echo.LostLines,
        "lost_gaps": echo.LostGaps,
        "repeated_lines": echo.RepeatedLines,
        "corrupted_numbers": echo.CorruptedNumbers,
        "lost_pulses": echo.LostPulses,
        "white_phase": echo.WhitePhase,
        "phase_walk": echo.PhaseWalk,
        "phase_sinusoid": echo.PhaseSinusoid,
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
AntennaMotions = Sequence[Annotated[scene.Motion | RandomMotion, FLIGHT_MOTIONS]]


def path_error(x: AntennaMotions = (), y: AntennaMotions = (), z: AntennaMotions = ()) -> echo.PathError:
    """Errors of the recorded positions of the antenna, of the transmitter if there are two.

    Args:
        x: Errors along axis x by name, which add up.
        y: Errors along axis y.
        z: Errors along axis z.
    """
    return echo.PathError(scene.Sway(x, y, z))


PATH_IMPAIRMENTS = Catalogue(
    "impairment of a recording along any path", "kind", {**TARGET_IMPAIRMENTS.entries, "path_error": path_error}
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
    "MOTIONS (path: world.transmitter, world.receiver, world.navigation)": FLIGHT_MOTIONS,
    "NOMINAL PATHS (path: world.transmitter, world.receiver)": NOMINAL_PATHS,
    "GROUNDS (path: world.ground)": GROUNDS,
    "LOG-AMPLITUDES (sal: world.log_amplitude)": LOG_AMPLITUDES,
    "FIDELITIES (sal: world.fidelity)": SWEEP_FIDELITIES,
    "SWEEP ERRORS (sal: world.sweep_error)": SWEEP_ERRORS,
    "CALIBRATIONS (sal: world.calibration)": CALIBRATIONS,
    "GATES (geo, geo_ocean: world.gate)": GATES,
    "SEAS (geo, geo_ocean: world.sea)": SEAS,
    "RECEIVE RANGES (geo: world.receive)": RECEIVE_RANGES,
    "IMPAIRMENTS (stripmap)": IMPAIRMENTS,
    "IMPAIRMENTS (isal, isal_rotation)": TARGET_IMPAIRMENTS,
    "IMPAIRMENTS (path)": PATH_IMPAIRMENTS,
    "IMPAIRMENTS (sal)": LADAR_IMPAIRMENTS,
    "IMPAIRMENTS (geo)": MULTICHANNEL_IMPAIRMENTS,
}

REPAIR: dict[str, Callable[..., Any]] = {
    "line_integrity": repair.LineIntegrity,
    "zero_fill": repair.ZeroFill,
    "linear_fill": repair.LinearFill,
    "band_limited_fill": repair.BandLimitedFill,
    "sparse_fill": repair.SparseFill,
    "interference_subtract": repair.SubtractInterference,
    "interference_notch": repair.NotchInterference,
    "interference_drop": repair.DropInterference,
    "jitter_pilot": repair.PilotJitter,
    "jitter_blind": repair.BlindJitter,
    "jitter_lagrange": factories.jitter_lagrange,
    "jitter_band_limited": factories.jitter_band_limited,
    "jitter_exact": repair.CorrectJitter,
    "imbalance": repair.EstimateImbalance,
    "imbalance_correct": repair.CorrectImbalance,
    "response": repair.EstimateResponse,
    "response_flat_band": repair.EstimateFlatResponse,
    "response_correct": repair.CorrectResponse,
    "split_sweeps": repair.SplitSweeps,
    "circular_shift": repair.CircularShift,
    "blank_turning_points": repair.BlankTurningPoints,
    "calibrate_sweeps": repair.CalibrateSweeps,
    "channel_balance": channels.channel_balance,
    "channel_balance_correct": multichannel.CorrectBalance,
    "synchronisation": multichannel.EstimateSynchronisation,
    "synchronisation_remove": multichannel.RemoveSynchronisation,
}
COMPENSATE: dict[str, Callable[..., Any]] = {
    "phase_increment": compensate.PhaseIncrement,
    "energy_centre": compensate.EnergyCentre,
    "doppler_centroid": compensate.DopplerCentroid,
    "point_doppler": compensate.PointDoppler,
    "effective_velocity": factories.effective_velocity,
    "align_envelopes": compensate.AlignEnvelopes,
    "shift_range": compensate.ShiftRange,
    "sca": compensate.Sca,
    "pga": compensate.Pga,
    "pga_sca": compensate.PgaSca,
    "entropy_fixed_point": compensate.EntropyFixedPoint,
    "sharpest_phase": compensate.SharpestPhase,
    "link_phases": compensate.LinkPhases,
    "autofocus": factories.autofocus,
    "path_autofocus": compensate.PathAutofocus,
    "path_phase": compensate.PathPhase,
    "strip_autofocus": compensate.StripAutofocus,
    "path_correct": compensate.CorrectPath,
    "pulse_phase_correct": compensate.CorrectPulsePhase,
    "segmented_interference": compensate.SegmentedInterference,
    "mirror_product": compensate.MirrorProduct,
    "radial_motion": compensate.RadialMotion,
    "ml_peak": compensate.MlPeak,
    "spectrum_correlation": compensate.SpectrumCorrelation,
    "compensate_motion": compensate.CompensateMotion,
    "phase_polish": compensate.PhasePolish,
    "pulse_gain": compensate.PulseGain,
    "equalise_pulses": compensate.EqualisePulses,
    "rotation": compensate.UnevenRotation,
    "rotation_coarse": compensate.CoarseRotation,
    "rotation_entropy": compensate.EntropyRotation,
    "rotation_autofocus": compensate.RotationAutofocus,
    "rotation_and_phase": factories.rotation_and_phase,
    "transmit_range_remove": multichannel.RemoveTransmitRange,
    "azimuth_scaling": multichannel.AzimuthScaling,
    "walk_ambiguity": multichannel.WalkAmbiguity,
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
    "range_compress": focus.RangeCompress,
    "omega_k": focus.OmegaK,
    "omega_k_padded": factories.omega_k_padded,
    "omega_k_stolt": focus.OmegaKStolt,
    "range_doppler": focus.RangeDoppler,
    "backproject": focus.Backproject,
    "closest_range": focus.ClosestRange,
    "tile_image": focus.TileImage,
    "direct_image": focus.DirectImage,
    "omega_k_image": focus.OmegaKImage,
    "spotlight_image": focus.SpotlightImage,
    "compress_dechirped": focus.CompressDechirped,
    "azimuth_transform": focus.AzimuthTransform,
    "target_image": focus.TargetImage,
    "compress_sweeps": focus.CompressSweeps,
    "deramp_azimuth": focus.DerampAzimuth,
    "azimuth_matched_filter": focus.AzimuthMatchedFilter,
    "range_phase": focus.RangePhase,
    "matched_fourier": focus.MatchedFourier,
    "focus_strip": focus.FocusStrip,
    "detect": focus.Detect,
    "quick_look": focus.QuickLook,
    "chirplet_clean": compensate.ChirpletClean,
    "compress_channels": multichannel.CompressChannels,
    "rebuild_bands": channels.rebuild_bands,
    "stationary_image": channels.stationary_image,
    "movers_image": channels.movers_image,
    "focus_target": multichannel.FocusAzimuth,
}
# keys of stages that choose a form, and that may be left to choose
_AUTOMATIC = (
    "migration_correct.kind",
    "transmit_range_remove.order",
    "stationary_image.form",
    "rotation.order",
    "matched_fourier.transform",
)
_GIVEN = ("radar", "geometry", "side_data", "expected_power")
GROUPS = {"repair": REPAIR, "compensate": COMPENSATE, "focus": FOCUS}


@cache
def stages() -> Catalogue:
    """Return the catalogue of all stages, including those of the user.

    Raises:
        ConfigError: If a stage of the user cannot be loaded, or has a name that is in use.
    """
    entries = {name: target for group in GROUPS.values() for name, target in group.items()}
    for point in entry_points(group="torchsar.stages"):
        with loading(point):
            if point.name in entries:
                raise ValueError(f"the stage name {point.name!r} is in use; rename it")
            entries[point.name] = point.load()
            assert Section(entries[point.name], _GIVEN).keys is not None  # its parameters can be read
    return Catalogue("stage", "stage", entries, given=_GIVEN, automatic=_AUTOMATIC)


def group_of(name: str) -> str:
    """Return the group of a stage: repair, compensate, focus, or `own` for a stage of the user."""
    return next((group for group, members in GROUPS.items() if name in members), "own")
