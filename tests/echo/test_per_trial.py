"""A parameter given per trial: trial i equals the simulation with its number alone.

Every public dataclass of torchsar.scene and torchsar.echo is inspected. A constructor parameter
annotated with `Tensor` must have a case here, one annotated with a plain `float` a reason.
"""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import torchsar.echo
import torchsar.scene
from tests.helpers import small_bistatic, small_ladar, small_radar
from torchsar.core import Draws, Recording, Truth
from torchsar.echo import (
    ChannelErrors,
    ChannelImbalance,
    CorruptedNumbers,
    Leakage,
    LostGaps,
    LostLines,
    LostPulses,
    PeriodicJitter,
    PhaseSinusoid,
    PhaseWalk,
    PolynomialSweepError,
    PulsedInterference,
    QuadratureError,
    Quantiser,
    RepeatedLines,
    SinusoidSweepError,
    SynchronisationError,
    Tone,
    WhitePhase,
    WideInterferer,
    bistatic_echo,
    ladar_echo,
    simulate,
    simulate_bistatic,
    simulate_ladar,
    simulate_ladar_record,
    simulate_path,
    simulate_turntable,
    smooth_response,
)
from torchsar.echo.receiver import GainSteps, GateJumps, GroundAtRest
from torchsar.echo.sea import sea_echo
from torchsar.radar import InverseRadar, Orbit, seen_point
from torchsar.scene import (
    Aircraft,
    Antenna,
    BandLimited,
    BistaticWorld,
    CalibrationFibre,
    CircularPath,
    Dechirped,
    Dwell,
    EverySample,
    Fleet,
    Flight,
    GroundMovers,
    ImageReflectivity,
    Jitter,
    KSea,
    LadarWorld,
    LetterE,
    LogAmplitude,
    MeasuredTrack,
    MovingPoints,
    Navigation,
    Offset,
    OrbitTransmit,
    PathFluctuation,
    PathWorld,
    Pattern,
    PlaneGround,
    PointCloud,
    Points,
    Polynomial,
    PolynomialRotation,
    PolynomialTransmit,
    QuadraticInSweep,
    RandomPoints,
    RandomWalk,
    RecordedPath,
    RetroAndBrokenLine,
    Satellite,
    Scatterers,
    Ship,
    SideBeam,
    Sinusoid,
    Speckle,
    SpreadRows,
    StartPhase,
    StraightPath,
    StripmapWorld,
    Sway,
    TurntableWorld,
    VibrationSpectrum,
)
from torchsar.scene.motion import Tones
from torchsar.scene.movers import Bend, Movers
from torchsar.study.names import registry as factories

DOUBLE = torch.complex128
TRIALS = 3  # no other dim of these simulations has three entries
Outputs = dict[str, Tensor]
Run = Callable[[Any, Draws], Outputs]


def double(*values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def outputs(made: tuple[Recording, Truth]) -> Outputs:
    """Every tensor of a recording and of its truth, by name."""
    recording, truth = made
    clean = {} if truth.clean is None else {"clean": truth.clean.signal.data}
    return {"data": recording.signal.data, **clean, **recording.aux, **truth.values}


RECEIVER = small_bistatic(channel_m=(-0.4, 0.4))
TURNTABLE = InverseRadar(10e9, 1e9, 5e3, rotation_rad_s=0.4, pulse_s=4e-6)
LADAR = small_ladar(sample_rate_hz=8e6)
POINTS = Points([0.0, 0.01], [0.1, 0.25], [1.0, 0.5], random_phase=True)
MOVING = MovingPoints([3.0, -4.0], [1.0, 2.0], [0.0, 1.0], [0.0, 20.0], random_phase=True)


def stripmap(world: StripmapWorld, draws: Draws, samples: int = 40, **impairments: Any) -> Outputs:
    return outputs(simulate(small_radar(), world, 20, samples, draws, impairments, dtype=DOUBLE))


def turntable(world: TurntableWorld, draws: Draws) -> Outputs:
    return outputs(simulate_turntable(TURNTABLE, world, 12, 64, draws, dtype=DOUBLE))


def ladar(world: LadarWorld, draws: Draws) -> Outputs:
    return outputs(simulate_ladar(LADAR, world, 4, draws, dtype=DOUBLE))


def ladar_record(world: LadarWorld, draws: Draws) -> Outputs:
    return outputs(simulate_ladar_record(LADAR, world, 4, draws, dtype=DOUBLE))


def bistatic(world: BistaticWorld, draws: Draws, samples: int | None = 24, **impairments: Any) -> Outputs:
    made = simulate_bistatic(RECEIVER, world, 10, samples, draws, impairments=impairments, dtype=DOUBLE)
    return outputs(made)


def scene_of_points(scene: Any, draws: Draws) -> Outputs:
    return stripmap(StripmapWorld(scene, snr_db=10.0), draws)


def scene_beyond_the_line(scene: Any, draws: Draws) -> Outputs:
    """Echoes that fit the line in some trials only."""
    return stripmap(StripmapWorld(scene), draws, 600)


def target_of_a_turntable(scene: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(scene, snr_db=10.0), draws)


def target_of_dechirped_pulses(scene: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(scene, snr_db=10.0, fidelity=Dechirped()), draws)


def target_of_a_ladar(scene: Any, draws: Draws) -> Outputs:
    return ladar(LadarWorld(scene, snr_db=10.0, gate_m=(-0.45, 0.45)), draws)


def rotation_of_a_turntable(rotation: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(POINTS, rotation=rotation), draws)


def rotation_of_dechirped_pulses(rotation: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(POINTS, rotation=rotation, fidelity=Dechirped()), draws)


def motion_of_a_turntable(motion: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(POINTS, motion=(motion,)), draws)


def motion_of_dechirped_pulses(motion: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(POINTS, motion=(motion,), fidelity=Dechirped((motion,))), draws)


def start_phase(effect: Any, draws: Draws) -> Outputs:
    return turntable(TurntableWorld(POINTS, start_phase=(effect,)), draws)


def motion_of_a_ladar(motion: Any, draws: Draws) -> Outputs:
    return ladar(LadarWorld(POINTS, motion=(motion,), fidelity=QuadraticInSweep()), draws)


def motion_of_a_record(motion: Any, draws: Draws) -> Outputs:
    return ladar_record(LadarWorld(POINTS, motion=(motion,)), draws)


def scintillation(effect: Any, draws: Draws) -> Outputs:
    return ladar(LadarWorld(POINTS, log_amplitude=effect), draws)


def sweep_error_in_lines(error: Any, draws: Draws) -> Outputs:
    return ladar(LadarWorld(POINTS, sweep_error=error, calibration=CalibrationFibre(1e-7)), draws)


def sweep_error_in_samples(error: Any, draws: Draws) -> Outputs:
    return ladar(LadarWorld(POINTS, sweep_error=error, fidelity=EverySample()), draws)


def sweep_error_in_a_record(error: Any, draws: Draws) -> Outputs:
    return ladar_record(LadarWorld(POINTS, sweep_error=error), draws)


def calibration(fibre: Any, draws: Draws) -> Outputs:
    error = SinusoidSweepError(2e6, 2.5e5, 20.0, -60.0)
    return ladar(LadarWorld(POINTS, sweep_error=error, calibration=fibre), draws)


def moving_scene(scene: Any, draws: Draws) -> Outputs:
    return bistatic(BistaticWorld(scene, Pattern(), snr_db=20.0), draws)


def moving_scene_on_one_line(scene: Any, draws: Draws) -> Outputs:
    return bistatic(BistaticWorld(Fleet({"tested": scene, "points": MOVING}), Pattern()), draws, None)


def gate(of_targets: Any, draws: Draws) -> Outputs:
    return bistatic(BistaticWorld(MOVING, of_targets), draws)


def transmitter(transmit: Any, draws: Draws) -> Outputs:
    return bistatic(BistaticWorld(MOVING, Pattern(), KSea(margin_s=0.0), transmit=transmit), draws)


def sea(surface: Any, draws: Draws) -> Outputs:
    return {"data": sea_echo(surface, RECEIVER, 8, 12, Pattern(), draws, DOUBLE)}


def channel_impairment(error: Any, draws: Draws) -> Outputs:
    return bistatic(BistaticWorld(MOVING, Pattern()), draws, tested=error)


def impairment(tested: Any, draws: Draws) -> Outputs:
    return stripmap(StripmapWorld(Speckle(9, 10.0, 60.0), snr_db=20.0), draws, tested=tested)


def impairment_before_others(tested: Any, draws: Draws) -> Outputs:
    """Impairments whose draws depend on the lines that are left."""
    others = {"repeated": RepeatedLines(2), "gaps": LostGaps(1, 2), "wrong": CorruptedNumbers(2)}
    return stripmap(StripmapWorld(Speckle(9, 10.0, 60.0)), draws, tested=tested, **others)


def echo_of_movers(movers: Any, draws: Draws) -> Outputs:
    return {"data": bistatic_echo(movers, RECEIVER, 10, 24, gate=Pattern(), dtype=DOUBLE)}


PULSES_S = torch.arange(40, dtype=torch.float64) / 100
STRAIGHT = StraightPath((0.0, -50.0, 30.0), (3.0, 0.0, 0.0))


def motion_of_a_flight(motion: Any, draws: Draws) -> Outputs:
    return {"position_m": Flight(STRAIGHT, Sway(y=(motion,))).drawn(draws, 0.39).position_m(PULSES_S)}


def navigation(kind: Any, draws: Draws) -> Outputs:
    return {"recorded_m": kind.recorded_m(draws, PULSES_S, STRAIGHT)}


def echo_along_a_path(draws: Draws, **world: Any) -> Outputs:
    radar = InverseRadar(9.6e9, 50e6, 100.0)
    known = {"scene": RandomPoints(4, 10.0, 6.0), "transmitter": Flight(STRAIGHT)}
    return outputs(simulate_path(radar, PathWorld(**{**known, **world}), 12, 64, draws, dtype=DOUBLE))


def ground_of_a_path(ground: Any, draws: Draws) -> Outputs:
    return echo_along_a_path(draws, ground=ground)


def beam_of_a_path(beam: Any, draws: Draws) -> Outputs:
    return echo_along_a_path(draws, beam=beam)


def path_world(world: Any, draws: Draws) -> Outputs:
    return outputs(simulate_path(InverseRadar(9.6e9, 50e6, 100.0), world, 12, 64, draws, dtype=DOUBLE))


def echo_of_a_bend(bend: Any, draws: Draws) -> Outputs:
    return echo_of_movers(Movers(3 * FOUR, FOUR, FOUR, FOUR, FOUR.to(DOUBLE), bend), draws)


def echo_of_scatterers(scatterers: Any, draws: Draws) -> Outputs:
    return {"data": ladar_echo(scatterers, LADAR, 4, dtype=DOUBLE)}


@dataclass(frozen=True)
class Case:
    """A class, the parameters that it must have, three values of each parameter that may differ
    between trials, and the simulations that its object goes into.
    """

    kind: type
    given: Mapping[str, Any]
    values: Mapping[str, Sequence[Any]]
    runs: tuple[Run, ...]

    def made(self, **changes: Any) -> Any:
        return self.kind(**{**self.given, **changes})


ORBIT = Orbit.at_height(36_500e3, inclination_deg=60.0, raan_deg=195.5, argument_of_perigee_deg=270.0)
SEEN = seen_point(*ORBIT.state(double(5.0)), 7.0, 30.0)[0].tolist()
TRACK_S = torch.linspace(-1e-3, 4e-3, 41, dtype=torch.float64)
WAVE = torch.sin(2e3 * TRACK_S)
IMAGE = torch.rand(4, 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
FOUR = double(0.1, 0.2, -0.1, 0.3)
FOURS = (FOUR, 2 * FOUR, -0.5 * FOUR)
LEVELS = (0.0, 6.0, 10.0)
BAND = {"lowest_hz": (50.0, 400.0, 900.0), "highest_hz": (1000.0, 1500.0, 4000.0), "slope": (-2.0, -1.5, 0.0)}
RMS = (1e-8, 1e-7, 5e-7)
RECTANGLE = {
    "azimuth_extent_m": (0.0, 5.0, 9.0),
    "range_extent_m": (1.0, 20.0, 90.0),
    "azimuth_m": (0.0, 1.0, -2.0),
    "range_m": (-9.0, 0.0, 9.0),
}
PHASES = (-40.0, 0.0, 70.0)
SWEEP_ERRORS = (sweep_error_in_lines, sweep_error_in_samples, sweep_error_in_a_record)
MOTIONS = (motion_of_a_turntable, motion_of_dechirped_pulses, motion_of_a_ladar, motion_of_a_record)
RANDOM_MOTIONS = (motion_of_a_ladar, motion_of_a_record)
TURNTABLES = (target_of_a_turntable, target_of_dechirped_pulses)
ROTATIONS = (rotation_of_a_turntable, rotation_of_dechirped_pulses)
LINES = (impairment, impairment_before_others)
IMPAIRMENTS = (
    ChannelImbalance,
    Tone,
    WideInterferer,
    Quantiser,
    Leakage,
    GroundAtRest,
    PulsedInterference,
    QuadratureError,
    GainSteps,
    GateJumps,
    PeriodicJitter,
    LostLines,
    LostPulses,
    WhitePhase,
    PhaseWalk,
    PhaseSinusoid,
)

CLOCKS = {
    "phase_rad": ([0.1, 0.2], [0.0, 1.0], [-1.0, 0.5]),
    "phase_sinusoid_rad": (0.1, 0.3, 1.0),
    "phase_walk_rad": (0.1, 0.3, 1.0),
    "delay_s": ([1e-10, 1e-9], [0.0, 1e-9], [-2e-9, 0.0]),
    "delay_sinusoid_s": (1e-10, 1e-9, 2e-9),
    "sinusoid_hz": (0.1, 5.0, 20.0),
    "direct_snr_db": LEVELS,
}

CASES = (
    Case(
        StripmapWorld,
        {"scene": Points([0.0, 6.0], [0.0, 30.0]), "snr_db": 10.0},
        {"velocity_m_s": (119.0, 120.0, 122.5), "doppler_hz": (-20.0, 0.0, 33.0), "snr_db": LEVELS},
        (stripmap,),
    ),
    Case(
        Dwell, {}, {"dwell_s": (0.01, 0.02, 0.04)}, (lambda beam, draws: stripmap(StripmapWorld(POINTS, beam), draws),)
    ),
    Case(
        Antenna, {}, {"length_m": (1.0, 2.0, 40.0)}, (lambda beam, draws: stripmap(StripmapWorld(POINTS, beam), draws),)
    ),
    Case(
        Points,
        {"azimuth_m": (0.0, 1.0), "range_m": (0.0, 9.0), "random_phase": True},
        {
            "azimuth_m": ([0.0, 1.0], [2.0, 3.0], [-1.0, 0.0]),
            "range_m": ([0.0, 1.0], [90.0, 300.0], [-20.0, 9.0]),
            "amplitude": ([1.0, 2.0], [0.5, 0.0], [3.0, 1.0]),
        },
        (scene_of_points, scene_beyond_the_line),
    ),
    Case(
        RandomPoints,
        {"count": 5, "azimuth_extent_m": 9.0, "range_extent_m": 40.0},
        {**RECTANGLE, "spread_db": LEVELS},
        (scene_of_points, scene_beyond_the_line),
    ),
    Case(
        Speckle,
        {"count": 7, "azimuth_extent_m": 9.0, "range_extent_m": 40.0, "texture_cells": (2, 3)},
        {**RECTANGLE, "level_db": LEVELS, "texture_shape": (0.5, 1.5, math.inf)},
        (scene_of_points,),
    ),
    Case(
        PointCloud,
        {"place_m": [[0.0, 0.0], [0.3, 0.2]], "fluctuation": "none"},
        {"azimuth_m": (-0.5, 0.0, 1.0), "range_m": (-5.0, 0.0, 8.0), "heading_deg": (0.0, 30.0, -90.0)},
        (scene_of_points,),
    ),
    Case(
        Scatterers,
        {"azimuth_m": 0.1 * FOUR, "range_m": FOUR, "amplitude": FOUR.to(DOUBLE)},
        {
            "azimuth_m": tuple(0.1 * x for x in FOURS),
            "range_m": FOURS,
            "amplitude": tuple((1 + 2j) * x for x in FOURS),
        },
        (echo_of_scatterers,),
    ),
    Case(
        TurntableWorld,
        {"scene": POINTS, "snr_db": 3.0},
        {"rotation_rad_s": (-0.3, 0.0, 0.4), "snr_db": LEVELS, "centre_deviation_m": (-1.0, 0.0, 0.5)},
        (turntable,),
    ),
    Case(
        TurntableWorld,
        {"scene": POINTS, "rotation": PolynomialRotation(0.3, (5.0,)), "fidelity": Dechirped()},
        {"snr_db": LEVELS, "centre_deviation_m": (-1.0, 0.0, 0.5)},
        (turntable,),
    ),
    Case(
        PolynomialRotation,
        {"omega_rad_s": 0.4},
        {"omega_rad_s": (0.2, 0.3, -0.5), "k": ([10.0, 100.0], [-9.0, 0.0], [0.0, -50.0])},
        ROTATIONS,
    ),
    Case(Aircraft, {"spacing_m": 9e-3}, {"heading_deg": (-30.0, 0.0, 75.0)}, TURNTABLES),
    Case(
        SpreadRows,
        {"rows": 4, "per_row": 2, "width": 0.5, "extent_m": 2.0, "range_step_m": 0.12, "range_cells": 64},
        {"width": (0.0, 0.5, 1.0), "extent_m": (0.3, 1.0, 4.0), "range_step_m": (0.05, 0.1, 0.12)},
        TURNTABLES,
    ),
    Case(
        Satellite,
        {"count": 90, "half_width_m": 1.6, "half_depth_m": 1.1},
        {
            "half_width_m": (1.0, 1.5, 2.0),
            "half_depth_m": (0.5, 1.0, 2.0),
            "tilt_rad": (-0.7, 0.0, 0.5),
            "corner_level": (0.5, 1.0, 2.0),
        },
        TURNTABLES,
    ),
    Case(
        Sinusoid,
        {"amplitude_m": 1e-7, "frequency_hz": 300.0},
        {"amplitude_m": (0.0, 1e-7, -3e-7), "frequency_hz": (0.0, 100.0, 900.0), "phase_deg": PHASES},
        MOTIONS,
    ),
    Case(Polynomial, {}, {"coefficients_m": ([0.01, 1.0], [0.0, 2.0], [-0.02, 0.0])}, MOTIONS),
    Case(StartPhase, {}, {"sigma_rad": (0.0, 0.5, 2.0)}, (start_phase,)),
    Case(
        VibrationSpectrum,
        {"rms_m": 1e-7, "lowest_hz": 50.0, "highest_hz": 1e3, "count": 7},
        {"rms_m": RMS, **BAND},
        RANDOM_MOTIONS,
    ),
    Case(PathFluctuation, {"rms_m": 1e-7, "lowest_hz": 50.0, "count": 7}, {"rms_m": RMS, **BAND}, RANDOM_MOTIONS),
    Case(LogAmplitude, {"rms": 0.2, "lowest_hz": 50.0, "count": 7}, {"rms": (0.0, 0.1, 0.5), **BAND}, (scintillation,)),
    Case(
        MeasuredTrack,
        {"time_s": TRACK_S, "displacement": 1e-7 * WAVE},
        {"displacement": (1e-7 * WAVE, 3e-7 * WAVE.square(), 0 * WAVE)},
        MOTIONS,
    ),
    Case(
        Tones,
        {"frequency_hz": 1e3 * FOUR.abs(), "cosine": 1e-7 * FOUR, "sine": 1e-7 * FOUR},
        {
            "frequency_hz": tuple(1e3 * x.abs() for x in FOURS),
            "cosine": tuple(1e-7 * x for x in FOURS),
            "sine": tuple(1e-7 * x for x in FOURS),
        },
        MOTIONS,
    ),
    Case(
        LadarWorld,
        {"scene": POINTS, "snr_db": 10.0},
        {"snr_db": LEVELS, "gate_m": ([0.0, 0.2], [0.2, 0.3], [-0.5, 0.5])},
        (ladar, ladar_record),
    ),
    Case(LetterE, {}, {"first_range_m": (-0.4, -0.3, 0.0), "spine_azimuth_m": (-0.08, 0.0, 0.1)}, (target_of_a_ladar,)),
    Case(
        RetroAndBrokenLine,
        {"range_m": -0.2},
        {
            "range_m": (-0.3, 0.0, 0.3),
            "azimuth_m": (-0.1, 0.0, 0.1),
            "retro_db": LEVELS,
            "line_db": LEVELS,
            "line_m": ([0.1, 0.2], [0.2, 0.3], [0.2, 0.1]),
            "line_azimuth_m": (0.0, 0.05, 0.1),
        },
        (target_of_a_ladar,),
    ),
    Case(
        CalibrationFibre,
        {"delay_s": 1e-7, "every_period": True},
        {"delay_s": (5e-8, 1e-7, 2e-7), "snr_db": LEVELS},
        (calibration,),
    ),
    Case(
        PolynomialSweepError,
        {"up_hz": (1e5, 3e11), "down_hz": (-2e5,)},
        {"up_hz": ([1e5, 3e11], [0.0, 1e11], [-1e5, 0.0]), "down_hz": ([1e5], [0.0], [-3e5])},
        SWEEP_ERRORS,
    ),
    Case(
        SinusoidSweepError,
        {"amplitude_hz": 2e6, "frequency_hz": 2.5e5},
        {
            "amplitude_hz": (0.0, 1e6, 2e6),
            "frequency_hz": (1e5, 2e5, 3e5),
            "phase_up_deg": PHASES,
            "phase_down_deg": PHASES,
        },
        SWEEP_ERRORS,
    ),
    Case(BistaticWorld, {"scene": MOVING, "gate": Pattern(), "snr_db": 3.0}, {"snr_db": LEVELS}, (bistatic,)),
    Case(BandLimited, {}, {"duration_s": (0.01, 0.02, 0.04)}, (gate,)),
    Case(Pattern, {}, {"element_m": (0.4, 0.8, 3.0)}, (gate,)),
    Case(PolynomialTransmit, {}, {"coefficients": ([-3.0, 0.1], [0.0, 0.02], [4.0, -0.5])}, (transmitter,)),
    Case(
        OrbitTransmit,
        {"orbit": ORBIT, "point_m": SEEN, "epoch_s": 5.0},
        {"point_m": (SEEN, [SEEN[0] + 9.0, *SEEN[1:]], [*SEEN[:2], SEEN[2] - 50.0]), "epoch_s": (0.0, 5.0, 9.0)},
        (transmitter,),
    ),
    Case(
        MovingPoints,
        {
            "u_r_m_s": (3.0, -4.0),
            "u_a_m_s": (1.0, 2.0),
            "azimuth_m": (0.0, 1.0),
            "range_m": (0.0, 9.0),
            "random_phase": True,
        },
        {
            "u_r_m_s": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "u_a_m_s": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "azimuth_m": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "range_m": ([3.0, -4.0], [0.0, 20.0], [9.0, 2.0]),
            "amplitude": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
        },
        (moving_scene, moving_scene_on_one_line),
    ),
    Case(
        Ship,
        {"u_r_m_s": 1.0, "u_a_m_s": 2.0, "count": 5, "range_cells": 2},
        {
            "u_r_m_s": (-3.0, 0.0, 6.0),
            "u_a_m_s": (-3.0, 0.0, 6.0),
            "azimuth_m": (-3.0, 0.0, 6.0),
            "range_m": (-3.0, 0.0, 6.0),
            "length_m": (0.0, 20.0, 100.0),
            "cell_m": (0.0, 6.0, 7.0),
            "level_db": LEVELS,
        },
        (moving_scene, moving_scene_on_one_line),
    ),
    Case(
        GroundMovers,
        {
            "outward_m_s": (1.0, 2.0),
            "along_m_s": (3.0, 4.0),
            "azimuth_m": (0.0, 1.0),
            "ground_range_m": (3990.0, 4001.0),
        },
        {
            "outward_m_s": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "along_m_s": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "azimuth_m": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "ground_range_m": ([4000.0, 4004.0], [3999.0, 4001.0], [4010.0, 3990.0]),
            "amplitude": ([3.0, -4.0], [0.0, 1.0], [9.0, 2.0]),
            "outward_m_s2": ([0.3, -0.4], [0.0, 0.1], [0.9, 0.2]),
            "along_m_s2": ([0.3, -0.4], [0.0, 0.1], [0.9, 0.2]),
            "towards_transmitter": ([0.3, -0.4], [0.0, 0.1], [0.9, 0.2]),
        },
        (moving_scene, moving_scene_on_one_line),
    ),
    Case(
        Movers,
        {"u_r_m_s": FOUR, "u_a_m_s": FOUR, "y0_m": FOUR, "range_m": FOUR, "amplitude": FOUR.to(DOUBLE)},
        {
            **dict.fromkeys(("u_r_m_s", "u_a_m_s", "y0_m", "range_m"), FOURS),
            "amplitude": tuple((1 + 2j) * x for x in FOURS),
        },
        (echo_of_movers,),
    ),
    Case(
        Bend,
        {field.name: FOUR for field in fields(Bend)},
        {field.name: FOURS for field in fields(Bend)},
        (echo_of_a_bend,),
    ),
    Case(KSea, {"margin_s": 0.0}, {"power_db": LEVELS, "shape": (0.5, 3.0, math.inf)}, (sea,)),
    Case(
        ImageReflectivity,
        {"intensity": IMAGE, "azimuth_extent_m": 40.0, "range_extent_m": 90.0, "margin_s": 0.0},
        {
            "power_db": LEVELS,
            "intensity": (IMAGE, IMAGE.square(), 1 + IMAGE),
            "azimuth_extent_m": (10.0, 20.0, 90.0),
            "range_extent_m": (30.0, 60.0, 70.0),
        },
        (sea,),
    ),
    Case(
        ChannelErrors,
        {},
        {
            "phase_rad": ([0.1, 0.2], [0.0, 1.0], [-1.0, 0.5]),
            "gain_db": ([0.1, 0.2], [0.0, 1.0], [-1.0, 0.5]),
            "delay_s": ([1e-9, 0.0], [0.0, 5e-9], [-2e-9, 2e-9]),
        },
        (channel_impairment,),
    ),
    Case(
        SynchronisationError,
        {"phase_sinusoid_rad": 0.1, "phase_walk_rad": 0.1},
        CLOCKS,
        (channel_impairment,),
    ),
    Case(
        ChannelImbalance,
        {"gain": (1.0, 1.2), "phase_rad": (0.0, 0.3)},
        {"gain": ([1.0, 1.2], [2.0, 0.5], [1.0, 1.0]), "phase_rad": ([0.0, 0.3], [1.0, 2.0], [-1.0, 0.0])},
        (impairment,),
    ),
    Case(
        Tone,
        {"over_signal_db": 10.0, "frequency_hz": 3e6, "wander_hz": 1e4, "share": 0.4},
        {
            "over_signal_db": LEVELS,
            "frequency_hz": (-3e6, 0.0, 9e6),
            "drift_hz": (-1e5, 0.0, 1e6),
            "wander_hz": (0.0, 1e4, 1e5),
            "rate_hz_s": (-1e9, 0.0, 1e10),
            "share": (0.01, 0.5, 1.0),
        },
        (impairment,),
    ),
    Case(
        Tone,
        {"over_signal_db": 10.0, "frequency_hz": 3e6, "coherent": True},
        {"frequency_hz": (-3e6, 0.0, 9e6), "drift_hz": (-1e5, 0.0, 1e6)},
        (impairment,),
    ),
    Case(
        WideInterferer,
        {"over_signal_db": 10.0, "frequency_hz": 3e6, "bandwidth_hz": 1e6},
        {"over_signal_db": LEVELS, "frequency_hz": (-3e6, 0.0, 9e6), "share": (0.01, 0.5, 1.0)},
        (impairment,),
    ),
    Case(Quantiser, {"bits": 4}, {"bits": (1, 4, 8), "rms_levels": (3.0, 6.6, 7.4)}, (impairment,)),
    Case(
        Leakage,
        {"over_signal_db": 0.0, "position": 0.5},
        {
            "over_signal_db": LEVELS,
            "sample_cycles": (0.0, 0.1, -0.4),
            "pulse_cycles": (0.0, 0.1, -0.4),
            "walk_rad": (0.0, 0.1, 1.0),
            "position": (0.0, 0.5, 1.0),
        },
        (impairment, channel_impairment),
    ),
    Case(
        GroundAtRest,
        {"over_signal_db": 0.0},
        {"over_signal_db": LEVELS, "band_cycles": (0.02, 0.2, 1.0)},
        (impairment,),
    ),
    Case(
        PulsedInterference,
        {"over_signal_db": 0.0, "prf_hz": 2e5, "duration_s": 4e-7, "bandwidth_hz": 5e6},
        {
            "over_signal_db": LEVELS,
            "prf_hz": (2e5, 3e5, 1e6),
            "duration_s": (1e-7, 4e-7, 1e-6),
            "bandwidth_hz": (0.0, 5e6, 2e7),
            "frequency_hz": (-3e6, 0.0, 9e6),
        },
        (impairment,),
    ),
    Case(PulsedInterference, {"over_signal_db": 0.0, "prf_hz": 2e5, "duration_s": 4e-7, "bursts": True}, {}, LINES),
    Case(
        QuadratureError,
        {},
        {"gain_db": (0.0, 1.0, -2.0), "phase_deg": (0.0, 3.0, -9.0)},
        (impairment, channel_impairment),
    ),
    Case(GainSteps, {}, {"step_db": (0.0, 1.0, 6.0)}, (impairment, channel_impairment)),
    Case(GateJumps, {"cells": 3.0}, {"cells": (0.0, 3.0, 9.0), "share": (0.1, 0.5, 1.0)}, (impairment,)),
    Case(GateJumps, {"cells": 3.0, "share": 0.2, "lasting": True}, {"share": (0.1, 0.5, 1.0)}, (impairment,)),
    Case(
        PeriodicJitter,
        {"offset_samples": (0.0, 0.1), "pilot_samples": 40},
        {
            "offset_samples": ([0.0, 0.1], [0.2, -0.2], [0.0, 0.0]),
            "pilot_cycles": (0.1, 0.2, 0.37),
            "pilot_snr_db": LEVELS,
        },
        (impairment,),
    ),
    Case(LostLines, {}, {"fraction": (0.0, 0.1, 0.4)}, LINES),
    Case(LostPulses, {}, {"fraction": (0.0, 0.1, 0.4)}, LINES),
    Case(WhitePhase, {}, {"limit_rad": (0.0, 1.0, 3.0)}, (impairment,)),
    Case(PhaseWalk, {}, {"step_rad": (0.0, 0.1, 3.0)}, (impairment,)),
    Case(PhaseSinusoid, {}, {"amplitude_rad": (0.0, 1.0, 30.0), "cycles": (0.0, 2.5, 7.0)}, (impairment,)),
    Case(Offset, {}, {"metres": (-0.5, 0.0, 2.0)}, (motion_of_a_flight,)),
    Case(Jitter, {"step_s": 0.03}, {"rms_m": (0.0, 1e-3, 0.2)}, (motion_of_a_flight,)),
    Case(RandomWalk, {"step_s": 0.03}, {"m_per_root_s": (0.0, 1e-3, 0.2)}, (motion_of_a_flight,)),
    Case(
        PlaneGround,
        {},
        {"level_m": (-1.0, 0.0, 2.0), "slope_x": (0.0, 0.1, -0.2), "slope_y": (0.0, 0.1, -0.2)},
        (ground_of_a_path,),
    ),
    Case(
        SideBeam,
        {"width_deg": 20.0, "sway_deg": 1.0, "sway_hz": 3.0},
        {
            "width_deg": (5.0, 20.0, 40.0),
            "squint_deg": (0.0, 2.0, -3.0),
            "yaw_deg": (0.0, 2.0, -3.0),
            "sway_deg": (0.0, 2.0, -3.0),
            "sway_hz": (0.5, 2.0, 5.0),
        },
        (beam_of_a_path,),
    ),
    Case(
        PathWorld,
        {"scene": RandomPoints(4, 10.0, 6.0), "transmitter": Flight(STRAIGHT)},
        {"snr_db": LEVELS},
        (path_world,),
    ),
    Case(Navigation, {}, {"latency_s": (-0.02, 0.0, 0.035), "step_m": (0.0, 0.01, 0.5)}, (navigation,)),
)

# impairments that a config names by factories
RESPONSE = dict.fromkeys(("quadratic_rad", "cubic_rad", "ripple_rad", "slope_db"), (0.0, 0.5, 2.0))
FACTORIES = (
    Case(
        smooth_response,  # pyright: ignore[reportArgumentType]
        {"ripple_rad": 0.3},
        {**RESPONSE, "ripple_cycles": (1.0, 2.5, 4.0), "amplitude_ripple_db": (0.0, 1.0, 2.0)},
        (impairment,),
    ),
    Case(
        factories.drift,  # pyright: ignore[reportArgumentType]
        {},
        {"velocity_m_s": (-0.01, 0.0, 0.02), "acceleration_m_s2": (0.0, 1.0, 2.0)},
        (motion_of_a_ladar,),
    ),
    Case(
        factories.k_sea,  # pyright: ignore[reportArgumentType]
        {"margin_s": 0.0},
        {"cnr_db": LEVELS, "shape": (0.5, 1.5, 9.0)},
        (sea,),
    ),
    Case(
        factories.dechirped,  # pyright: ignore[reportArgumentType]
        {},
        {"track_m": ([0.01, 1.0], [0.0, 2.0], [-0.02, 0.0])},
        (lambda fidelity, draws: turntable(TurntableWorld(POINTS, fidelity=fidelity), draws),),
    ),
)

# parameters annotated with Tensor that have no case, and plain numbers, each with the reason
NOT_PER_TRIAL = {
    (Scatterers, "height_m"): "heights of the points of a cloud, which all trials share",
    (MeasuredTrack, "time_s"): "times of measurement, which all trials share",
    (RecordedPath, "start_s"): "time of the log at the first pulse, which all trials share",
    (Navigation, "rate_hz"): "decides how many records there are",
    (PathWorld, "window_range_m"): "a setting of the receiver, which all trials share",
    (Aircraft, "spacing_m"): "decides how many scatterers there are",
    (Aircraft, "length_m"): "decides how many scatterers there are",
    (Aircraft, "width_m"): "decides how many scatterers there are",
    (KSea, "margin_s"): "decides how many cells there are",
    (KSea, "cell_m"): "decides how many numbers of texture are drawn",
    (ImageReflectivity, "margin_s"): "decides how many cells there are",
    (WideInterferer, "bandwidth_hz"): "decides how many numbers are drawn",
    **{(StraightPath, name): "the nominal path, which all trials share" for name in ("start_m", "velocity_m_s")},
    **{
        (CircularPath, name): "the nominal path, which all trials share"
        for name in ("radius_m", "height_m", "start_rad", "rate_rad_s")
    },
    (Jitter, "step_s"): "decides how many numbers are drawn",
    (RandomWalk, "step_s"): "decides how many numbers are drawn",
}


def mentions(hint: Any, what: type) -> bool:
    """Whether a type or a part of it is `what`."""
    return hint is what or any(mentions(arm, what) for arm in typing.get_args(hint) if arm is not Ellipsis)


def public_classes() -> list[type]:
    found = {getattr(module, name) for module in (torchsar.scene, torchsar.echo) for name in module.__all__}
    made = (kind for kind in found if inspect.isclass(kind) and is_dataclass(kind) and not inspect.isabstract(kind))
    return sorted(made, key=lambda kind: kind.__name__)


def parameters(kind: type) -> dict[str, Any]:
    """Types of the parameters of a constructor; callables are left out, they are no numbers."""
    hints = typing.get_type_hints(kind.__init__)
    return {field.name: hints[field.name] for field in fields(kind) if not mentions_callable(hints[field.name])}


def mentions_callable(hint: Any) -> bool:
    return typing.get_origin(hint) is Callable or any(mentions_callable(arm) for arm in typing.get_args(hint))


@pytest.mark.parametrize("kind", public_classes(), ids=lambda kind: kind.__name__)
def test_every_parameter_has_a_case_or_a_reason(kind: type) -> None:
    covered = {name for case in CASES if case.kind is kind for name in case.values}
    for name, hint in parameters(kind).items():
        if mentions(hint, Tensor):
            assert (name in covered) != ((kind, name) in NOT_PER_TRIAL), f"{kind.__name__}.{name}: no case, no reason"
        elif mentions(hint, float):
            assert (kind, name) in NOT_PER_TRIAL, f"{kind.__name__}.{name} is a plain number without a reason"


def test_reasons_are_of_parameters_that_exist() -> None:
    stale = [(kind.__name__, name) for kind, name in NOT_PER_TRIAL if name not in parameters(kind)]
    assert not stale


def per_trial(values: Sequence[Any]) -> Any:
    """Three values of a parameter as one: numbers in a tensor, lists of numbers entry by entry,
    tensors stacked.
    """
    if isinstance(values[0], Tensor):
        return torch.stack(list(values))
    if isinstance(values[0], list):
        return [double(*entries) for entries in zip(*values, strict=True)]
    return double(*values)


def of_trial(x: Tensor, trial: int) -> Tensor:
    return x[trial] if x.ndim and x.shape[0] == TRIALS else x


def assert_trials_equal_numbers(run: Run, whole: Any, single: Sequence[Any]) -> None:
    """Each trial of the batch with its number alone and the same draws: to 1e-11 of the largest
    value. A frequency may differ in its last bit, 1e-16, and a phase may be 1e4 rad.
    """
    draws = Draws(5, trials=range(TRIALS))
    batch, numbers = run(whole, draws), [run(one, draws) for one in single]
    assert any(not torch.equal(x, numbers[-1][name]) for name, x in numbers[0].items()), "it changes nothing"
    for trial, alone in enumerate(numbers):
        assert set(alone) == set(batch)
        for name, expected in alone.items():
            found, expected = of_trial(batch[name], trial), of_trial(expected, trial)
            assert found.dtype == expected.dtype, name
            if name.endswith("lost_number"):  # filled up with -1 where other trials lose more
                assert bool((found[len(expected) :] == -1).all())
                found = found[: len(expected)]
            assert found.shape == expected.shape, (name, found.shape, expected.shape)
            if found.dtype.is_floating_point or found.is_complex():
                level = float(expected.abs().max()) if expected.numel() else 0.0
                torch.testing.assert_close(found, expected, rtol=0, atol=1e-11 * level)
            else:
                assert torch.equal(found, expected), name


def contracts(cases: Sequence[Case]) -> list[Any]:
    return [
        pytest.param(case, name, run, id=f"{case.kind.__name__}-{name}-{run.__name__.strip('<>')}")
        for case in cases
        for name in case.values
        for run in case.runs
    ]


@pytest.mark.parametrize("case, name, run", contracts((*CASES, *FACTORIES)))
def test_a_trial_equals_its_number(case: Case, name: str, run: Run) -> None:
    values = case.values[name]
    assert_trials_equal_numbers(run, case.made(**{name: per_trial(values)}), [case.made(**{name: v}) for v in values])


def takes_a_table(case: Case, name: str) -> bool:
    """Whether a list of numbers may also be one tensor (..., entry)."""
    hint = parameters(case.kind)[name]
    return isinstance(case.values[name][0], list) and Tensor in typing.get_args(hint)


@pytest.mark.parametrize(
    "case, name, run",
    [p for p in contracts(CASES) if takes_a_table(*p.values[:2])],  # pyright: ignore[reportArgumentType]
)
def test_a_row_of_a_table_equals_its_numbers(case: Case, name: str, run: Run) -> None:
    values = case.values[name]
    assert_trials_equal_numbers(run, case.made(**{name: double(*values)}), [case.made(**{name: v}) for v in values])


NUMBERS = [p for p in contracts(CASES) if isinstance(p.values[0].values[p.values[1]][0], float)]  # pyright: ignore


@pytest.mark.parametrize("case, name, run", NUMBERS)
def test_another_number_of_trials_is_refused_in_one_sentence(case: Case, name: str, run: Run) -> None:
    values = case.values[name]
    with pytest.raises(ValueError, match=f"{name} of {case.kind.__name__} must be a number or one for each of the 3"):
        run(case.made(**{name: double(*values, values[0])}), Draws(1, trials=range(TRIALS)))


@pytest.mark.parametrize("case, name, run", NUMBERS)
def test_a_bad_number_of_one_trial_is_refused(case: Case, name: str, run: Run) -> None:
    first, _, last = case.values[name]
    with pytest.raises(ValueError, match="got nan at index 1"):
        case.made(**{name: double(first, math.nan, last)})


@pytest.mark.parametrize("trigger_s", [(0.0, 1e-6, 2.5e-6)])
def test_trigger_times_differ_between_trials(trigger_s: tuple[float, ...]) -> None:
    motion = (Sinusoid(1e-7, 900.0), PathFluctuation(1e-7))
    world = LadarWorld(POINTS, motion, LogAmplitude(0.2), 10.0)

    def run(trigger: Any, draws: Draws) -> Outputs:
        return outputs(
            simulate_ladar_record(LADAR, world, 4, draws, trigger_s=trigger, trigger_known=True, dtype=DOUBLE)
        )

    assert_trials_equal_numbers(run, double(*trigger_s), trigger_s)


def test_truths_of_many_trigger_times_are_those_of_each() -> None:
    """More different times than have nodes of their own."""
    world = LadarWorld(POINTS, (Sinusoid(1e-6, 2e4), Polynomial([0.01, 3.0])))
    trigger = torch.linspace(0, 1e-5, 40, dtype=torch.float64)
    draws = Draws(1, trials=range(40))
    _, truth = simulate_ladar_record(LADAR, world, 4, draws, trigger_s=trigger)
    for trial in (0, 7, 33):
        _, alone = simulate_ladar_record(LADAR, world, 4, draws, trigger_s=float(trigger[trial]))
        for name in ("velocity_m_s", "range_error_m", "range_error_up_m"):
            expected = alone.values[name][trial]
            level = float(expected.abs().max())
            torch.testing.assert_close(truth.values[name][trial], expected, rtol=0, atol=1e-11 * level)


def test_without_trials_of_the_draws_the_parameters_are_the_trials() -> None:
    world = StripmapWorld(RandomPoints(4, 9.0, double(10.0, 20.0)), velocity_m_s=double(119.0, 121.0))
    assert stripmap(world, Draws(1))["data"].shape == (2, 20, 40)
    with pytest.raises(ValueError, match="parameters per trial must all have the same number of trials"):
        stripmap(StripmapWorld(RandomPoints(4, 9.0, double(1.0, 2.0)), snr_db=double(1.0, 2.0, 3.0)), Draws(1))


def test_the_gate_of_a_sea_is_one_for_all_trials() -> None:
    for of in (BandLimited(double(1.0, 2.0)), Pattern(double(1.0, 2.0))):
        with pytest.raises(ValueError, match="of the gate of a sea must be one number, .* got shape"):
            sea_echo(KSea(), RECEIVER, 8, 12, of, Draws(1), DOUBLE)


@pytest.mark.parametrize("name", ["velocity_m_s", "doppler_hz", "snr_db"])
def test_single_precision_stays_single(name: str) -> None:
    world = StripmapWorld(POINTS, **{name: double(110.0, 120.0, 130.0)})
    recording, _ = simulate(small_radar(), world, 9, 40, Draws(1, trials=range(TRIALS)))
    assert recording.signal.data.dtype == torch.complex64


@pytest.mark.parametrize(
    "case, name", [(case, name) for case in CASES for name in case.values if issubclass(case.kind, IMPAIRMENTS)]
)
def test_impairments_keep_single_precision(case: Case, name: str) -> None:
    tested = case.made(**{name: per_trial(case.values[name])})
    recording, _ = simulate(
        small_radar(), StripmapWorld(POINTS), 20, 40, Draws(1, trials=range(TRIALS)), {"tested": tested}
    )
    assert recording.signal.data.dtype == torch.complex64
    assert all(not x.is_complex() or x.dtype == torch.complex64 for x in recording.aux.values())
