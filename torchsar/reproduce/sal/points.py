"""Three points seen by a moving triangular-sweep ladar: figures 2 and 4 to 9 and Tables 1 and 2 of
Remote Sens. 2024, 16, 793.

Micrometres of radial motion defocus an image in azimuth, and decimetres per second shift the beat
frequencies by several range cells. The radial velocity is estimated from the up and the down half
of each triangle. Its integral is the range error, which is removed before the image is focused.
Nothing here is random.

A letter E of 62 points seen by a moving triangular-sweep ladar: figures 10 to 12 and Table 3 of
Remote Sens. 2024, 16, 793.

Entropies and contrasts depend on the size of the image and on the noise, which the paper does not
give; only their order is therefore compared. The phases of the points are random. With points of
equal phase on a regular grid, a wrong image would have less entropy than the true one. Methods are
also judged by the residual phase: 4 pi / lambda times the rms range error, without constant and
slope.

Step 1 of Remote Sens. 2024, 16, 793: isolation of one scatterer before estimation.

A coarse image is formed with the motion that inaccurate sensors record. One scatterer is isolated
in it in range and azimuth, and its echo is restored for the estimate of the motion.

The paper shows no result of this step. Here it is compared with the gate in range that the other
items use, for points at three ranges and for points in one range cell. It lowers the errors of the
velocities. The remaining phase error is the integral of slow velocity errors, which the isolation
does not remove.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchsar import plot
from torchsar.compensate import (
    CompensateMotion,
    CorrectPulsePhase,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
)
from torchsar.compensate.radial.trajectory import geometric_velocity_m_s
from torchsar.core import Axis, Chain, Draws, Signal, Stage, Trace, Truth, use
from torchsar.echo import simulate_ladar, simulate_ladar_record
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.metrics import contrast, entropy, impulse_response
from torchsar.metrics.cuts import impulse_cuts
from torchsar.radar import LIGHT_M_S, TriangularLadar
from torchsar.reproduce.item import Check, Item, falling, number, parameters, seeds_of, statement
from torchsar.scene import LadarWorld, LetterE, Points, Polynomial, QuadraticInSweep, Sinusoid
from torchsar.study.systems.sal.judge import Course, course_of, finer_in_range, in_milliseconds

# values of Table 1; the sampling is chosen
RADAR = TriangularLadar(
    LIGHT_M_S / 1.55e-6, bandwidth_hz=5e9, period_s=16e-6, sample_rate_hz=64e6, speed_m_s=60.0, reference_range_m=3000.0
)
# The following values are not published: the width of the beam, the positions of the points, and
# the motion.
# The beam has an azimuth aperture of 0.342 m, which gives the published width of 6.0 mm.
BEAM_RAD = 114e-6
PLACES_M = ((-0.06, 1.0), (0.0, 1.5), (0.06, 2.0))
SCENE = Points(*zip(*PLACES_M, strict=True), amplitude=[0.7, 1.0, 0.7])
MOTION = (
    Polynomial((0.35, 10.0)),
    Sinusoid(160e-6, 100.0, math.degrees(0.3)),
    Sinusoid(10e-6, 330.0, math.degrees(1.0)),
)  # 0.35 m/s and 20 m/s^2
# Extent of side lobes for the ISLR, which the paper does not give. For a sinc it is -12.84 dB with
# two nulls and -11.54 dB with three.
NULLS = 2
# tolerance: half of this difference (dB)
ISLR_DB = 0.7
# relative ranges of all points (m), and names of the methods that compensate the motion
ALL_M, COMPENSATED = slice(0.7, 2.3), ("segmented", "recommended")
# Measured properties of an impulse response, with their names. Widths in range are cells c / 2B,
# which are -3 dB widths over 0.886.
NAMES = {
    "irw_range_m": "width in range (m)",
    "pslr_range_db": "PSLR in range (dB)",
    "islr_range_db": "ISLR in range (dB)",
    "irw_azimuth_m": "width in azimuth (m)",
    "pslr_azimuth_db": "PSLR in azimuth (dB)",
    "islr_azimuth_db": "ISLR in azimuth (dB)",
}
# published numbers of Table 2, in this order, and tolerances
TABLE_2 = (0.030, -13.23, -12.26, 0.006, -12.49, -11.98)
WITHIN = (0.0005, 0.15, ISLR_DB, 0.0005, 0.15, ISLR_DB)


class Seen(NamedTuple):
    """Results of every method, the truth, and the image without motion."""

    traces: dict[str, Trace]
    courses: dict[str, Course]
    truth: Truth
    ideal: Signal


def _three_points(small: bool) -> Seen:
    """Simulate and process the three points. The reduced form is the same."""
    world = LadarWorld(SCENE, MOTION, fidelity=QuadraticInSweep())
    recording, truth = simulate_ladar(RADAR, world, 512, Draws(1))
    chains = methods({"segmented": SegmentedInterference(RADAR, hann=True)}, (0.0, 3.0))
    traces = {name: chain.trace(recording) for name, chain in chains.items()}
    courses = {name: course_of(chain, traces[name], truth.values, RADAR, clean=False) for name, chain in chains.items()}
    return Seen(traces, courses, truth, chains["uncompensated"](truth.clean))


def methods(
    estimators: Mapping[str, Stage], window_m: tuple[float, float], scene_m: tuple[float, float] | None = None
) -> dict[str, Chain]:
    """Make chains that differ in the compensation alone.

    Args:
        estimators: Estimators of the velocity by name.
        window_m: Relative ranges in metres that the recommended estimator uses.
        scene_m: Relative ranges in metres of the image; None for all.

    Returns:
        Chains by name: without compensation, by every estimator, and the recommended one.
    """
    after = {"compress": CompressSweeps(RADAR, window_m=scene_m), "deramp": DerampAzimuth(RADAR)}
    image: dict[str, nn.Module] = {"image": AzimuthMatchedFilter(RADAR, beam_rad=BEAM_RAD)}
    compensate = use(CompensateMotion(RADAR), velocity_m_s="motion")
    correct = use(CorrectPulsePhase(), phase_rad="motion")
    best = RadialMotion(RADAR, window_m=window_m)
    return {
        "uncompensated": Chain(**after, **image),
        **{name: Chain(motion=one, compensate=compensate, **after, **image) for name, one in estimators.items()},
        "recommended": Chain(motion=best, compensate=compensate, **after, correct=correct, **image),
    }


def _figure_2(small: bool, path: Path) -> list[Check]:
    """Draw the triangular sweep and its echo, and the dechirped beat at rest and in motion.

    The bandwidth is 50 MHz instead of 5 GHz, so that the delay is visible.
    """
    radar, range_m = replace(RADAR, bandwidth_hz=50e6), 150.0
    time_s = torch.linspace(0, 3 * radar.period_s, 1500, dtype=torch.float64)
    delays, us = (0, 2 * range_m / radar.wave_speed_m_s), plot.array(1e6 * time_s)
    # the triangle starts at time zero; frequencies are relative to the middle of its band
    triangles = [0.5 - (2 * torch.remainder((time_s - delay) / radar.period_s, 1) - 1).abs() for delay in delays]
    sent, echo = (1e-6 * (radar.bandwidth_hz * triangle) for triangle in triangles)
    swept = {"local oscillator": (us, plot.array(sent)), "echo of 150 m beyond the reference": (us, plot.array(echo))}
    beats: dict[str, list[float]] = {}
    parts: list[dict] = [
        {"series": swept, "xlabel": "time (us)", "ylabel": "frequency (MHz)", "title": "sweeps", "ylim": (-28.0, 40.0)}
    ]
    for title, speed in (("dechirped, at rest", 0.0), ("dechirped, receding at 2 m/s", 2.0)):
        record, _ = simulate_ladar_record(
            radar, LadarWorld(Points([0.0], [range_m]), [Polynomial((speed,))], snr_db=30.0), 3, Draws(1)
        )
        spectrum = plot.short_time_spectrum(record.signal.data.flatten(), radar.sample_rate_hz)
        theory = {"theory": (us, plot.array(sent - echo + 1e-6 * radar.doppler_hz(speed)))}
        parts.append({"title": title, "signal": spectrum, "lines": theory, "ylim": (-15.0, 20.0)})
        beats[title] = [_beat_mhz(spectrum, 1e6 * share * radar.period_s) for share in (0.25, 0.75)]
    plot.save(plot.overlays(parts), path, columns=3)
    rest, moving = beats.values()
    shifts = [after - before for before, after in zip(rest, moving, strict=True)]
    expected = 1e-6 * float(radar.doppler_hz(2.0))
    ours = f"beats {rest[0]:.1f} and {rest[1]:.1f} MHz at rest, shifts of {shifts[0]:.1f} and {shifts[1]:.1f} MHz"
    holds = abs(sum(rest)) < 1 and all(abs(shift - expected) < 1 for shift in shifts)
    return [statement("beats", "opposite in both sweeps, and shifted alike by the radial velocity", holds, ours)]


def _beat_mhz(spectrum: Signal, at_us: float) -> float:
    """Strongest frequency (MHz) at a time."""
    column = spectrum.data[:, int(spectrum.axis("time").index_of(at_us).round())]
    return float(spectrum.axis("frequency").values()[int(column.argmax())])


def draw_over_time(pulse: Axis, drawn: Mapping[str, tuple[str, Mapping[str, Tensor]]], path: Path) -> None:
    """Draw panels side by side over slow time.

    Args:
        pulse: Slow time in seconds.
        drawn: Unit, and lines (pulse,) by name, of each panel by its title.
        path: Picture.
    """
    ms = plot.array(1e3 * pulse.values())
    parts = [
        {
            "series": {name: (ms, plot.array(y)) for name, y in lines.items()},
            "xlabel": "slow time (ms)",
            "ylabel": unit,
            "title": title,
        }
        for title, (unit, lines) in drawn.items()
    ]
    plot.save(plot.panels(parts), path, columns=3)


def _response(image: Signal, azimuth_m: float = 0.0, range_m: float = 1.5) -> dict[str, float]:
    """Impulse response of a point, with the width in range as a range cell."""
    found = impulse_response(image, (azimuth_m, range_m), sidelobe_nulls=NULLS, search_m=0.2, centre_turns=(None, 0.0))
    values = {name: float(found[name]) for name in NAMES}
    return {**values, "irw_range_m": values["irw_range_m"] / 0.886}


def _focus(seen: Seen, method: str, path: Path) -> tuple[float, float]:
    """Draw range profiles and the image, and return the migration (cells) and the PSLR in azimuth
    (dB).
    """
    trace = seen.traces[method]
    profiles, image = (signal.sel(range=ALL_M) for signal in (trace.outputs["compress"], trace.signal))
    named = {f"range profiles, {method}": profiles, f"image, {method}": image}
    shown = {name: one.with_data(one.data / one.data.abs().max()) for name, one in named.items()}
    plot.save(plot.images(shown, dynamic_range_db=40, percentile=100), path)
    middle = trace.outputs["compress"].sel(range=slice(1.2, 1.8))
    peak = middle.data.abs().argmax(-1)
    cells = float(peak.max() - peak.min()) * middle.axis("range").step / RADAR.range_step_m
    return cells, _response(trace.signal)["pslr_azimuth_db"]


def _table_1(seen: Seen, path: Path) -> list[Check]:
    return parameters(
        {
            "wavelength (um)": (1.55, 1e6 * RADAR.wave_speed_m_s / RADAR.carrier_hz),
            "bandwidth (GHz)": (5.0, 1e-9 * RADAR.bandwidth_hz),
            "period of the triangle (us)": (16.0, 1e6 * RADAR.period_s),
            "speed (m/s)": (60.0, RADAR.speed_m_s),
            "height (m), our reference range": (3000.0, RADAR.reference_range_m),
        },
        1e-3,
    )


def _figure_4(seen: Seen, path: Path) -> list[Check]:
    x, y, level = (plot.array(torch.as_tensor(v)) for v in (SCENE.azimuth_m, SCENE.range_m, SCENE.amplitude))
    plot.save(plot.scatterers(y, x, level, "relative range (m)", "azimuth (m)", "three points", "auto"), path)
    return [number("points", 3, len(x), 0)]


def _figure_5(seen: Seen, path: Path) -> list[Check]:
    cells, level = _focus(seen, "uncompensated", path)
    ours = f"{cells:.1f} range cells; PSLR in azimuth {level:.1f} dB"
    return [statement("no compensation", "bent range profiles, defocused points", cells > 2 and level > -6, ours)]


def _figure_6(seen: Seen, path: Path) -> list[Check]:
    found, true = seen.courses["segmented"], seen.truth.values["range_error_up_m"]
    true = true - true[0]
    drawn = {
        "radial velocity": ("m/s", {"segmented": found.velocity_m_s, "true": seen.truth.values["velocity_m_s"]}),
        "range error": ("mm", {"segmented": 1e3 * (true + found.error_m - found.error_m[0]), "true": 1e3 * true}),
        "estimated minus true range error": (
            "nm",
            {name: 1e9 * (one.error_m - one.error_m[0]) for name, one in seen.courses.items() if name in COMPENSATED},
        ),
    }
    draw_over_time(found.pulse, drawn, path)
    worst = float(seen.courses["segmented"].metrics(RADAR)["range_error_max_m"])
    return [number("largest error of the range (m)", 2e-7, worst, 0.5e-7, "lower")]


def _figure_7(seen: Seen, path: Path) -> list[Check]:
    cells, level = _focus(seen, "segmented", path)
    ours = f"{cells:.2f} range cells; PSLR in azimuth {level:.1f} dB"
    return [statement("compensation", "profiles within a range cell, focused points", cells < 1 and level < -12, ours)]


def _figure_8(seen: Seen, path: Path) -> list[Check]:
    image = seen.traces["segmented"].signal
    before, after = (
        finer_in_range(finer_in_range(seen.traces[name].signal)).sel(range=ALL_M)
        for name in ("uncompensated", "segmented")
    )
    # four cells on either side of a point
    points = {
        f"point at {r:g} m": after.sel(azimuth=slice(x - 0.024, x + 0.024), range=slice(r - 0.12, r + 0.12))
        for x, r in PLACES_M
    }
    plot.save(plot.contours({"no compensation": before, "segmented interference": after, **points}), path, columns=3)
    levels = [_response(image, x, r)["pslr_azimuth_db"] for x, r in PLACES_M]
    ours = "PSLR in azimuth " + ", ".join(f"{level:.2f}" for level in levels) + " dB"
    return [statement("contours", "all three points are focused", max(levels) < -12, ours)]


def _figure_9(seen: Seen, path: Path) -> list[Check]:
    image = seen.traces["segmented"].signal
    images = {"without motion": seen.ideal, "segmented": image}
    cuts = {name: impulse_cuts(finer_in_range(one), (0.0, 1.5)) for name, one in images.items()}
    parts = [
        {
            "series": {name: (plot.array(cut[axis][0]), plot.decibel(cut[axis][1])) for name, cut in cuts.items()},
            "xlabel": f"{axis} from the peak (m)",
            "ylabel": "amplitude (dB)",
            "ylim": (-40.0, 1.0),
        }
        for axis in ("range", "azimuth")
    ]
    plot.save(plot.panels(parts), path)
    ours, ideal = _response(image), _response(seen.ideal)
    return [
        number(f"{axis}: PSLR beyond that without motion (dB)", 0.0, ours[name] - ideal[name], 0.15)
        for axis, name in (("range", "pslr_range_db"), ("azimuth", "pslr_azimuth_db"))
    ]


def _table_2(seen: Seen, path: Path) -> list[Check]:
    ours = _response(seen.traces["segmented"].signal)
    rows = zip(NAMES.items(), TABLE_2, WITHIN, strict=True)
    return [number(words, published, ours[name], within, "lower") for (name, words), published, within in rows]


# relative ranges of the letter (m), and SNR (dB) per sample of one point before compression
SCENE_M, SNR_DB = (-1.5, 1.5), 20.0
# methods in the order of the columns of Table 3, along which entropies fall and contrasts rise
SHOWN = ("uncompensated", "cross-correlation", "segmented, summed")


Traces = dict[str, Trace]
Rows = dict[str, list[list[float]]]


def _letter(small: bool) -> tuple[Traces, Rows]:
    """Results of every method for the first draw, and by method the entropies (nats), amplitude
    contrasts and residuals (rad) of all draws.
    """
    runs = [_run(256 if small else 512, seed) for seed in seeds_of(small)]
    numbers = {name: zip(*(of[name] for _, of in runs), strict=True) for name in runs[0][1]}
    return runs[0][0], {name: [list(each) for each in of] for name, of in numbers.items()}


def _run(n_period: int, seed: int) -> tuple[Traces, dict[str, tuple[float, float, float]]]:
    """Results and numbers of one draw. "ideal" is without motion."""
    world = LadarWorld(LetterE(), MOTION, snr_db=SNR_DB, fidelity=QuadraticInSweep())
    recording, truth = simulate_ladar(RADAR, world, n_period, Draws(seed))
    assert truth.clean is not None
    estimators: dict[str, Stage] = {
        "cross-correlation": SpectrumCorrelation(RADAR, upsampling=20),
        # points 5 cm apart are not resolved in half sweeps, whose range cell is 6 cm
        "segmented, at one peak": SegmentedInterference(RADAR),
        "segmented, summed": SegmentedInterference(RADAR, bins="sum", unwrap="per_pulse", window_m=SCENE_M),
    }
    chains = methods(estimators, (-2.5, 2.5), SCENE_M)
    traces, figures = {}, {}
    for name, chain in {**chains, "ideal": chains["uncompensated"]}.items():
        traces[name] = chain.trace(truth.clean if name == "ideal" else recording)
        left = course_of(chain, traces[name], truth.values, RADAR, clean=name == "ideal").metrics(RADAR)
        image = traces[name].signal
        of = (entropy(image), contrast(image, of="amplitude"), left["residual_phase_rms_rad"])
        figures[name] = (float(of[0]), float(of[1]), float(of[2]))
    return traces, figures


def _figure_10(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    points = LetterE().scatterers(Draws(0))
    x, y, level = (plot.array(value) for value in (points.azimuth_m, points.range_m, points.amplitude.abs()))
    plot.save(plot.scatterers(y, x, level, "range (m)", "azimuth (m)", "62 points", "auto"), path)
    return [number("points", 62, len(x), 0)]


def _figure_11(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    profiles = {name: in_milliseconds(_about_letter(seen[0][name].outputs["compress"])) for name in SHOWN}
    plot.save(plot.images(profiles, dynamic_range_db=40, percentile=100), path, columns=3)
    return [falling("residual phase (rad)", {name: seen[1][name][2] for name in SHOWN})]


def _figure_12(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    images = {
        name: _about_letter(finer_in_range(finer_in_range(seen[0][name].signal)))
        for name in [*SHOWN, "segmented, at one peak", "recommended", "ideal"]
    }
    plot.save(plot.images(images, dynamic_range_db=25, percentile=100, reference="ideal"), path, columns=3)
    return [falling("entropy (nats)", {name: seen[1][name][0] for name in SHOWN})]


def _table_3(seen: tuple[Traces, Rows], path: Path) -> list[Check]:
    entropies, contrasts = ({name: seen[1][name][which] for name in SHOWN} for which in (0, 1))
    return [
        falling("entropy (nats; published 11.4919, 11.4081, 11.3471)", entropies),
        falling("contrast (published 0.2375, 0.3146, 0.3433)", contrasts, rising=True),
    ]


def _about_letter(signal: Signal) -> Signal:
    """Part of a signal around the letter.

    It covers relative ranges of -0.7 to 0.9 m, with a margin for the shift of beat frequencies by
    the velocity, and azimuths around the letter.
    """
    part = signal.sel(range=slice(-0.7, 0.9))
    return part.sel(azimuth=slice(-0.12, 0.12)) if "azimuth" in part.names else part


SCENES = {"three ranges": SCENE, "one range cell": Points([-0.15, 0.0, 0.15], [1.5] * 3, [0.7, 1.0, 0.7])}
Errors = dict[tuple[str, float, str], list[tuple[float, float]]]


def isolate(
    sweeps: Signal,
    radar: TriangularLadar,
    ranges_m: tuple[float, float],
    near_m: float = 0.3,
    near_hz: float = 1500.0,
) -> Signal:
    """Keep the strongest scatterer of sweeps whose motion is compensated coarsely.

    Args:
        sweeps: Sweeps (ramp, pulse, fast_time), without the velocity that sensors recorded and that
            of the flight past the scatterer.
        radar: Parameters of the ladar.
        ranges_m: Lowest and highest relative range in metres in which it lies.
        near_m: Half width in range of what is kept about it, in metres.
        near_hz: Half width in Doppler of what is kept, in Hz.

    Returns:
        Sweeps of this scatterer.
    """
    _, pulse, fast = sweeps.axes
    image = torch.fft.fft2(sweeps.data)
    beat_m = radar.range_step_m * fast.n * torch.fft.fftfreq(fast.n, dtype=torch.float64)
    range_m = torch.stack([beat_m, -beat_m])[:, None, :]
    doppler_hz = torch.fft.fftfreq(pulse.n, pulse.step, dtype=torch.float64)[:, None]
    inside = (range_m >= ranges_m[0]) & (range_m <= ranges_m[1])
    peak = torch.where(inside, image.abs(), 0).flatten(1).argmax(-1)[:, None, None]
    at_m, at_hz = range_m.gather(-1, peak % fast.n), doppler_hz[peak // fast.n, 0]
    kept = torch.where(((range_m - at_m).abs() <= near_m) & ((doppler_hz - at_hz).abs() <= near_hz), image, 0)
    return sweeps.with_data(torch.fft.ifft2(kept))


def _errors(small: bool, snrs_db: Sequence[float] = (-10.0, 0.0, 20.0), scale: float = 0.99) -> Errors:
    """Rms errors of the velocity (m/s) and residual phases (rad) of all draws.

    The keys are scene, SNR per sample before compression, and method. By choice, the velocity that
    the sensors record is the true one times `scale`, plus 2 mm/s.
    """
    found: Errors = {}
    ranges_m = (1.2, 1.8)  # range gate around the strongest point
    for scene, snr_db, seed in itertools.product(SCENES, snrs_db, seeds_of(small)):
        world = LadarWorld(SCENES[scene], MOTION, snr_db=snr_db, fidelity=QuadraticInSweep())
        recording, truth = simulate_ladar(RADAR, world, 512, Draws(seed))
        sweeps, true = recording.signal, truth.values["velocity_m_s"]
        estimator = SegmentedInterference(RADAR, window_m=ranges_m, assess=False)
        sensors = scale * true + 2e-3
        coarse = sensors + geometric_velocity_m_s(RADAR, sweeps.axis("pulse"))
        alone = isolate(CompensateMotion(RADAR)(sweeps, coarse), RADAR, ranges_m)
        methods = {
            "gate in range": estimator(sweeps)["velocity_m_s"],
            "isolated": coarse + estimator(alone)["velocity_m_s"],
        }
        for method, velocity in methods.items():
            found.setdefault((scene, snr_db, method), []).append(_left(velocity - true))
    return found


def _left(error_m_s: Tensor) -> tuple[float, float]:
    """Rms of a velocity error (m/s), and rms of the residual phase (rad) that it causes."""
    pulse = RADAR.sweep_axes(len(error_m_s))[1]
    error_m = RADAR.period_s * error_m_s.cumsum(-1)
    lit = torch.ones_like(error_m, dtype=torch.bool)
    course = Course(pulse, error_m_s, error_m_s, error_m, error_m, lit)
    return float(course.rms(error_m_s)), float(course.metrics(RADAR)["residual_phase_rms_rad"])


def _text_4(found: Errors, path: Path) -> list[Check]:
    checks = []
    for scene in SCENES:
        rows = {
            (snr_db, method): torch.tensor(draws, dtype=torch.float64).square().mean(0).sqrt()
            for (of, snr_db, method), draws in found.items()
            if of == scene
        }
        gate, isolated = (
            {snr_db: row for (snr_db, of), row in rows.items() if of == method}
            for method in ("gate in range", "isolated")
        )
        ours = "; ".join(
            f"{snr_db:g} dB: {1e3 * float(gate[snr_db][0]):.2f} mm/s and {float(gate[snr_db][1]):.2f} rad by the gate, "
            f"{1e3 * float(row[0]):.2f} mm/s and {float(row[1]):.2f} rad isolated"
            for snr_db, row in isolated.items()
        )
        better = all(float(row[0]) < float(gate[snr_db][0]) for snr_db, row in isolated.items())
        claim, draws = "holds the echo of the scatterer and little of the background", len(next(iter(found.values())))
        checks.append(statement(f"velocity and residual phase, {scene}", claim, better, ours, draws))
    return checks


ITEMS = (
    Item("Figure 2", "frequencies of the sweeps and of the dechirped echo", of=bool, make=_figure_2),
    Item("Figure 4", "scene of three points, at places of our own", of=_three_points, make=_figure_4),
    Item("Figure 5", "range profiles and image without compensation", of=_three_points, make=_figure_5),
    Item("Figure 6", "velocity and range error, true and estimated", of=_three_points, make=_figure_6),
    Item("Figure 7", "range profiles and image after compensation", of=_three_points, make=_figure_7),
    Item("Figure 8", "contours of the points before and after compensation", of=_three_points, make=_figure_8),
    Item("Figure 9", "impulse response in range and azimuth", of=_three_points, make=_figure_9),
    Item("Table 1", "parameters of the simulation", _three_points, _table_1),
    Item("Table 2", "quality of the impulse response", _three_points, _table_2),
    Item("Figure 10", "scene of 62 points", of=_letter, make=_figure_10),
    Item("Figure 11", "range profiles of three methods", of=_letter, make=_figure_11),
    Item("Figure 12", "images of three methods, and of the recommended one", of=_letter, make=_figure_12),
    Item("Table 3", "entropy and contrast of the images", _letter, _table_3),
    Item("Text 4", "scatterers isolated in a coarse image (section 2.4, step 1)", _errors, _text_4),
)
