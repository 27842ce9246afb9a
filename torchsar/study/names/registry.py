"""Every name that a config may use for stages and for parts of a world, such as scenes and motions.

A name is that of the class or function in snake case: `CorrectPulsePhase` is `correct_pulse_phase`.
Stages are the public ones of the packages of stages, if a config can represent all that they need,
and those that the functions below build. A package of the user adds a stage by an entry point of
the group `torchsar.stages` (name = "package.module:Class"). A config has no other way to run code.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Sequence
from functools import cache, wraps
from importlib.metadata import entry_points
from typing import Annotated, Any, Literal

from torch import Tensor

from torchsar import compensate, echo, focus, metrics, multichannel, repair, scene
from torchsar.compensate import Autofocus, EffectiveVelocity, RotationAutofocus, UnevenRotation
from torchsar.compensate.pulse_phase import CorrectPulsePhase
from torchsar.core import Alternate, Stage, Turn
from torchsar.focus import OmegaK, PaddedLines, TargetImage
from torchsar.metrics import Measure
from torchsar.multichannel import (
    AlongTrackAutofocus,
    Detector,
    ElementPattern,
    Extraction,
    FlatBand,
    LeastSquares,
    MigratingLines,
    MinimumMeanSquare,
    MovingPointVelocity,
    Search,
    SignalIntensityRatio,
)
from torchsar.multichannel.reconstruct import Rebuild
from torchsar.multichannel.scene_image import MoversImage
from torchsar.multichannel.velocity.aperture import ELEMENT_BEAM, Expected
from torchsar.radar import LIGHT_M_S, BistaticRadar, FarField, InverseRadar, Spotlight, StripmapRadar
from torchsar.scene import Dechirped, KSea, Polynomial, Sinusoid
from torchsar.scene.motion import RandomMotion
from torchsar.study.names.files import image_scene, image_sea, measured_track, point_cloud, recorded_path
from torchsar.study.settings.errors import loading
from torchsar.study.settings.signature import Catalogue, Section, snake


def effective_velocity(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    reach_m_s: float = 80.0,
    lines: int = 512,
    tolerance_m_s: float = 0.01,
    assess: bool = True,
) -> EffectiveVelocity:
    """Estimator of the effective velocity, as the velocity that gives the least image entropy.

    Args:
        reference: Reference of the range compression; None if the lines are already compressed.
        reach_m_s: Largest error of the nominal velocity in m/s.
        lines: Number of range cells that are used, at least 16.
        tolerance_m_s: Tolerance of the refinement in m/s.
        assess: Whether to add the standard deviation and the outcome.
    """
    return EffectiveVelocity(OmegaK(radar, reference), reach_m_s, lines, tolerance_m_s=tolerance_m_s, assess=assess)


def padded_lines(
    radar: StripmapRadar,
    reference: Literal["matched", "flat", "phase"] | None = "matched",
    velocity_m_s: float | None = None,
    doppler_hz: float | None = None,
    lines: int | None = None,
) -> PaddedLines:
    """Omega-K focusing with empty lines appended to the record, so that apertures that are cut off
    at its end do not appear at its beginning.

    Args:
        reference: Reference of the range compression; None if the lines are already compressed.
        velocity_m_s: Velocity in m/s; None for that of the radar.
        doppler_hz: Doppler centroid in Hz; None for that of the radar.
        lines: Number of empty lines; None for one aperture.
    """
    return PaddedLines(OmegaK(radar, reference, velocity_m_s, doppler_hz), lines)


def autofocus(
    radar: InverseRadar,
    geometry: FarField | Spotlight | None = None,
    search: int = 120,
    polish: int = 20,
    scene: Literal["sparse", "points", "clutter", "auto"] = "sparse",
    assess: bool = True,
) -> Autofocus:
    """Phase per pulse that sharpens the image of a target; see `torchsar.compensate.autofocus`.

    The image is the polar-format image of `TargetImage` if `geometry` is given, and the Fourier
    transform along pulses otherwise.

    Args:
        geometry: Geometry of the recording; None if it is not known.
        search: Largest number of iterations of the entropy fixed point, approximately.
        polish: Largest number of further iterations, which compare each pulse with a Wiener
            estimate of the scene.
        scene: Kind of the scene: "sparse", "points", "clutter" or "auto"; with a geometry it is
            taken to be sparse.
        assess: Whether to add the standard deviation and the outcome.
    """
    imaging = None if geometry is None else TargetImage(radar, geometry)
    return Autofocus(search, polish, imaging, scene, assess)


def rotation_and_phase(
    radar: InverseRadar,
    order: int = 3,
    yc_m: float = 0.0,
    rounds: int = 3,
    scatterers: int | None = None,
    search: int = 60,
    polish: int = 20,
    assess: bool = True,
) -> Alternate:
    """Alternate estimation of a phase error per pulse (`RotationAutofocus`) and of the non-uniform
    rotation (`UnevenRotation`) of a target, each from the data after correction of the other.

    Args:
        order: Degree of the rotation angle as a polynomial of slow time.
        yc_m: Range in metres from the centre of rotation to the zero of the range axis. It is not
            estimated, because the phase errors of the pulses absorb its whole effect.
        rounds: Number of rounds; each round estimates the phase and then the rotation.
        scatterers: Largest number of scatterers by which the rotation is estimated.
        search: Largest number of fixed-point iterations for the phase of least image entropy.
        polish: Largest number of further iterations for the phase, which compare each pulse with a
            Wiener estimate of the scene.
        assess: Whether to add the standard deviations and the outcome.
    """
    return Alternate(
        rounds,
        phase=Turn(RotationAutofocus(radar, search, polish, assess=assess), CorrectPulsePhase()),
        rotation=Turn(UnevenRotation(radar, order, yc_m, scatterers, assess=assess)),
    )


def vibration(name: str, unit: Literal["mm", "um"]) -> Sinusoid:
    """Sinusoidal vibration by a name of the form amplitude_frequency_phase, such as `1_0.1_90`.

    Args:
        name: Amplitude in `unit`, frequency in hertz and phase in degrees.
        unit: Unit of the amplitude, "mm" or "um".
    """
    return Sinusoid.named(name, unit=unit)


def moving_point_velocity(
    radar: BistaticRadar,
    aperture: Expected = ELEMENT_BEAM,
    search: Search | None = None,
    u_a_m_s: float | None = None,
    range_m: float | None = None,
    assess: bool = True,
) -> MigratingLines:
    """Recommended estimator of velocity and position of a moving target. It needs no initial
    values, only the limits of the search.

    Args:
        aperture: Illumination of the target.
        search: Extent of the search; None for 1.5 times the ambiguous velocity of the radar in
            slant-range speed.
        u_a_m_s: Along-track speed in m/s if it is known a priori; None to estimate it.
        range_m: Closest range of the target in m; None for that of the strongest range line, or for
            the reference range of the radar if the data have no range axis.
        assess: Whether the outcome is assessed.
    """
    estimator = MovingPointVelocity(radar, aperture, range_m, search, u_a_m_s, assess=assess)
    return MigratingLines(radar, estimator, assess=assess)


def alternate_velocity(
    radar: BistaticRadar,
    bandwidth_hz: float,
    aperture: Expected = ELEMENT_BEAM,
    rebuild: Rebuild | None = None,
    rounds: int = 2,
    step_m_s: float = 0.5,
    half_m_s: float = 20.0,
    assess: bool = True,
) -> MigratingLines:
    """Alternate estimation of the slant-range speed u_r of a target by the signal intensity ratio,
    and of its along-track speed u_a by autofocus.

    Args:
        bandwidth_hz: Width of the processed Doppler band in Hz.
        aperture: Illumination of the target.
        rebuild: Reconstruction of the Doppler bands; None for least squares with three bands.
        rounds: Number of rounds; each round estimates u_r and then u_a.
        step_m_s: Step of the search for u_r in m/s.
        half_m_s: Half width of the search interval of u_a about 0, in m/s.
        assess: Whether the outcome is assessed.

    Reference:
        Remote Sens. 2020, 12, 1703, section 4.3.
    """
    ratio = SignalIntensityRatio(radar, bandwidth_hz, rebuild, None, step_m_s, assess=assess)
    autofocus = AlongTrackAutofocus(radar, aperture, None, half_m_s, assess=assess)
    made = Alternate(rounds, u_r=Turn(ratio), u_a=Turn(autofocus))
    made.works_on, made.also_on = autofocus.works_on, autofocus.also_on
    return MigratingLines(radar, made, one_line=True, assess=assess)


def movers_image(
    radar: BistaticRadar,
    bands: int = 2,
    method: Literal["least_squares", "mmse"] = "least_squares",
    band_hz: float | None = None,
    snr_db: float = 40.0,
    removal: Literal["subtract", "zero"] = "subtract",
    integration_s: float = 4.5,
    segment_s: float = 0.6,
    half_along_m: float = 120.0,
    half_range_m: float = 60.0,
    threshold_db: float = 10.0,
    most: int = 8,
    u_a_reach_m_s: float = 20.0,
    suppressed_m_s: Sequence[float] = Detector().suppressed_m_s,
    assess: bool = True,
) -> MoversImage:
    """Image of a scene with its moving targets focused at their true positions, and estimates of
    their motion.

    Args:
        bands: Number of Doppler bands, each as wide as the PRF, that are separated.
        method: Reconstruction of the bands: "least_squares", or "mmse" (minimum mean-square error),
            which also works where the least-squares solution is singular.
        band_hz: Width in Hz of the flat Doppler spectrum that "mmse" assumes; None for the spectrum
            that the antenna pattern of the channels gives.
        snr_db: Signal-to-noise ratio that "mmse" assumes, in dB.
        removal: "subtract" removes the echo fitted to a target; "zero" removes all data in the area
            of the target, including the sea.
        integration_s: Time in s for which a scatterer is illuminated.
        segment_s: Length in s of the segments of slow time in which the sea about a target is
            suppressed.
        half_along_m: Half width of a target along track in m.
        half_range_m: Half width of a target in range in m.
        threshold_db: Least contrast of a target in dB: the mean intensity of a small rectangle of
            pixels over the median of all such means.
        most: Largest number of targets.
        u_a_reach_m_s: Half width of the search in the along-track speed in m/s.
        suppressed_m_s: Slant-range speeds in m/s for a further image in which the sea is
            suppressed, so that weaker targets are detected; empty to omit this image.
        assess: Whether the outcome is assessed.

    Reference:
        Remote Sens. 2020, 12, 1703, Fig. 13.
    """
    extraction = Extraction(half_along_m, half_range_m, integration_s, segment_s)
    detector = Detector(threshold_db, most=most, suppressed_m_s=suppressed_m_s)
    prior = ElementPattern() if band_hz is None else FlatBand(band_hz)
    rebuild = LeastSquares(bands) if method == "least_squares" else MinimumMeanSquare(bands, snr_db, prior)
    return MoversImage(radar, rebuild, removal, extraction, detector, u_a_reach_m_s, assess=assess)


def measure(
    metric: Literal[
        "contrast",
        "correlation",
        "entropy",
        "error_db",
        "impulse_response",
        "phase_rmse",
        "registered_error_db",
        "residual_phase",
        "strehl",
    ],
    of: Literal["intensity", "amplitude"] | None = None,
    at_m: tuple[float, float] | None = None,
) -> Measure:
    """Metric at its place in a chain; see `torchsar.metrics.Measure`.

    It may use true values. The metrics of the method get its result by the name of the stage, in
    each trial the mean of its numbers.

    Args:
        metric: Function of `torchsar.metrics`. Its parameters after the image are connected.
        of: Samples that contrast and entropy judge; None for the intensity.
        at_m: Place on the axes of the image near which `impulse_response` measures.
    """
    return Measure(getattr(metrics, metric), **{k: x for k, x in (("of", of), ("at_m", at_m)) if x is not None})


def drift(velocity_m_s: Tensor | float = 0.0, acceleration_m_s2: Tensor | float = 0.0) -> Polynomial:
    """Constant velocity and acceleration along the line of sight, d = v t + a t^2 / 2.

    Args:
        velocity_m_s: Velocity in m/s, receding positive.
        acceleration_m_s2: Acceleration in m/s^2.
    """
    return Polynomial((velocity_m_s, acceleration_m_s2 / 2))


def dechirped(track_m: Sequence[Tensor | float] | None = None) -> Dechirped:
    """Echo model of dechirped pulses, with the range of a target computed at every sample.

    Args:
        track_m: Polynomial that the range window follows: velocity in m/s, half the acceleration in
            m/s^2, and so on; None for a fixed range window.
    """
    return Dechirped((Polynomial(track_m),) if track_m else ())


def k_sea(
    cnr_db: Tensor | float = 30.0,
    shape: Tensor | float = 1.5,
    cell_m: tuple[float, float] = (20.0, 20.0),
    margin_s: float | None = None,
    lobes: int = 1,
) -> KSea:
    """K-distributed sea clutter.

    Args:
        cnr_db: Clutter-to-noise ratio of a range-compressed sample in dB.
        shape: Shape of the gamma distribution; small for spiky seas.
        cell_m: Along-track and range side of the cells of constant texture in metres.
        margin_s: Time in s by which the surface extends beyond the record at both ends; None to
            reach to the edge of the illumination.
        lobes: Number of nulls of the antenna pattern, to either side of its maximum, up to which
            the antenna illuminates the surface.
    """
    return KSea(power_db=cnr_db, shape=shape, cell_m=cell_m, margin_s=margin_s, lobes=lobes)


def with_wavelength(radar: type) -> Callable[..., Any]:
    """Return the constructor of a radar with `wavelength_m` as an alternative to `carrier_hz`.

    Args:
        radar: Class of the radar, with the parameter `carrier_hz`.

    Returns:
        A function with the signature of the class and the parameter `wavelength_m`.
    """

    @wraps(radar, updated=())
    def made(carrier_hz: float | None = None, wavelength_m: float | None = None, **keys: Any) -> Any:
        if (carrier_hz is None) == (wavelength_m is None):
            raise ValueError("give one of carrier_hz and wavelength_m, and leave the other null")
        speed = keys.get("wave_speed_m_s", LIGHT_M_S)
        return radar(carrier_hz=carrier_hz if wavelength_m is None else speed / wavelength_m, **keys)

    signature, optional = inspect.signature(radar), inspect.Parameter.KEYWORD_ONLY
    rest = [p.replace(kind=optional) for p in signature.parameters.values() if p.name != "carrier_hz"]
    first = [inspect.Parameter(name, optional, default=None) for name in ("carrier_hz", "wavelength_m")]
    made.__signature__, made.__doc__ = (  # pyright: ignore[reportAttributeAccessIssue]
        signature.replace(parameters=[*first, *rest]),
        inspect.cleandoc(radar.__doc__ or "").replace(
            "carrier_hz:", "wavelength_m: Wavelength in metres, in place of `carrier_hz`.\n    carrier_hz:", 1
        ),
    )
    hints = typing.get_type_hints(radar.__init__)
    made.__annotations__ = {**hints, "carrier_hz": float | None, "wavelength_m": float | None}
    return made


SCENES = Catalogue(
    "scene",
    "kind",
    (
        scene.Points,
        scene.RandomPoints,
        scene.Speckle,
        scene.Aircraft,
        scene.Satellite,
        scene.SpreadRows,
        scene.LetterE,
        scene.RetroAndBrokenLine,
        point_cloud,
        image_scene,
    ),
)
BEAMS = Catalogue("beam", "kind", (scene.AlwaysLit, scene.Dwell, scene.Antenna))
PATHS = Catalogue("path", "kind", (scene.Hyperbola, scene.Parabola))
MOTIONS = Catalogue("motion", "kind", (vibration, scene.Sinusoid, scene.Polynomial))
RADIAL_MOTIONS = Catalogue(
    "motion of the line of sight",
    "kind",
    (
        *MOTIONS.entries.values(),
        drift,
        scene.PathFluctuation,
        scene.VibrationSpectrum,
        measured_track,
    ),
)
FLIGHT_MOTIONS = Catalogue(
    "motion of an antenna",
    "kind",
    (*RADIAL_MOTIONS.entries.values(), scene.Offset, scene.Jitter, scene.RandomWalk),
)
NOMINAL_PATHS = Catalogue("nominal path", "kind", (scene.StraightPath, scene.CircularPath, recorded_path))
GROUNDS = Catalogue("ground", "kind", (scene.PlaneGround,))
PATH_FIDELITIES = Catalogue("fidelity of sweeps", "kind", (scene.MotionInSweep,))
START_PHASES = Catalogue("start phase", "kind", (scene.StartPhase, scene.UniformStartPhase))
FIDELITIES = Catalogue("fidelity", "kind", (scene.PhaseOnly, dechirped))
SWEEP_FIDELITIES = Catalogue(
    "fidelity of a sweep",
    "kind",
    (scene.LinearInSweep, scene.QuadraticInSweep, scene.EverySample, scene.OnePerSweep, scene.OnePerPeriod),
)
LOG_AMPLITUDES = Catalogue("log-amplitude", "kind", (scene.LogAmplitude,))
SWEEP_ERRORS = Catalogue("sweep error", "kind", (echo.PolynomialSweepError, echo.SinusoidSweepError))
CALIBRATIONS = Catalogue("calibration", "kind", (scene.CalibrationFibre,))
GATES = Catalogue("gate", "kind", (scene.BandLimited, scene.Pattern))
SEAS = Catalogue("sea", "kind", (k_sea, image_sea))
RECEIVE_RANGES = Catalogue("receive range", "kind", (scene.ExactRange, scene.TaylorRange))
_OF_RECEIVERS = (echo.Leakage, echo.QuadratureError, echo.GainSteps)
MULTICHANNEL_IMPAIRMENTS = Catalogue(
    "impairment of a multichannel recording",
    "kind",
    (echo.ChannelErrors, echo.SynchronisationError, echo.PulsedInterference, *_OF_RECEIVERS),
)
_OF_TARGETS = (
    echo.LostPulses,
    echo.WhitePhase,
    echo.PhaseWalk,
    echo.PhaseSinusoid,
    echo.Quantiser,
    echo.GateJumps,
    echo.GroundAtRest,
    *_OF_RECEIVERS,
)
IMPAIRMENTS = Catalogue(
    "impairment",
    "kind",
    (
        echo.ChannelImbalance,
        echo.smooth_response,
        echo.Tone,
        echo.WideInterferer,
        echo.PulsedInterference,
        echo.PeriodicJitter,
        echo.LostLines,
        echo.LostGaps,
        echo.RepeatedLines,
        echo.CorruptedNumbers,
        *_OF_TARGETS,
    ),
)
TARGET_IMPAIRMENTS = Catalogue("impairment of range profiles of a target", "kind", _OF_TARGETS)
AntennaMotions = Sequence[Annotated[scene.Motion | RandomMotion, FLIGHT_MOTIONS]]


def path_error(x: AntennaMotions = (), y: AntennaMotions = (), z: AntennaMotions = ()) -> echo.PathError:
    """Errors of the recorded positions of the antenna, of the transmitter if there are two.

    Args:
        x: Errors along axis x by name, which add up.
        y: Errors along axis y.
        z: Errors along axis z.
    """
    return echo.PathError(scene.Sway(x, y, z))


PATH_IMPAIRMENTS = Catalogue("impairment of a recording along any path", "kind", (*_OF_TARGETS, path_error))
LADAR_IMPAIRMENTS = Catalogue("impairment of a ladar recording", "kind", (echo.Quantiser, *_OF_RECEIVERS))
# parts that `torchsar list` shows besides stages, by the section of the world that names them
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
    "FIDELITIES (path: world.fidelity)": PATH_FIDELITIES,
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
    "IMPAIRMENTS (geo, geo_ocean)": MULTICHANNEL_IMPAIRMENTS,
}

# Names that are not listed as stages: a base class, and a stage whose result is no signal.
_NO_STAGES = ("path_image", "image_movers")
# stages that functions build from plain keys, by the package where they are listed
_BUILT = {
    "repair": (),
    "compensate": (autofocus, effective_velocity, rotation_and_phase),
    "multichannel": (moving_point_velocity, alternate_velocity, movers_image),
    "focus": (padded_lines,),
    "metrics": (measure,),
}
# keys of stages that may be `auto`
_AUTOMATIC = (
    "correct_migration.migration",
    "remove_transmit_range.order",
    "stationary_image.form",
    "uneven_rotation.order",
    "matched_fourier.transform",
)
_GIVEN = ("radar", "geometry", "side_data", "expected_power")


def _public(package: Any) -> dict[str, Callable[..., Any]]:
    """Public stages of a package, by name."""
    classes = (getattr(package, name) for name in package.__all__)
    found = {snake(one.__name__): one for one in classes if isinstance(one, type) and issubclass(one, Stage)}
    return {name: one for name, one in found.items() if name not in _NO_STAGES and Section(one, _GIVEN).is_complete}


GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    package.__name__.removeprefix("torchsar."): _public(package)
    for package in (repair, compensate, multichannel, focus)
}
GROUPS["metrics"] = {}
for _group, _made in _BUILT.items():
    GROUPS[_group] = dict(sorted((GROUPS[_group] | {one.__name__: one for one in _made}).items()))


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
            # fails unless the parameters of the stage can be read
            assert Section(entries[point.name], _GIVEN).keys is not None
    return Catalogue("stage", "stage", entries, given=_GIVEN, automatic=_AUTOMATIC)


def group_of(name: str) -> str:
    """Return the package of a stage, such as repair or focus, or `own` for a stage of the user."""
    return next((group for group, members in GROUPS.items() if name in members), "own")
