"""Every name that a config may use for stages and for parts of a world, such as scenes and motions.

A name is that of the class or function in snake case: `CorrectPulsePhase` is `correct_pulse_phase`.
Stages are the public ones of the packages of stages, as far as a config can hold what they need,
and the functions of `factories` that build further ones. A package of the user adds a stage by an
entry point of the group `torchsar.stages` (name = "package.module:Class"). A config has no other
way to run code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import entry_points
from typing import Annotated, Any

from torchsar import compensate, echo, focus, multichannel, repair, scene
from torchsar.core import Stage
from torchsar.scene.fluctuation import RandomMotion
from torchsar.study.names import factories
from torchsar.study.settings.errors import loading
from torchsar.study.settings.signature import Catalogue, Section, snake

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
    ),
)
BEAMS = Catalogue("beam", "kind", (scene.AlwaysLit, scene.Dwell, scene.Antenna))
PATHS = Catalogue("path", "kind", (scene.Hyperbola, scene.Parabola))
MOTIONS = Catalogue("motion", "kind", (factories.vibration, scene.Sinusoid, scene.Polynomial))
RADIAL_MOTIONS = Catalogue(
    "motion of the line of sight",
    "kind",
    (
        *MOTIONS.entries.values(),
        factories.drift,
        scene.PathFluctuation,
        scene.VibrationSpectrum,
        factories.measured_track,
    ),
)
FLIGHT_MOTIONS = Catalogue(
    "motion of an antenna",
    "kind",
    (*RADIAL_MOTIONS.entries.values(), scene.Offset, scene.Jitter, scene.RandomWalk),
)
NOMINAL_PATHS = Catalogue("nominal path", "kind", (scene.StraightPath, scene.CircularPath, factories.recorded_path))
GROUNDS = Catalogue("ground", "kind", (scene.PlaneGround,))
START_PHASES = Catalogue("start phase", "kind", (scene.StartPhase, scene.UniformStartPhase))
FIDELITIES = Catalogue("fidelity", "kind", (scene.PhaseOnly, factories.dechirped))
SWEEP_FIDELITIES = Catalogue(
    "fidelity of a sweep",
    "kind",
    (scene.LinearInSweep, scene.QuadraticInSweep, scene.EverySample, scene.OnePerSweep, scene.OnePerPeriod),
)
LOG_AMPLITUDES = Catalogue("log-amplitude", "kind", (scene.LogAmplitude,))
SWEEP_ERRORS = Catalogue("sweep error", "kind", (echo.PolynomialSweepError, echo.SinusoidSweepError))
CALIBRATIONS = Catalogue("calibration", "kind", (scene.CalibrationFibre,))
GATES = Catalogue("gate", "kind", (scene.BandLimited, scene.Pattern))
SEAS = Catalogue("sea", "kind", (factories.k_sea, factories.image_sea))
RECEIVE_RANGES = Catalogue("receive range", "kind", (scene.ExactRange, scene.TaylorRange))
MULTICHANNEL_IMPAIRMENTS = Catalogue(
    "impairment of a multichannel recording", "kind", (echo.ChannelErrors, echo.SynchronisationError)
)
_OF_TARGETS = (echo.LostPulses, echo.WhitePhase, echo.PhaseWalk, echo.PhaseSinusoid, echo.Quantiser)
IMPAIRMENTS = Catalogue(
    "impairment",
    "kind",
    (
        echo.ChannelImbalance,
        echo.smooth_response,
        echo.Tone,
        echo.WideInterferer,
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
LADAR_IMPAIRMENTS = Catalogue("impairment of a ladar recording", "kind", (echo.Quantiser,))
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

# the bases of other stages, and what gives no signal
_NO_STAGES = ("path_image", "image_movers")
# stages that a function builds from plain keys, by the package where they are listed
_BUILT = {
    "repair": (),
    "compensate": (factories.autofocus, factories.effective_velocity, factories.rotation_and_phase),
    "multichannel": (factories.moving_point_velocity, factories.alternate_velocity, factories.movers_image),
    "focus": (factories.padded_lines,),
}
# keys of stages that choose a form, and that may be left to choose
_AUTOMATIC = (
    "correct_migration.migration",
    "remove_transmit_range.order",
    "stationary_image.form",
    "uneven_rotation.order",
    "matched_fourier.transform",
)
_GIVEN = ("radar", "geometry", "side_data", "expected_power")


def _public(package: Any) -> dict[str, Callable[..., Any]]:
    """The public stages of a package, by name."""
    classes = (getattr(package, name) for name in package.__all__)
    found = {snake(one.__name__): one for one in classes if isinstance(one, type) and issubclass(one, Stage)}
    return {name: one for name, one in found.items() if name not in _NO_STAGES and Section(one, _GIVEN).is_complete}


GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    package.__name__.removeprefix("torchsar."): _public(package)
    for package in (repair, compensate, multichannel, focus)
}
for _group, _made in _BUILT.items():
    GROUPS[_group] |= {one.__name__: one for one in _made}


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
    """Return the package of a stage, such as repair or focus, or `own` for a stage of the user."""
    return next((group for group, members in GROUPS.items() if name in members), "own")
