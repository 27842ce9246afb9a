"""The table of functions of samples: one row for each, with what is promised of it.

`ENTRIES` holds these rows and those of the stages. A new public function joins by one row here, or
in `numbers` if it takes numbers only. A function of which `Stage.of` makes a stage needs no row but
that of the stage.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from tests.table import stages
from tests.table.stages import (
    ALL_LAWS,
    BISTATIC,
    LADAR,
    LINE_NUMBER,
    LIT,
    NEW_AXIS,
    ON_DOPPLER,
    ON_RANGE,
    RADAR,
    RANGE_FREE,
    TURNTABLE,
    Case,
    Laws,
)
from torchsar import compensate, core, focus, metrics, multichannel, radar, repair
from torchsar.compensate.doppler import lag_products
from torchsar.compensate.group import RangeGroup
from torchsar.compensate.point import peak_time_s
from torchsar.core import Draws, Estimate, Signal, Stage
from torchsar.echo.dechirped import fast_time_axis
from torchsar.focus.reference import matched_reference
from torchsar.multichannel.body import find_body
from torchsar.multichannel.velocity.along_track import along_track_velocity
from torchsar.multichannel.velocity.likelihood import explained_energy, maximum_likelihood
from torchsar.multichannel.velocity.stages import gradient_likelihood
from torchsar.multichannel.velocity.whitening import line_whitening, sample_whitening
from torchsar.radar import FarField
from torchsar.repair.contamination import find_contamination
from torchsar.repair.jitter import correct_jitter_exact
from torchsar.repair.lines import place_lines
from torchsar.repair.response import estimate_amplitude_response
from torchsar.repair.triangle import split_record

DECHIRPED = replace(TURNTABLE, pulse_s=1e-6)
F64 = torch.float64


@dataclass(frozen=True)
class Entry:
    """A public function or stage that works on samples.

    Args:
        name: Its name, such as "focus.omega_k".
        kind: Samples that it works on, see `samples`.
        call: Calls it on samples (..., and the dimensions of the kind).
        degree: By the name of a result, the power of the level of the samples with which it grows;
            None if it is not a power. By default 1 for samples, 0 for all other results.
        zero_ok: Reason why a trial of zeros may be ok.
        nan_ok: Reason why a value of a trial may be NaN.
        joint: All trials together give one result.
        refuses_levels: It refuses samples whose power does not fit their precision.
        least: Size of a result below which its rounding errors do not matter.
        laws: Which laws hold for it.
        build: Makes the stage, if it is one.
    """

    name: str
    kind: str
    call: Callable[[Tensor], Any]
    degree: dict[str, int | None] = field(default_factory=dict)
    zero_ok: str = ""
    nan_ok: str = ""
    joint: bool = False
    refuses_levels: bool = False
    least: float = 0.0
    laws: Laws = ALL_LAWS
    build: Callable[[], Stage] | None = None


def named(out: Any, name: str = "data") -> dict[str, Tensor]:
    """Every tensor of a result, by name."""
    if isinstance(out, Tensor):
        return {name: out}
    if isinstance(out, Signal):
        return {"data": out.data}
    if isinstance(out, Estimate):
        std = {f"std_{key}": value for key, value in out.std.items()}
        return {**out.value, **std, "ok": out.ok, "quality": out.quality}
    if isinstance(out, dict):
        parts = out.items()
    elif isinstance(out, tuple):
        parts = zip(getattr(out, "_fields", map(str, range(len(out)))), out, strict=True)
    else:
        parts = [(key, getattr(out, key)) for key in getattr(out, "__dataclass_fields__", ())]
    return {inner: value for key, part in parts for inner, value in named(part, key).items()}


@lru_cache(None)
def _signal(kind: str, trials: int = 1, dtype: torch.dtype = torch.complex128) -> Signal:
    if kind.startswith("case "):
        case = next(c for c in stages.CASES if c.name == kind[5:])
        return stages.entering(case, stages.raw(trials, dtype, n_range=case.n_range))
    if kind in ("record", "sweeps", "profiles"):
        return stages.raw_ladar(kind, trials, dtype, 48)
    base = stages.raw(trials, dtype, n_range={"wide": 128, "wide image": 300}.get(kind, 64))
    if kind in ("range", "line", "doppler"):
        return stages.raw_channels(kind, base)
    if kind.endswith("image"):
        return Signal(base.data, RADAR.image_axes(base.axes))
    if kind == "turntable":
        return Signal(base.data, TURNTABLE.raw_axes(48, 64))
    if kind == "dechirped":
        return Signal(base.data, (DECHIRPED.raw_axes(48, 64)[0], fast_time_axis(DECHIRPED, 64)))
    if kind == "row":
        return Signal(base.data[:, 20], base.axes[1:])
    return base


@lru_cache(None)
def samples(kind: str, trials: int, dtype: torch.dtype) -> Tensor:
    """Samples (trial, ...) of about unit level.

    Kinds: "raw", "wide" lines and an "image" of a strip, a "row" of it; "turntable" pulses and
    "dechirped" ones; the
    "record", "sweeps" and "profiles" of a triangular ladar; channels with "range", one "line" of
    them, and "doppler" of it rebuilt; "case NAME": what a stage of the contract works on; "one
    KIND": without trials.
    """
    if kind.startswith("one "):
        return samples(kind[4:], 1, dtype)[0]
    signal = _signal(kind, trials, dtype)
    return signal.data / core.level_of(signal.data, len(signal.axes))


def dims(kind: str) -> int:
    """Number of dimensions of the samples of a kind, without trials."""
    return len(_signal(kind.removeprefix("one ")).axes)


def fitted(kind: str, data: Tensor) -> Signal:
    """A signal of samples cut from those of a kind."""
    axes = _signal(kind.removeprefix("one ")).axes
    lengths = data.shape[data.ndim - len(axes) :]
    return Signal(data, tuple(replace(axis, n=n) for axis, n in zip(axes, lengths, strict=True)))


def on(kind: str, f: Callable[[Signal], Any]) -> Callable[[Tensor], Any]:
    """Call a function of a signal on samples of a kind."""
    return lambda data: f(fitted(kind, data))


def _rows(case: Case) -> list[Entry]:
    """The row of a stage, and with it that of the function of which `Stage.of` made the stage."""
    kind, stage = f"case {case.name}", case.build()

    def given(data: Tensor) -> tuple[Signal, dict[str, Tensor]]:
        signal = fitted(kind, data)
        one = signal.with_data(torch.zeros(1, *(axis.n for axis in signal.axes), dtype=torch.complex128))
        return signal, {n: v[0].expand((*signal.trials, *v.shape[1:])) for n, v in case.values(one).items()}

    def call(data: Tensor) -> Any:
        signal, values = given(data)
        return case.build()(signal, **values)

    def call_function(data: Tensor) -> Any:
        return function(data, **stage.constants, **given(data)[1])

    promised: dict[str, Any] = {"degree": {"data": case.degree}, "zero_ok": case.zero_ok, "laws": case.laws}
    rows = [Entry(f"{type(stage).__name__}:{case.name}", kind, call, build=case.build, **promised)]
    function: Any = inspect.unwrap(type(stage).__init__)
    if function.__name__ == "__init__":
        return rows
    return [*rows, Entry(f"{function.__module__.split('.')[1]}.{function.__name__}", kind, call_function, **promised)]


def ramp(n: int, scale: float = 0.1) -> Tensor:
    return scale * torch.arange(n, dtype=F64)


def waves(n_pulse: int, n: int) -> FarField:
    return FarField.turntable(9.3e9 + 8e6 * torch.arange(n, dtype=F64), torch.linspace(0.2, 0.35, n_pulse, dtype=F64))


@lru_cache(None)
def direct_sum(x: Tensor) -> Tensor:
    """Image of a history of any size by the direct sum."""
    plan = tile_plan(*x.shape[-2:])
    place = plan.antennas.transmitter_m
    pixels = plan.grid.pixels_m()
    return focus.backproject(x, plan.frequency_hz, place, None, plan.antennas.reference_m, pixels)


def tile_plan(n_pulse: int, n: int) -> focus.TilePlan:
    """A plan of a few pixels for pulses from a straight path."""
    x = torch.linspace(-50, 50, n_pulse, dtype=F64)
    place = torch.stack([x, torch.full_like(x, -900.0), torch.full_like(x, 500.0)], -1)
    grid = focus.ImageGrid(torch.zeros(3), torch.eye(3)[:2], (5, 4), 0.5)
    frequency_hz = 9.3e9 + 4e6 * torch.arange(n, dtype=F64)
    return focus.TilePlan(frequency_hz, place, None, 2 * torch.linalg.vector_norm(place, dim=-1), grid, images=None)


def compensated(x: Tensor) -> Tensor:
    """Image of a history of any size by motion compensation and omega-K."""
    plan = tile_plan(*x.shape[-2:])
    place, reference = plan.antennas.transmitter_m, plan.antennas.reference_m
    beam = focus.ProcessedBeam(0.3)
    return focus.compensated_omega_k(x, plan.frequency_hz, place, reference, plan.grid, beam)


def size(x: Tensor) -> Tensor:
    """Modulus; of bool, which has none, the values themselves."""
    return x if x.dtype == torch.bool else x.abs()


def missing(x: Tensor) -> Tensor:
    return torch.arange(x.shape[-2]) % 11 == 3


def motion(x: Tensor) -> multichannel.PointMotion:
    return multichannel.PointMotion.of(BISTATIC, x, 3.0, 2.0, 5.0)


def times(x: Tensor) -> Tensor:
    return (torch.arange(x.shape[-1], dtype=F64) - x.shape[-1] // 2) / BISTATIC.prf_hz


def group(x: Tensor) -> RangeGroup:
    return RangeGroup(x, torch.zeros(x.shape[:-2], dtype=torch.int64), RADAR)


OPTIONS = {"wavelength_m": TURNTABLE.wavelength_m, "prf_hz": TURNTABLE.prf_hz}
DOPPLER = {"doppler_hz": 5.0}
REBUILD = multichannel.LeastSquares(3)
BAND = RADAR.pulse.bandwidth_hz / RADAR.sampling_hz


def cells(x: Tensor) -> Tensor:
    return 0.3 * (torch.arange(x.shape[-1], dtype=F64) - x.shape[-1] // 2)


def figure(x: Tensor) -> Any:
    return compensate.ImageEntropy(x, stages.SEARCH, range_m=cells(x), **OPTIONS)


def sweeps(f: Callable, **kw: Any) -> Callable[[Tensor], Any]:
    return on("sweeps", lambda s: f(s.data, LADAR, s.axis("pulse"), **kw))


def _entry(
    name: str, kind: str, call: Callable[[Tensor], Any], degree: int | dict[str, int | None] = 1, **options: Any
) -> Entry:
    return Entry(name, kind, call, degree if isinstance(degree, dict) else {"data": degree}, **options)


FUNCTIONS = [
    _entry("core.centred_fft", "raw", core.centred_fft, laws=Laws(range=NEW_AXIS, energy=64)),
    _entry("core.centred_ifft", "raw", core.centred_ifft, laws=Laws(range=NEW_AXIS, energy=1 / 64)),
    _entry("core.fft_lines", "raw", core.fft_lines, laws=Laws(pulse=NEW_AXIS, energy=48)),
    _entry(
        "core.transform_in_blocks",
        "raw",
        lambda x: core.transform_in_blocks(x.clone(), -2),
        laws=Laws(pulse=NEW_AXIS, energy=48),
    ),
    _entry(
        "core.to_frequency",
        "raw",
        on("raw", lambda s: core.to_frequency(s, "range")),
        laws=Laws(range=NEW_AXIS, energy=64),
    ),
    _entry(
        "core.from_frequency",
        "raw",
        on("raw", lambda s: core.from_frequency(core.to_frequency(s, "range"), "range_frequency")),
        laws=Laws(energy=1),
    ),
    _entry("radar.frequency_samples", "raw", radar.frequency_samples, laws=Laws(range=NEW_AXIS, energy=1)),
    _entry("radar.range_profiles", "raw", radar.range_profiles, laws=Laws(range=NEW_AXIS, energy=1)),
    # repair
    _entry(
        "repair.band_limited_fill",
        "raw",
        lambda x: repair.band_limited_fill(x, missing(x)),
        laws=Laws(linear="the spectrum that fills a gap is estimated from the lines"),
    ),
    _entry(
        "repair.linear_fill",
        "raw",
        lambda x: repair.linear_fill(x, missing(x), 0.01),
        laws=Laws(pulse="gaps at fixed lines"),
    ),
    _entry(
        "repair.sparse_fill",
        "raw",
        lambda x: repair.sparse_fill(x, missing(x), RADAR, doppler_hz=5.0),
        laws=Laws(linear="the strong scatterers that fill a gap are selected from the lines"),
    ),
    _entry("repair.blank_turning_points", "sweeps", lambda x: repair.blank_turning_points(x, LADAR, 100.0)),
    _entry(
        "repair.calibrate_sweeps",
        "sweeps",
        on(
            "sweeps",
            lambda s: repair.calibrate_sweeps(
                s.data, stages._calibration(_signal("sweeps"))["calibration"][0], LADAR, 1e-9
            ),
        ),
    ),
    _entry(
        "repair.triangle.split_record",
        "record",
        lambda x: split_record(x, LADAR, 3.3e-6),
        laws=Laws(pulse="a sweep may begin in one block and end in the next"),
    ),
    _entry(
        "repair.jitter.correct_jitter_exact",
        "raw",
        lambda x: correct_jitter_exact(x, torch.tensor([0.05, -0.03, 0.02, -0.04], dtype=F64)),
        laws=Laws(range="the jitter has a place on the clock"),
    ),
    _entry("repair.contamination.find_contamination", "raw", find_contamination, laws=Laws(steps=("density",))),
    _entry(
        "repair.response.estimate_amplitude_response",
        "wide image",
        lambda x: estimate_amplitude_response(
            size(x).double().square().mean(-2), torch.ones(x.shape[-1], dtype=F64), BAND, 8
        ),
        0,
    ),
    _entry(
        "repair.lines.place_lines",
        "raw",
        lambda x: place_lines(x, (torch.arange(x.shape[-2]) - 1).expand(x.shape[:-1])),
        laws=Laws(pulse="moves lines to fixed places"),
    ),
    _entry("repair.find_trigger", "record", lambda x: repair.find_trigger(x, LADAR)),
    _entry(
        "repair.correct_jitter",
        "raw",
        lambda x: repair.correct_jitter(x, torch.tensor([0.05, -0.03, 0.02, -0.04], dtype=F64)),
        laws=Laws(range="the jitter has a place on the clock"),
    ),
    _entry(
        "repair.correct_response",
        "raw",
        lambda x: repair.correct_response(x, 0.5 * torch.linspace(-1, 1, 129, dtype=F64) ** 3, None, BAND),
        laws=Laws(energy=1),
    ),
    _entry("repair.remove_constant", "raw", repair.remove_constant),
    _entry("repair.drop_interference", "raw", repair.drop_interference),
    _entry("repair.notch_interference", "raw", repair.notch_interference),
    _entry("repair.subtract_interference", "raw", repair.subtract_interference),
    _entry("repair.estimate_imbalance", "raw", repair.estimate_imbalance),
    _entry("repair.estimate_jitter_blind", "wide", lambda x: repair.estimate_jitter_blind(x, 4)),
    _entry("repair.estimate_jitter_pilot", "row", lambda x: repair.estimate_jitter_pilot(x, 4)),
    _entry(
        "repair.estimate_response_points",
        "wide image",
        lambda x: repair.estimate_response_points(x, BAND, 40, passes=2),
    ),
    _entry("repair.estimate_response_sharpest", "wide image", lambda x: stages.FEW_POINTS(x, BAND)),
    _entry(
        "repair.line_integrity",
        "raw",
        lambda x: repair.line_integrity(x, torch.arange(x.shape[-2]) + 100),
        zero_ok="it is the numbers of the lines that are right",
    ),
    # compensate
    _entry("compensate.align_envelopes", "raw", compensate.align_envelopes, laws=RANGE_FREE),
    _entry(
        "compensate.shift_range",
        "raw",
        lambda x: compensate.shift_range(x, ramp(x.shape[-2])),
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    _entry("compensate.pulse_gain", "raw", compensate.pulse_gain, laws=RANGE_FREE),
    _entry(
        "compensate.equalise_pulses",
        "raw",
        lambda x: compensate.equalise_pulses(x, 1 + ramp(x.shape[-2])),
        laws=Laws(pulse=LINE_NUMBER),
    ),
    _entry("compensate.autofocus", "raw", compensate.autofocus, laws=RANGE_FREE),
    _entry("compensate.sca", "raw", compensate.sca, laws=RANGE_FREE),
    _entry("compensate.pga", "raw", compensate.pga, laws=RANGE_FREE),
    _entry("compensate.pga_sca", "raw", compensate.pga_sca, laws=RANGE_FREE),
    _entry("compensate.entropy_fixed_point", "raw", compensate.entropy_fixed_point, laws=RANGE_FREE),
    _entry("compensate.link_phases", "raw", compensate.link_phases, laws=RANGE_FREE),
    _entry("compensate.sharpest_phase", "raw", lambda x: compensate.sharpest_phase(x, steps=10), laws=RANGE_FREE),
    _entry(
        "compensate.sharpest_phase:contrast",
        "raw",
        lambda x: compensate.sharpest_phase(x, objective="contrast", steps=10),
        laws=RANGE_FREE,
    ),
    _entry("compensate.phase_polish", "raw", compensate.phase_polish, laws=RANGE_FREE),
    _entry(
        "compensate.rotation_autofocus",
        "raw",
        lambda x: compensate.rotation_autofocus(
            x, 400.0, torch.tensor([1.0, 5.0], dtype=F64).expand(math.prod(x.shape[:-2]), 2), search=4, polish=2
        ),
    ),
    _entry(
        "compensate.chirplet_clean",
        "raw",
        lambda x: compensate.chirplet_clean(x, 400.0, atoms=3),
        {"amplitude": 1, "image": 1},
    ),
    _entry("compensate.coarse_rotation", "raw", lambda x: compensate.coarse_rotation(x, range_m=cells(x), **OPTIONS)),
    _entry(
        "compensate.coarse_rotation:fits",
        "raw",
        lambda x: compensate.coarse_rotation(x, range_m=cells(x), **OPTIONS, fits=4),
    ),
    _entry("compensate.uneven_rotation", "raw", lambda x: compensate.uneven_rotation(x, range_m=cells(x), **OPTIONS)),
    _entry(
        "compensate.entropy_rotation",
        "raw",
        lambda x: compensate.entropy_rotation(figure(x), "grid", [torch.tensor([0.1, 0.5]), torch.tensor([-2.0, 2.0])]),
    ),
    _entry(
        "compensate.entropy_rotation:genetic",
        "raw",
        lambda x: compensate.entropy_rotation(
            figure(x), "genetic", ([0.1, -2.0], [0.5, 2.0]), draws=Draws(1), population=6, generations=2
        ),
    ),
    _entry(
        "compensate.entropy_rotation:evolution",
        "raw",
        lambda x: compensate.entropy_rotation(
            figure(x), "evolution", ([0.1, -2.0], [0.5, 2.0]), draws=Draws(1), population=6, generations=2
        ),
    ),
    _entry(
        "compensate.entropy_rotation:newton",
        "raw",
        lambda x: compensate.entropy_rotation(figure(x), "newton", torch.tensor([0.3, 0.5], dtype=F64), steps=2),
    ),
    _entry(
        "compensate.entropy_rotation:descent",
        "raw",
        lambda x: compensate.entropy_rotation(figure(x), "descent", torch.tensor([0.3, 0.5], dtype=F64), steps=2),
    ),
    _entry(
        "compensate.compensate_motion",
        "sweeps",
        on(
            "sweeps",
            lambda s: compensate.compensate_motion(
                s.data, 0.1 * torch.sin(ramp(s.axes[1].n, 0.3)), LADAR, s.axis("pulse")
            ),
        ),
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    _entry("compensate.segmented_interference", "sweeps", sweeps(compensate.segmented_interference)),
    _entry("compensate.mirror_product", "sweeps", sweeps(compensate.mirror_product)),
    _entry("compensate.ml_peak", "sweeps", sweeps(compensate.ml_peak)),
    _entry("compensate.spectrum_correlation", "sweeps", sweeps(compensate.spectrum_correlation)),
    _entry("compensate.radial_motion", "sweeps", sweeps(compensate.radial_motion)),
    _entry("compensate.phase_increment", "raw", lambda x: compensate.phase_increment(x, 400.0, (2, 2))),
    _entry("compensate.energy_centre", "raw", lambda x: compensate.energy_centre(x, 400.0, (2, 2))),
    _entry("compensate.doppler.lag_products", "raw", lambda x: lag_products(x, (2, 2)), 0),
    _entry("compensate.point_doppler", "row", lambda x: compensate.point_doppler(x, 400.0, 20.0), 0),
    _entry(
        "compensate.minimum_entropy_velocity",
        "raw",
        lambda x: compensate.minimum_entropy_velocity(
            group(x),
            torch.zeros(x.shape[:-2], dtype=F64),
            0.1,
            5.0,
            0.1,
        ),
    ),
    _entry(
        "compensate.point.peak_time_s",
        "image",
        lambda x: peak_time_s(
            x,
            400.0,
            torch.full(x.shape[:-2], 30.0, dtype=F64),
            20.0,
            (-0.05, 0.05),
            torch.zeros(x.shape[:-2], dtype=F64),
            torch.full(x.shape[:-2], 0.05, dtype=F64),
        ),
        0,
    ),
    # multichannel
    _entry(
        "multichannel.velocity.along_track.along_track_velocity",
        "line",
        lambda x: along_track_velocity(x, BISTATIC, motion(x), LIT),
    ),
    _entry("multichannel.interferometry", "line", lambda x: multichannel.interferometry(x, BISTATIC, motion(x), LIT)),
    _entry(
        "multichannel.velocity.stages.gradient_likelihood",
        "line",
        lambda x: gradient_likelihood(x, BISTATIC, motion(x), LIT, steps=5),
    ),
    _entry(
        "multichannel.velocity.likelihood.maximum_likelihood",
        "line",
        lambda x: maximum_likelihood(x, BISTATIC, motion(x), LIT),
        {"amplitude": 1, "noise_power": 2, "energy": 2},
    ),
    _entry(
        "multichannel.moving_point_velocity",
        "line",
        lambda x: multichannel.moving_point_velocity(x, BISTATIC, LIT, stages.FEW_VELOCITIES),
    ),
    _entry(
        "multichannel.velocity.likelihood.explained_energy",
        "line",
        lambda x: explained_energy(x, BISTATIC, motion(x), torch.ones(x.shape[-1], dtype=F64)),
        2,
    ),
    _entry(
        "multichannel.velocity.whitening.sample_whitening",
        "line",
        lambda x: sample_whitening(x, BISTATIC),
        {"factor": -1, "log_det": None},
    ),
    _entry(
        "multichannel.velocity.whitening.line_whitening",
        "range",
        lambda x: line_whitening(x.movedim(-1, -3), BISTATIC),
        {"factor": -1, "log_det": None},
    ),
    _entry(
        "multichannel.reconstruct",
        "line",
        lambda x: multichannel.reconstruct(x, BISTATIC, motion(x), REBUILD),
        laws=Laws(pulse=NEW_AXIS),
    ),
    _entry(
        "multichannel.reconstruct:range",
        "range",
        lambda x: multichannel.reconstruct(x, BISTATIC, motion(x), REBUILD, with_range=True),
        laws=Laws(pulse=NEW_AXIS),
    ),
    _entry(
        "multichannel.remove_transmit_range",
        "line",
        lambda x: multichannel.remove_transmit_range(
            x, times(x), BISTATIC.transmit_range, BISTATIC.wavelength_m, False
        ),
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    _entry(
        "multichannel.correct_balance",
        "line",
        lambda x: multichannel.correct_balance(
            x,
            BISTATIC,
            torch.tensor([0.3, 0.0, -0.2], dtype=F64),
            torch.tensor([1.0, 0.0, 0.5], dtype=F64),
            with_range=False,
        ),
    ),
    _entry(
        "multichannel.correct_migration",
        "range",
        on(
            "range",
            lambda s: multichannel.correct_migration(s.data, multichannel.Frame.of(BISTATIC, s), motion(s.data)),
        ),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE),
    ),
    _entry(
        "multichannel.stationary_image",
        "range",
        lambda x: multichannel.stationary_image(x, BISTATIC, 4900.0),
        laws=Laws(pulse=NEW_AXIS, range=ON_RANGE),
    ),
    _entry(
        "multichannel.focus_azimuth",
        "doppler",
        on(
            "doppler",
            lambda s: multichannel.focus_azimuth(s.data, s.axes[-1].values(), BISTATIC, motion(s.data), 300.0),
        ),
        laws=Laws(pulse=ON_DOPPLER),
    ),
    _entry(
        "multichannel.body.find_body",
        "one range",
        on(
            "one range",
            lambda s: find_body(
                s.data, multichannel.Frame.of(BISTATIC, s), 0.0, 5000.0, multichannel.Extraction(60.0, 5.0)
            ),
        ),
        joint=True,
    ),
    _entry("multichannel.detect", "one image", on("one image", lambda s: multichannel.detect(s))),
    # focus
    _entry("focus.amplitude", "image", focus.amplitude, laws=Laws(linear="a modulus")),
    _entry("focus.multilook", "image", lambda x: focus.multilook(x, (2, 2)), 2, refuses_levels=True),
    _entry("focus.to_db", "image", lambda x: focus.to_db(size(x)), 0),
    _entry(
        "focus.azimuth_transform", "raw", lambda x: focus.azimuth_transform(x, "hann", 2), laws=Laws(pulse=NEW_AXIS)
    ),
    _entry("focus.chirp_z", "raw", lambda x: focus.chirp_z(x, 0.1, 0.01, 17), laws=Laws(range=NEW_AXIS)),
    _entry(
        "focus.keystone",
        "raw",
        lambda x: focus.keystone(x, torch.linspace(-2e7, 2e7, x.shape[-1], dtype=F64), 3.2e9),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE),
    ),
    _entry(
        "focus.nufft_type1",
        "raw",
        lambda x: focus.nufft_type1(x, torch.linspace(-0.4, 0.3, x.shape[-1], dtype=F64), 16),
        laws=Laws(range=NEW_AXIS),
    ),
    _entry(
        "focus.nufft_type2",
        "raw",
        lambda x: focus.nufft_type2(x, torch.linspace(-0.4, 0.3, 17, dtype=F64)),
        laws=Laws(range=NEW_AXIS),
    ),
    _entry(
        "focus.matched_fourier",
        "raw",
        lambda x: focus.matched_fourier(x, torch.tensor([1.0, 5.0], dtype=F64), 400.0),
        laws=Laws(pulse=NEW_AXIS),
    ),
    _entry(
        "focus.range_phase",
        "raw",
        lambda x: focus.range_phase(x, cells(x), 0.1, 400.0, 0.3, torch.tensor([1.0, 5.0], dtype=F64)),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE, energy=1),
    ),
    _entry(
        "focus.range_compress",
        "raw",
        lambda x: focus.range_compress(x, matched_reference(RADAR.pulse, x.shape[-1], RADAR.sampling_hz)),
    ),
    _entry(
        "focus.compress_dechirped",
        "dechirped",
        lambda x: focus.compress_dechirped(x, TURNTABLE, residual_video=False),
        laws=Laws(energy=1 / 64),
    ),
    _entry("focus.compress_sweeps", "sweeps", lambda x: focus.compress_sweeps(x, LADAR)),
    _entry(
        "focus.deramp_azimuth",
        "profiles",
        on("profiles", lambda s: focus.deramp_azimuth(s.data, LADAR, s.axes[-2], s.axes[-1])),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE, energy=1),
    ),
    _entry(
        "focus.azimuth_matched_filter",
        "profiles",
        on("profiles", lambda s: focus.azimuth_matched_filter(s.data, LADAR, s.axes[-2], s.axes[-1])),
        laws=Laws(pulse=NEW_AXIS, range=ON_RANGE),
    ),
    _entry(
        "focus.backproject_strip",
        "raw",
        lambda x: focus.backproject_strip(x, RADAR, ramp(5, 1.0), 4020 + ramp(5, 3.0), **DOPPLER),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE),
    ),
    _entry(
        "focus.backproject_spotlight",
        "raw",
        lambda x: focus.backproject_spotlight(x, waves(*x.shape[-2:]), ramp(5, 1.0), ramp(5, 1.0)),
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE),
    ),
    _entry(
        "focus.backproject",
        "raw",
        direct_sum,
        laws=Laws(pulse="the path of a pulse depends on its number", range=ON_RANGE),
    ),
    _entry(
        "focus.image_tiles",
        "raw",
        lambda x: tile_plan(*x.shape[-2:]).image(x),
        laws=Laws(pulse="the path of a pulse depends on its number", range=ON_RANGE),
    ),
    _entry(
        "focus.compensated_omega_k",
        "raw",
        compensated,
        laws=Laws(pulse="the path of a pulse depends on its number", range=ON_RANGE),
    ),
    _entry("focus.omega_k", "raw", lambda x: focus.omega_k(x, RADAR, **DOPPLER), laws=Laws(range=ON_RANGE, energy=1)),
    _entry("focus.omega_k_stolt", "raw", lambda x: focus.omega_k_stolt(x, RADAR, **DOPPLER), laws=Laws(range=ON_RANGE)),
    _entry("focus.range_doppler", "raw", lambda x: focus.range_doppler(x, RADAR, **DOPPLER), laws=Laws(range=ON_RANGE)),
    _entry("focus.closest_range", "image", lambda x: focus.closest_range(x, RADAR, 5.0), laws=Laws(range=ON_RANGE)),
    # metrics
    _entry("metrics.entropy", "image", metrics.entropy, 0, least=0.01, laws=RANGE_FREE),
    _entry("metrics.contrast", "image", metrics.contrast, 0, laws=RANGE_FREE),
    _entry("metrics.correlation", "image", lambda x: metrics.correlation(x, x.roll(1, -1)), 0, laws=RANGE_FREE),
    _entry("metrics.error_db", "image", lambda x: metrics.error_db(x, x.roll(1, -1)), 0, laws=RANGE_FREE),
    _entry(
        "metrics.error_after_gain_db", "image", lambda x: metrics.error_after_gain_db(x, x.roll(1, -1)), 0, joint=True
    ),
    _entry("metrics.registered_error_db", "image", lambda x: metrics.registered_error_db(x, x.roll(1, -1).conj()), 0),
    _entry("metrics.registered_errors", "image", lambda x: metrics.registered_errors(x, x.roll(1, -1).conj()), 0),
    _entry("metrics.azimuth_response", "row", lambda x: metrics.azimuth_response(x, 1.0), {"peak": 1}),
    _entry(
        "metrics.replica_level",
        "row",
        lambda x: metrics.replica_level(x, 1.0, torch.tensor([[-9.0, -5.0], [5.0, 9.0]], dtype=F64)),
    ),
    _entry(
        "metrics.impulse_response",
        "image",
        on("image", lambda s: metrics.impulse_response(s, (5.0, 4050.0))),
        {"peak": 1},
        nan_ok="a place without a point has no widths and no side lobes",
    ),
    _entry(
        "metrics.phase_rmse",
        "raw",
        lambda x: metrics.phase_rmse(x.real.flatten(-2), torch.zeros(1)),
        {"data": None},
        refuses_levels=True,
        laws=Laws(phase="works on real phases"),
    ),
    _entry(
        "metrics.residual_phase",
        "raw",
        lambda x: metrics.residual_phase(x.real.flatten(-2), torch.zeros(1)),
        {"data": None},
        refuses_levels=True,
        laws=Laws(phase="works on real phases"),
    ),
    _entry(
        "metrics.strehl",
        "raw",
        lambda x: metrics.strehl(x.real.flatten(-2)),
        {"data": None},
        refuses_levels=True,
        laws=Laws(phase="works on real phases"),
    ),
]


def _on_signal(name: str, kind: str, build: Callable[[], Stage], laws: Laws = ALL_LAWS, **values: Any) -> Entry:
    """A stage whose promises as a stage are tested elsewhere."""
    return Entry(name, kind, on(kind, lambda signal: build()(signal, **values)), laws=laws, build=build)


SWEPT = radar.InverseRadar(3.2e9, 50e6, 400.0, pulse_s=2e-3)


def _swept(signal: Signal) -> Signal:
    """Corrects the motion of an antenna that flies by, within its sweeps."""
    along = 2.0 * torch.arange(signal.axes[0].n, dtype=F64) - 20
    place = torch.stack([torch.full_like(along, -300.0), along, torch.full_like(along, 100.0)], -1)
    correct = compensate.CorrectSweepMotion(SWEPT, squint_deg=20.0)
    return correct(signal, place.to(signal.data.device), 2 * place.norm(dim=-1).to(signal.data.device))


MORE_STAGES = [
    _on_signal("AlignEnvelopes", "turntable", compensate.AlignEnvelopes, laws=RANGE_FREE),
    _on_signal("PulseGain", "turntable", compensate.PulseGain, laws=RANGE_FREE),
    _on_signal("SharpestPhase", "turntable", lambda: compensate.SharpestPhase(steps=5), laws=RANGE_FREE),
    _on_signal(
        "Autofocus:target",
        "turntable",
        lambda: compensate.Autofocus(imaging=focus.TargetImage(TURNTABLE)),
        RANGE_FREE,
    ),
    Entry(
        "EqualisePulses",
        "turntable",
        on("turntable", lambda s: compensate.EqualisePulses()(s, 1 + ramp(s.axes[0].n))),
        laws=Laws(pulse=LINE_NUMBER),
        build=compensate.EqualisePulses,
    ),
    Entry(
        "ShiftRange",
        "turntable",
        on("turntable", lambda s: compensate.ShiftRange()(s, ramp(s.axes[0].n))),
        laws=Laws(pulse=LINE_NUMBER, energy=1),
        build=compensate.ShiftRange,
    ),
    Entry(
        "CorrectSweepMotion",
        "turntable",
        on("turntable", _swept),
        laws=Laws(pulse="depends on the position of the antenna"),
        build=lambda: compensate.CorrectSweepMotion(SWEPT, squint_deg=20.0),
    ),
    _on_signal("CompressDechirped", "dechirped", lambda: focus.CompressDechirped(DECHIRPED), laws=Laws(energy=1 / 64)),
    _on_signal("QuickLook", "image", lambda: focus.QuickLook(16), laws=Laws(linear="a modulus")),
    _on_signal(
        "StoredOmegaK",
        "raw",
        lambda: focus.StoredOmegaK(focus.OmegaK(RADAR), _signal("raw").axes, torch.complex64),
        laws=Laws(
            linear="works on complex64 with its own axes only; OmegaK, which it stores, is in the table",
            phase="works on complex64 with its own axes only; OmegaK, which it stores, is in the table",
        ),
    ),
    _on_signal("EstimateFlatResponse", "wide image", lambda: repair.EstimateFlatResponse(RADAR, stages.FEW_POINTS)),
    _on_signal(
        "MigratingLines",
        "range",
        lambda: multichannel.MigratingLines(BISTATIC, multichannel.Interferometry(BISTATIC, LIT)),
    ),
]
STAGES = [row for case in stages.CASES for row in _rows(case)]
ENTRIES = STAGES + MORE_STAGES + FUNCTIONS
