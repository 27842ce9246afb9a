"""The table of functions of numbers, and of names that need no row, with the reason.

`NUMBERS` are calls with numbers; `REASONS` says of every public name that has no row in `stages`,
`functions` or here why it has none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from tests.table.functions import F64, REBUILD, ramp
from tests.table.stages import BISTATIC, LADAR, RADAR, TURNTABLE
from torchsar import compensate, core, echo, metrics, multichannel, radar, repair, scene
from torchsar.compensate.radial import trajectory
from torchsar.core import Draws, Stage
from torchsar.focus import image_lines, reference
from torchsar.multichannel.azimuth import azimuth_filter
from torchsar.multichannel.response import band_matrix
from torchsar.radar.bistatic import polynomial_range, receive_range
from torchsar.scene.sea import gamma_from_normal

REASONS: dict[str, str] = {
    "core.Stage": "the base class of all stages",
    "core.counts": "counts codes, not samples; tests/core/test_outcome.py",
    "core.worst": "joins codes, not samples; tests/core/test_outcome.py",
    "core.use": "names connections; takes no numbers",
    "core.checked_samples": "the check itself; tests/core/test_core.py",
    "core.refuse_non_finite": "the check itself; tests/core/test_core.py",
    "core.take": "index arithmetic that callers inside the package have checked",
    "core.per_trial": "appends dimensions; no arithmetic",
    "core.device_fault": "takes a device only; tests/core/test_host.py",
    "core.host_value": "reads one number",
    "core.check_value": "reads numbers; tests/core/test_host.py",
    "core.gathered_checks": "takes no arguments; tests/core/test_host.py",
    "core.real_dtype": "takes a dtype only",
    "radar.geometry_of": "builds a geometry, whose classes check their fields; tests/focus/test_spotlight.py",
    "io.fmcw_recording": "makes a whole recording; tests/io/test_fmcw.py",
    "repair.regular_lines": "takes a whole recording; tests/repair/test_placing.py",
    "radar.read_track": "reads a file; tests/radar/test_track.py",
    "io.import_recording": "reads and writes files; tests/io/test_sidecar.py",
    "io.read_images": "reads a file; tests/io/test_export.py",
    "io.write_netcdf": "writes a file; tests/io/test_export.py",
    "io.read_array": "reads a file; tests/scene/test_sea.py",
    "io.read_points": "reads a file; tests/study/test_scene_files.py",
    "io.read_inverse": "reads a file; tests/io/test_damaged.py",
    "io.read_path": "reads a file; tests/io/test_damaged.py",
    "io.write_strip_geotiff": "writes a file; tests/io/test_geotiff.py",
    "io.read_stripmap": "reads a file; tests/io/test_damaged.py",
    "io.read": "reads a file; tests/io/test_formats.py",
    "io.read_cphd": "reads a file; tests/io/test_formats.py",
    "io.read_history": "reads a file; tests/io/test_formats.py",
    "io.read_sicd": "reads a file; tests/io/test_formats.py",
    "io.write_cphd": "writes a file; tests/io/test_cphd.py",
    "io.write_geotiff": "writes a file; tests/io/test_geotiff.py",
    "io.write_sicd": "writes a file; tests/io/test_sicd.py",
    "multichannel.MoversImage": "needs seconds for one scene; tests/multichannel/test_scene_image.py",
    "multichannel.ImageMovers": "needs seconds for one scene; tests/multichannel/test_scene_image.py",
    "focus.PolarFormat": "resamples frequencies of a geometry; tests/focus/test_polar.py",
    "focus.SpotlightBackprojection": "the stage of backproject_spotlight, which is in the table",
    "focus.PathImage": "the base class of TileImage, OmegaKImage and DirectImage",
    "focus.OmegaKImage": "the stage of compensated_omega_k; tests/focus/test_motion_compensation.py",
    "focus.TileImage": "the stage of image_tiles, which is in the table; tests/focus/test_path_image.py",
    "focus.SpotlightImage": "a TileImage on a grid of its own; tests/focus/test_spotlight_image.py",
    "focus.DirectImage": "the stage of backproject, which is in the table; tests/focus/test_path_image.py",
    "focus.focus_strip": "runs a stage over blocks of lines; tests/focus/test_strip.py",
    "focus.write_strip": "writes a file; tests/focus/test_strip.py",
    "focus.plan_strip": "counts lines and bytes; tests/focus/test_strip.py",
    "radar.range_coefficients": "works on an Orbit, whose class checks it; tests/scene/test_orbit.py",
    "radar.seen_point": "works on a satellite's position; tests/scene/test_orbit.py",
    "radar.sweep_middles": "reads an axis that the radar has made",
    "radar.timing_diagram": "checks all its arguments; tests/scene/test_orbit.py",
    "echo.Simulate": "calls the function of its world; tests/core/test_chain_ends.py",
    "echo.Impair": "applies an impairment, whose class checks it; tests/core/test_chain_ends.py",
    "metrics.Measure": "calls a function; tests/core/test_chain_ends.py",
    "echo.apply_impairments": "applies impairments, whose classes check them; tests/echo",
    "echo.bistatic_echo": "the echo of simulate_bistatic, which is in the table",
    "echo.path_echo": "the echo of simulate_path, which is in the table",
    "echo.dechirped_echo": "the echo of simulate_turntable with a pulse length; tests/focus/test_dechirped.py",
    "echo.ladar_echo": "the echo of simulate_ladar, which is in the table",
    "echo.stripmap_echo": "the echo of simulate, which is in the table",
    "echo.turntable_echo": "the echo of simulate_turntable, which is in the table",
    "compensate.path_autofocus": "needs a path; tests/compensate/test_path_autofocus.py",
    "compensate.path_phase": "compensate.autofocus, which is in the table, through tiles; tests/compensate/"
    "test_path_autofocus.py",
    "compensate.CorrectPath": "subtracts positions",
    "compensate.correct_sweep_motion": "the function of the stage, which is in the table",
    "compensate.PathAutofocus": "the stage of compensate.path_autofocus",
    "compensate.strip_autofocus": "needs a path; tests/compensate/test_strip_autofocus.py",
    "compensate.StripAutofocus": "the stage of compensate.strip_autofocus",
    "compensate.PathPhase": "the stage of compensate.path_phase",
    "metrics.line_of_sight_bound_m": "works on a scene of scatterers; tests/metrics/test_path_bounds.py",
    "compensate.range_error": "integrates an estimate by integrated_range, which is in the table",
    "multichannel.multichannel_limits": "checks its use of the radar; tests/multichannel/test_requirements.py",
    "multichannel.multichannel_requirements": "checks its use of the radar; tests/multichannel/test_requirements.py",
    "focus.inverse_requirements": "checks all its numbers; tests/study/test_requires.py",
    "focus.ladar_limits": "checks all its numbers; tests/focus/test_ladar_requirements.py",
    "focus.ladar_requirements": "checks all its numbers; tests/focus/test_ladar_requirements.py",
    "focus.requirements": "works on a radar, whose class checks it; tests/study/test_requires.py",
    "focus.reach_lines": "works on a radar, whose class checks it; tests/focus/test_strip.py",
    "metrics.trial_statistics": "statistics of recorded sweeps; tests/metrics/test_intervals.py",
    "metrics.pulse_phase_bound_of_scene_rad": "works on a scene of scatterers; tests/metrics/test_phase.py",
    **{
        f"optim.{name}": "minimises a function that is given; tests/optim"
        for name in (
            "adam",
            "differential_evolution",
            "genetic",
            "grid_search",
            "implicit",
            "lbfgs",
            "newton",
        )
    },
}

# stages that have a reason only, and those with other settings than in a row, as they are built
BUILT: list[Callable[[], Stage]] = [
    compensate.CorrectPath,
    compensate.PathAutofocus,
    compensate.PathPhase,
    lambda: compensate.StripAutofocus(100.0, 40.0, 6.0),
    lambda: multichannel.MoversImage(
        BISTATIC, multichannel.LeastSquares(2), "subtract", multichannel.Extraction(1.4, 4.0), multichannel.Detector()
    ),
    lambda: repair.SplitSweeps(LADAR, "search"),
]

LINE = LADAR.sweep_axes(8)[1]
WARP = torch.tensor([1.0, 5.0], dtype=F64)
ONES = torch.ones(4, dtype=F64)


def _carrier_hz(wavelength_m: float) -> float:
    return radar.LIGHT_M_S / wavelength_m if wavelength_m else math.inf


def stripmap(range_m: float, wavelength_m: float) -> Any:
    """One point seen at this range and wavelength, echo of eight pulses."""
    seen = replace(RADAR, carrier_hz=_carrier_hz(wavelength_m), near_range_m=range_m)
    world = scene.StripmapWorld(scene.Points([0.0], [30.0]), scene.AlwaysLit(), doppler_hz=0.0)
    return echo.simulate(seen, world, 8, 64, Draws(1))[0].signal


def turntable(range_m: float, wavelength_m: float) -> Any:
    seen = replace(TURNTABLE, carrier_hz=_carrier_hz(wavelength_m), reference_range_m=range_m)
    world = scene.TurntableWorld(scene.Points([0.0, 0.1], [0.0, 1.0]))
    return echo.simulate_turntable(seen, world, 8, 64, Draws(1))[0].signal


def bistatic(range_m: float, wavelength_m: float) -> Any:
    seen = replace(BISTATIC, carrier_hz=_carrier_hz(wavelength_m), reference_range_m=range_m)
    points = scene.MovingPoints([3.0], [1.0], [0.0], [0.0])
    return echo.simulate_bistatic(seen, scene.BistaticWorld(points, scene.BandLimited(4.0)), 8, 16, Draws(1))[0].signal


def ladar(simulated: Callable) -> Callable:
    def call(range_m: float, wavelength_m: float) -> Any:
        seen = replace(LADAR, carrier_hz=_carrier_hz(wavelength_m), reference_range_m=range_m)
        return simulated(seen, scene.LadarWorld(scene.Points([0.0], [0.1])), 4, Draws(1))[0].signal

    return call


def _moving(f: Callable, **more: Any) -> Callable:
    return lambda u_r_m_s, u_a_m_s, y0_m, range_m: f(
        BISTATIC, multichannel.PointMotion.of(BISTATIC, ONES, u_r_m_s, u_a_m_s, y0_m, range_m), **more
    )


def any_path(range_m: float, wavelength_m: float) -> Any:
    """One point seen from a straight path at this range and wavelength."""
    seen = replace(TURNTABLE, carrier_hz=_carrier_hz(wavelength_m))
    flight = scene.Flight(scene.StraightPath((-range_m, 0.0, 0.0), (0.0, 50.0, 0.0)))
    world = scene.PathWorld(scene.Points([1.0], [2.0]), flight)
    return echo.simulate_path(seen, world, 8, 16, Draws(1))[0].signal


MOTION = {"u_r_m_s": 3.0, "u_a_m_s": 2.0, "y0_m": 5.0, "range_m": 5000.0}
FAR = {"range_m": 4000.0, "wavelength_m": 0.03}
# functions of numbers: the function, and arguments of which each in turn is made extreme
NUMBERS: dict[str, tuple[Callable, dict[str, Any]]] = {
    "core.cis": (core.cis, {"angle_rad": ONES}),
    "core.legendre": (lambda u: core.legendre(u, 3), {"u": 0.3 * ONES}),
    "core.linear_phasor": (
        lambda turns, start: core.linear_phasor(turns, start, 5, torch.complex64),
        {"turns": 0.1 * ONES, "start": -2.0},
    ),
    "core.phasor_tables": (
        lambda turns, start: core.phasor_tables(turns, start, 5, torch.complex64),
        {"turns": 0.1 * ONES, "start": -2.0},
    ),
    "core.reduced_turns": (core.reduced_turns, {"turns": ONES}),
    "core.wrapped": (lambda x: core.wrapped(x, 3.0), {"x": ONES}),
    "core.unit_phasor": (lambda turns: core.unit_phasor(turns, torch.complex64), {"turns": ONES}),
    "core.settle": (core.settle, {"value": ONES, "fallback": 0.0}),
    "core.power_of": (core.power_of, {"x": torch.ones(4, 4, dtype=torch.complex64)}),
    "core.level_of": (core.level_of, {"x": torch.ones(4, 4)}),
    "core.unit_level": (core.unit_level, {"x": torch.ones(4, 4)}),
    "radar.geocentric": (
        radar.geocentric,
        {"latitude_deg": 48.0 * ONES, "longitude_deg": 11.0 * ONES, "height_m": 500.0 * ONES},
    ),
    "radar.resample_path": (
        lambda **given: radar.resample_path(torch.arange(9, dtype=F64), pulse_time_s=0.5 + ramp(4, 2.0), **given),
        {"position_m": torch.ones(9, 3, dtype=F64), "longest_gap_s": 2.0, "jump_m": 1.0},
    ),
    "radar.bistatic.polynomial_range": (polynomial_range, {"coefficients": (1.0, 2.0), "time_s": ONES}),
    "radar.bistatic.receive_range": (
        receive_range,
        {"time_s": ONES, **MOTION, "speed_m_s": 300.0, "channel_m": 1.0},
    ),
    "scene.sea.gamma_from_normal": (gamma_from_normal, {"x": 0.3 * ONES, "shape": 1.5}),
    "echo.simulate": (stripmap, FAR),
    "echo.simulate_turntable": (turntable, FAR),
    "echo.simulate_bistatic": (bistatic, FAR),
    "echo.simulate_path": (any_path, FAR),
    "echo.simulate_ladar": (ladar(echo.simulate_ladar), {"range_m": 3000.0, "wavelength_m": 1.55e-6}),
    "echo.simulate_ladar_record": (ladar(echo.simulate_ladar_record), {"range_m": 3000.0, "wavelength_m": 1.55e-6}),
    "echo.smooth_response": (
        lambda **terms: echo.smooth_response(**terms).phase_rad,
        {"quadratic_rad": 0.5, "cubic_rad": 0.5, "ripple_rad": 0.1},
    ),
    "compensate.doppler_at": (
        lambda **given: compensate.doppler_at(RADAR, **given),
        {"azimuth_m": ONES, "slant_m": 4e3 * ONES, "frame_hz": 5.0, "velocity_m_s": 120.0, "crossing_s": 0.1},
    ),
    "compensate.radial.trajectory.geometric_velocity_m_s": (
        lambda **given: trajectory.geometric_velocity_m_s(LADAR, LINE, **given),
        {"azimuth_m": 0.1, "relative_range_m": 0.2},
    ),
    "compensate.radial.trajectory.integrated_range": (
        lambda velocity_m_s, at_s: trajectory.integrated_range(velocity_m_s, LADAR, LINE, at_s),
        {"velocity_m_s": torch.ones(8, dtype=F64), "at_s": 1e-5 * ONES},
    ),
    "multichannel.azimuth.azimuth_filter": (
        _moving(lambda radar_, point: azimuth_filter(ONES, radar_, point, torch.complex64)),
        MOTION,
    ),
    "multichannel.response.band_matrix": (_moving(band_matrix, bands=3), MOTION),
    "multichannel.condition_number": (_moving(multichannel.condition_number, bands=3), MOTION),
    "multichannel.noise_gain_db": (_moving(multichannel.noise_gain_db, rebuild=REBUILD), MOTION),
    "multichannel.doppler_offsets": (lambda prf_hz: multichannel.doppler_offsets(8, 3, prf_hz), {"prf_hz": 180.0}),
    "focus.image_lines.cross_range_of": (
        lambda **given: image_lines.cross_range_of(k=WARP, **given),
        {"doppler_hz": ONES, "omega_rad_s": 0.3, "wavelength_m": 0.03, "duration_s": 0.1},
    ),
    "focus.image_lines.mean_rate": (
        lambda **given: image_lines.mean_rate(k=WARP, **given),
        {"omega_rad_s": 0.3, "duration_s": 0.1},
    ),
    "focus.reference.flat_reference": (
        lambda sampling_hz: reference.flat_reference(RADAR.pulse, 64, sampling_hz),
        {"sampling_hz": 5e7},
    ),
    "focus.reference.matched_reference": (
        lambda sampling_hz: reference.matched_reference(RADAR.pulse, 64, sampling_hz),
        {"sampling_hz": 5e7},
    ),
    "focus.reference.phase_reference": (
        lambda sampling_hz: reference.phase_reference(RADAR.pulse, 64, sampling_hz),
        {"sampling_hz": 5e7},
    ),
    "metrics.beam_centre_bound_hz": (
        metrics.beam_centre_bound_hz,
        {"gain": torch.hann_window(16, dtype=F64), "q": 100.0, "rate_hz_s": 20.0, "prf_hz": 400.0},
    ),
    "metrics.bistatic_bounds": (
        lambda **given: metrics.bistatic_bounds(BISTATIC, 64, **given),
        {"snr": 10.0, **MOTION},
    ),
    "metrics.integrated_range_detrended_bound_m": (
        metrics.integrated_range_detrended_bound_m,
        {"velocity_std_m_s": 0.1, "pulse_step_s": 1e-5, "n_period": 64.0},
    ),
    "metrics.pulse_phase_bound_rad": (lambda snr: metrics.pulse_phase_bound_rad(snr, 64), {"snr": 10.0}),
    "metrics.range_per_sweep_bound_m": (
        metrics.range_per_sweep_bound_m,
        {"snr": 10.0, "samples_per_sweep": 32.0, "wavelength_m": 1.55e-6},
    ),
    "metrics.reference_doppler_std_hz": (metrics.reference_doppler_std_hz, {"q": 100.0, "duration_s": 0.1}),
    "metrics.tone_frequency_bound_hz": (metrics.tone_frequency_bound_hz, {"q": 100.0, "duration_s": 0.1}),
    "metrics.velocity_bound_m_s": (
        metrics.velocity_bound_m_s,
        {"q": 100.0, "dwell_s": 0.1, "velocity_m_s": 120.0, "wavelength_m": 0.03, "range_m": 4e3},
    ),
    **{
        f"metrics.velocity_{kind}_bound_m_s": (
            getattr(metrics, f"velocity_{kind}_bound_m_s"),
            {"snr": 10.0, "samples_per_sweep": 32.0, "wavelength_m": 1.55e-6, "sweep_s": 8e-6},
        )
        for kind in ("free_offset", "known_offset", "segmented")
    },
    "metrics.rotation_bounds": (
        lambda **given: metrics.rotation_bounds(
            cross_range_m=0.1 * torch.arange(6.0, dtype=F64),
            range_m=torch.arange(6.0, dtype=F64),
            amplitude=torch.ones(6, dtype=torch.complex128),
            warp_k=WARP,
            n_pulse=64,
            **given,
        ),
        {"noise_std": 0.1, "omega_rad_s": 0.3, "wavelength_m": 0.03, "prf_hz": 400.0},
    ),
    "metrics.replica_zones": (lambda **given: metrics.replica_zones(BISTATIC, 3, **given), MOTION),
}
