"""A retro-reflector and a broken line behind it, moved past a ladar on the ground: figures 15 to 19
and Tables 5 and 6 of Remote Sens. 2024, 16, 793.

    python scripts/ladar_ground.py [--out ladar_ground] [--seed 1] [--small]

A simulation in place of the paper's recording, which is not public. One real channel records the
triangle with its transients, from 5.3 us before the up sweep on. The air is turbulent and the
target vibrates. The motion can be estimated if the record is divided into sweeps from the trigger
on; it cannot if each period is shifted circularly, as in figure 15b.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from torchsar import plot
from torchsar.compensate import (
    CompensateMotion,
    CorrectPulsePhase,
    EqualisePulses,
    PulseGain,
    RadialMotion,
    SegmentedInterference,
    SpectrumCorrelation,
)
from torchsar.core import Axis, Chain, Draws, Recording, Signal, Stage, Trace, Truth, use
from torchsar.echo import simulate_ladar_record
from torchsar.focus import AzimuthMatchedFilter, CompressSweeps, DerampAzimuth
from torchsar.metrics import contrast, entropy, impulse_response
from torchsar.metrics.radial_motion import Course, course_of, finer_in_range
from torchsar.radar import LIGHT_M_S, TriangularLadar
from torchsar.repair import BlankTurningPoints, CircularShift, SplitSweeps
from torchsar.scene import (
    EverySample,
    LadarWorld,
    LogAmplitude,
    PathFluctuation,
    Polynomial,
    RetroAndBrokenLine,
    Sinusoid,
)

RADAR = TriangularLadar(
    LIGHT_M_S / 1.55e-6, 5e9, 32e-6, 150e6, speed_m_s=3.125, reference_range_m=4339.5, keep_every=4, detection="real"
)
MOTION = (
    Polynomial((0.08,)),
    Sinusoid(2e-3, 12.0, 22.92),
    Sinusoid(100e-6, 47.0, 63.03),
    Sinusoid(3e-6, 180.0, 114.59),
    PathFluctuation(1.5e-6),
)
TRIGGER_S, BLOCK_S = 5.3e-6, 40e-6
RETRO, SCENE_M = (10.0, 11.3), (9.8, 11.8)
# extent of side lobes for the ISLR: -12.84 dB for a sinc, 3 give -11.54 and 10 give -10.17; the
# paper does not give it
NULLS = 2
TABLE_5 = {"uncompensated": (13.0434, 0.3207), "cross-correlation": (12.0239, 0.3300), "segmented": (11.9251, 0.4100)}
TABLE_6 = {
    "cross-correlation": {
        "irw_range_m": 0.030,
        "pslr_range_db": -10.36,
        "islr_range_db": -9.92,
        "irw_azimuth_m": 0.0080,
        "pslr_azimuth_db": -5.01,
        "islr_azimuth_db": -3.86,
    },
    "segmented": {
        "irw_range_m": 0.030,
        "pslr_range_db": -14.00,
        "islr_range_db": -13.20,
        "irw_azimuth_m": 0.0078,
        "pslr_azimuth_db": -13.77,
        "islr_azimuth_db": -12.78,
    },
}


def methods(radar: TriangularLadar) -> dict[str, Chain]:
    """Chains from the record to the image.

    "segmented, circular shift" gets sweeps that the paper's circular shift separated, "ideal" the
    record without motion.
    """
    split = {
        "split": use(SplitSweeps(radar, "recorded"), trigger_s="aux.trigger_s"),
        "blank": BlankTurningPoints(radar, farthest_m=11.5),
    }
    ring = {
        "ring": CircularShift(radar, TRIGGER_S),
        "split": SplitSweeps(radar),
        "blank": BlankTurningPoints(radar, farthest_m=11.5),
    }
    focus = {"compress": CompressSweeps(radar, window_m=SCENE_M), "deramp": DerampAzimuth(radar)}
    image = {"image": AzimuthMatchedFilter(radar)}
    polish = {
        "correct": use(CorrectPulsePhase(), phase_rad="motion"),
        "gain": PulseGain(),
        "equalise": use(EqualisePulses(), gain="gain"),
        "image": AzimuthMatchedFilter(radar, weighting=0.03),
    }

    def compensated(estimator: Stage) -> dict[str, nn.Module]:
        return {"motion": estimator, "compensate": use(CompensateMotion(radar), velocity_m_s="motion")}

    return {
        "uncompensated": Chain(**split, **focus, **image),
        "cross-correlation": Chain(
            **split, **compensated(SpectrumCorrelation(radar, window_m=RETRO)), **focus, **image
        ),
        "segmented": Chain(
            **split, **compensated(SegmentedInterference(radar, hann=True, window_m=RETRO)), **focus, **image
        ),
        "recommended": Chain(**split, **compensated(RadialMotion(radar, window_m=RETRO)), **focus, **polish),
        "segmented, circular shift": Chain(
            **ring, **compensated(SegmentedInterference(radar, hann=True, window_m=RETRO)), **focus, **image
        ),
        "ideal": Chain(**split, **focus, **image),
    }


def recorded(radar: TriangularLadar, n_period: int, seed: int) -> tuple[Recording, Truth]:
    """Some periods of a continuous record, in blocks that hold a period from the trigger on."""
    world = LadarWorld(RetroAndBrokenLine(), MOTION, LogAmplitude(0.1), snr_db=0.0, fidelity=EverySample())
    return simulate_ladar_record(
        radar, world, n_period, Draws(seed), block_s=BLOCK_S, trigger_s=TRIGGER_S, trigger_known=True
    )


def one_period(recording: Recording) -> Recording:
    """Blocks cut to the length of one period, which is what a ring needs."""
    return Recording(recording.signal.crop(time=(0, 2 * RADAR.sweep_samples)), recording.radar, recording.aux)


def judge(trace: Trace, course: Course) -> dict[str, float]:
    """Figures of a method: the image, the retro-reflector, and what is left of the motion (rad)."""
    response = impulse_response(
        trace.signal, (0.0, 10.5), sidelobe_nulls=NULLS, search_m=0.15, centre_turns=(None, 0.0)
    )
    found = {"entropy": entropy(trace.signal), "contrast": contrast(trace.signal, of="amplitude"), **response}
    return {
        **{name: float(x) for name, x in found.items() if name != "peak"},
        "residual": float(course.metrics(RADAR)["residual_phase_rms_rad"]),
    }


def show(figures: Mapping[str, Mapping[str, float]]) -> None:
    """Print Tables 5 and 6."""
    print(f"{'Table 5':26}{'entropy':>10}{'published':>11}{'contrast':>11}{'published':>11}{'residual (rad)':>16}")
    for name, f in figures.items():
        theirs = [f"{x:.4f}" for x in TABLE_5[name]] if name in TABLE_5 else ["-", "-"]
        print(f"{name:26}{f['entropy']:10.4f}{theirs[0]:>11}{f['contrast']:11.4f}{theirs[1]:>11}{f['residual']:16.3f}")
    print("Published entropies belong to an image of another size and noise: only their order compares.\n")
    names = ["cross-correlation", "segmented", "recommended", "ideal"]
    print(
        f"{'Table 6, retro-reflector':26}"
        + "".join(f"{word:>19}" for name in names for word in ([name, "published"] if name in TABLE_6 else [name]))
    )
    for row in TABLE_6["segmented"]:
        print(
            f"{row:26}"
            + "".join(
                f"{x:19.4g}"
                for name in names
                for x in [figures[name][row], *([TABLE_6[name][row]] if name in TABLE_6 else [])]
            )
        )


def draw_separation(recording: Recording, out: Path) -> None:
    """Figure 15: one period as recorded and closed to a ring, and the sweeps that re-segmenting
    gives.
    """
    period = recording.signal.data[0, : 2 * RADAR.sweep_samples]
    sweeps = SplitSweeps(RADAR, TRIGGER_S)(recording.signal)
    assert isinstance(sweeps, Signal)
    ring = period.roll(-round(TRIGGER_S * RADAR.sample_rate_hz))
    starts = 1e6 * TRIGGER_S, 1e6 * (TRIGGER_S + RADAR.sweep_s)
    marked = {"up sweep begins": starts[0], "down sweep begins": starts[1]}
    joint = {"samples one period apart meet": 1e6 * (RADAR.period_s - TRIGGER_S)}
    parts = []
    for title, samples, marks in (
        ("one period as recorded", period, marked),
        ("after a circular shift", ring, joint),
        ("up sweep", sweeps.data[0, 0].real, {}),
        ("down sweep", sweeps.data[1, 0].real, {}),
    ):
        lines = {name: (np.array([us, us]), np.array([0.0, 45.0])) for name, us in marks.items()}
        parts.append(
            {
                "title": title,
                "signal": plot.short_time_spectrum(samples, RADAR.sample_rate_hz, width=192, hop=24),
                "lines": lines,
                "ylim": (0.0, 60.0),
            }
        )
    plot.save(plot.overlays(parts), out / "figure_15.png")


def draw_images(traces: Mapping[str, Trace], out: Path) -> None:
    """Figures 16 and 18: range profiles and images."""
    names = ["uncompensated", "cross-correlation", "segmented", "recommended"]
    profiles = {name: in_milliseconds(traces[name].outputs["compress"]) for name in names[:3]}
    plot.save(plot.images(profiles, dynamic_range_db=45, percentile=100), out / "figure_16.png", columns=3)
    plot.save(
        plot.images(
            {name: finer_in_range(traces[name].signal) for name in names},
            dynamic_range_db=45,
            percentile=100,
            reference="recommended",
        ),
        out / "figure_18.png",
    )


def in_milliseconds(profiles: Signal) -> Signal:
    pulse, range_ = profiles.axes
    return Signal(profiles.data, (Axis("slow time", pulse.n, 1e3 * pulse.start, 1e3 * pulse.step, "ms"), range_))


def draw_motion(courses: Mapping[str, Course], truth: Truth, out: Path) -> None:
    """Figure 17: velocity and motion, true and by both methods of the paper, and what they
    leave.
    """
    pulse, names = courses["segmented"].pulse, ["cross-correlation", "segmented", "recommended"]
    ms, true = plot.array(1e3 * pulse.values()), truth.values["range_error_up_m"]
    velocity = {**{name: courses[name].velocity_m_s for name in names[:2]}, "true": truth.values["velocity_m_s"]}
    motion = {
        **{name: 1e3 * (true - true[0] + courses[name].error_m - courses[name].error_m[0]) for name in names[:2]},
        "true": 1e3 * (true - true[0]),
    }
    left = {name: 1e6 * courses[name].detrended_m for name in names}
    parts = []
    for title, unit, lines in (
        ("radial velocity", "m/s", velocity),
        ("motion", "mm", motion),
        ("motion left, without constant and slope", "um", left),
    ):
        parts.append(
            {
                "series": {name: (ms, plot.array(y)) for name, y in lines.items()},
                "xlabel": "slow time (ms)",
                "ylabel": unit,
                "title": title,
            }
        )
    plot.save(plot.panels(parts), out / "figure_17.png", columns=3)


def draw_slices(traces: Mapping[str, Trace], out: Path) -> None:
    """Figure 19: cuts through the strongest sample, range on an eighth of the step."""
    images = {
        name: finer_in_range(finer_in_range(finer_in_range(traces[name].signal)))
        for name in ("cross-correlation", "segmented", "recommended")
    }
    parts = []
    for dim, reach_m in enumerate((0.05, 0.3)):
        series = {name: cut(image, dim, reach_m) for name, image in images.items()}
        name = ("azimuth", "range")[dim]
        parts.append(
            {
                "series": series,
                "xlabel": f"{name} from the peak (m)",
                "ylabel": "amplitude (dB)",
                "title": name,
                "ylim": (-50.0, 1.0),
            }
        )
    plot.save(plot.panels(parts), out / "figure_19.png")


def cut(image: Signal, dim: int, reach_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (m) from the strongest sample along one axis, and dB of it."""
    amplitude = image.data.abs()
    peak = np.unravel_index(int(amplitude.argmax()), amplitude.shape)
    offset = image.axes[dim].step * (torch.arange(image.axes[dim].n) - int(peak[dim]))
    near = offset.abs() <= reach_m
    return plot.array(offset[near]), plot.decibel(amplitude.select(1 - dim, int(peak[1 - dim]))[near])


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("ladar_ground"), help="folder of the figures")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--small", action="store_true", help="every 24th period")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    with torch.no_grad():
        radar = replace(RADAR, keep_every=24) if options.small else RADAR
        recording, truth = recorded(radar, 3840 // radar.keep_every, options.seed)
        assert truth.clean is not None
        given = {"segmented, circular shift": one_period(recording), "ideal": truth.clean}
        chains = methods(radar)
        traces = {name: chain.trace(given.get(name, recording)) for name, chain in chains.items()}
        courses = {
            name: course_of(chain, traces[name], truth.values, radar, clean=name == "ideal")
            for name, chain in chains.items()
        }
        show({name: judge(trace, courses[name]) for name, trace in traces.items()})
        draw_separation(recording, options.out)
        draw_images(traces, options.out)
        draw_motion(courses, truth, options.out)
        draw_slices(traces, options.out)


if __name__ == "__main__":
    main()
