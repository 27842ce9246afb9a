"""Every public function and stage, with arguments on which it works.

`ENTRIES` are calls on samples, `NUMBERS` calls with numbers; `REASONS` says of every other public
name why it is in neither. A new public function joins by one line.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from tests.contract import test_stages as contract
from tests.helpers import small_bistatic, small_ladar, small_radar
from torchsar import compensate, core, echo, focus, metrics, multichannel, radar, repair, scene
from torchsar.compensate.group import RangeGroup
from torchsar.core import Draws, Estimate, Signal, Stage
from torchsar.echo.turntable import fast_time_axis
from torchsar.optim import parabola_minimum
from torchsar.radar import FarField, InverseRadar

RADAR, LADAR, BISTATIC = small_radar(), small_ladar(), small_bistatic()
TURNTABLE = InverseRadar(3.2e9, 50e6, 400.0, 0.01)
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
        joint: All trials together give one result.
        refuses_levels: It refuses samples whose power does not fit their precision.
        least: Size of a result below which its rounding errors do not matter.
    """

    name: str
    kind: str
    call: Callable[[Tensor], Any]
    degree: dict[str, int | None] = field(default_factory=dict)
    zero_ok: str = ""
    joint: bool = False
    refuses_levels: bool = False
    least: float = 0.0


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
        case = next(c for c in contract.CASES if c.name == kind[5:])
        return contract.entering(case, contract.raw(trials, dtype, n_range=case.n_range))
    if kind in ("record", "sweeps", "profiles"):
        return contract.raw_ladar(kind, trials, dtype, 48)
    base = contract.raw(trials, dtype, n_range={"wide": 128, "wide image": 300}.get(kind, 64))
    if kind in ("range", "line", "doppler"):
        return contract.raw_channels(kind, base)
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


def _stage(case: contract.Case) -> Entry:
    kind = f"case {case.name}"

    def call(data: Tensor) -> Any:
        signal = fitted(kind, data)
        one = signal.with_data(torch.zeros(1, *(axis.n for axis in signal.axes), dtype=torch.complex128))
        values = {key: value[0].expand((*signal.trials, *value.shape[1:])) for key, value in case.values(one).items()}
        return case.build()(signal, **values)

    zero_ok = {
        "line_integrity": "it is the numbers of the lines that are right",
        "subtract_interference": "lines of zeros hold no interference",
        "notch_interference": "lines of zeros hold no interference",
        "drop_interference": "lines of zeros hold no interference",
        "pilot_jitter": "the jitter comes from the pilot",
        "estimate_synchronisation": "the phase comes from the direct path",
    }.get(case.name, "")
    return Entry(f"{type(case.build()).__name__}:{case.name}", kind, call, {}, zero_ok)


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
    return focus.TilePlan(frequency_hz, place, None, 2 * torch.linalg.vector_norm(place, dim=-1), grid)


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
LIT = multichannel.Dwell(1.4)
REBUILD = multichannel.LeastSquares(3)
BAND = RADAR.pulse.bandwidth_hz / RADAR.sampling_hz


def cells(x: Tensor) -> Tensor:
    return 0.3 * (torch.arange(x.shape[-1], dtype=F64) - x.shape[-1] // 2)


def figure(x: Tensor) -> Any:
    return compensate.ImageEntropy(x, contract.SEARCH, range_m=cells(x), **OPTIONS)


def sweeps(f: Callable, **kw: Any) -> Callable[[Tensor], Any]:
    return on("sweeps", lambda s: f(s.data, LADAR, s.axis("pulse"), **kw))


def _entry(
    name: str, kind: str, call: Callable[[Tensor], Any], degree: int | dict[str, int | None] = 1, **options: Any
) -> Entry:
    return Entry(name, kind, call, degree if isinstance(degree, dict) else {"data": degree}, **options)


FUNCTIONS = [
    _entry("core.centred_fft", "raw", core.centred_fft),
    _entry("core.centred_ifft", "raw", core.centred_ifft),
    _entry("core.fft_lines", "raw", core.fft_lines),
    _entry("core.spectrum_in_blocks", "raw", core.spectrum_in_blocks),
    _entry("core.transform_in_blocks", "raw", lambda x: core.transform_in_blocks(x.clone(), -2)),
    _entry("core.to_frequency", "raw", on("raw", lambda s: core.to_frequency(s, "range"))),
    _entry(
        "core.from_frequency",
        "raw",
        on("raw", lambda s: core.from_frequency(core.to_frequency(s, "range"), "range_frequency")),
    ),
    _entry("radar.frequency_samples", "raw", radar.frequency_samples),
    _entry("radar.range_profiles", "raw", radar.range_profiles),
    # repair
    _entry("repair.band_limited_fill", "raw", lambda x: repair.band_limited_fill(x, missing(x))),
    _entry("repair.zero_fill", "raw", lambda x: repair.zero_fill(x, missing(x))),
    _entry("repair.linear_fill", "raw", lambda x: repair.linear_fill(x, missing(x), 0.01)),
    _entry("repair.sparse_fill", "raw", lambda x: repair.sparse_fill(x, missing(x), RADAR, doppler_hz=5.0)),
    _entry("repair.blank_turning_points", "sweeps", lambda x: repair.blank_turning_points(x, LADAR, 100.0)),
    _entry(
        "repair.calibrate_sweeps",
        "sweeps",
        on(
            "sweeps",
            lambda s: repair.calibrate_sweeps(
                s.data, contract._calibration(_signal("sweeps"))["calibration"][0], LADAR, 1e-9
            ),
        ),
    ),
    _entry("repair.circular_shift", "record", lambda x: repair.circular_shift(x, 3.3e-6, LADAR)),
    _entry("repair.split_record", "record", lambda x: repair.split_record(x, LADAR, 3.3e-6)),
    _entry("repair.find_trigger", "record", lambda x: repair.find_trigger(x, LADAR)),
    _entry(
        "repair.correct_imbalance",
        "raw",
        lambda x: repair.correct_imbalance(x, torch.tensor([1.0, 1.2]), torch.tensor([0.0, 0.5])),
    ),
    _entry(
        "repair.correct_jitter",
        "raw",
        lambda x: repair.correct_jitter(x, torch.tensor([0.05, -0.03, 0.02, -0.04], dtype=F64)),
    ),
    _entry(
        "repair.correct_jitter_exact",
        "raw",
        lambda x: repair.correct_jitter_exact(x, torch.tensor([0.05, -0.03, 0.02, -0.04], dtype=F64)),
    ),
    _entry(
        "repair.correct_response",
        "raw",
        lambda x: repair.correct_response(x, 0.5 * torch.linspace(-1, 1, 129, dtype=F64) ** 3, None, BAND),
    ),
    _entry("repair.drop_interference", "raw", repair.drop_interference),
    _entry("repair.notch_interference", "raw", repair.notch_interference),
    _entry("repair.subtract_interference", "raw", repair.subtract_interference),
    _entry("repair.find_contamination", "raw", repair.find_contamination),
    _entry("repair.estimate_imbalance", "raw", repair.estimate_imbalance),
    _entry("repair.estimate_jitter_blind", "wide", lambda x: repair.estimate_jitter_blind(x, 4)),
    _entry("repair.estimate_jitter_pilot", "row", lambda x: repair.estimate_jitter_pilot(x, 4)),
    _entry(
        "repair.estimate_response_points",
        "wide image",
        lambda x: repair.estimate_response_points(x, BAND, 40, passes=2),
    ),
    _entry("repair.estimate_response_sharpest", "wide image", lambda x: contract.FEW_POINTS(x, BAND)),
    _entry(
        "repair.estimate_amplitude_response",
        "wide image",
        lambda x: repair.estimate_amplitude_response(
            size(x).double().square().mean(-2), torch.ones(x.shape[-1], dtype=F64), BAND, 8
        ),
        0,
    ),
    _entry(
        "repair.line_integrity",
        "raw",
        lambda x: repair.line_integrity(x, torch.arange(x.shape[-2]) + 100),
        zero_ok="it is the numbers of the lines that are right",
    ),
    _entry(
        "repair.place_lines",
        "raw",
        lambda x: repair.place_lines(x, (torch.arange(x.shape[-2]) - 1).expand(x.shape[:-1])),
    ),
    # compensate
    _entry("compensate.align_envelopes", "raw", compensate.align_envelopes),
    _entry("compensate.shift_range", "raw", lambda x: compensate.shift_range(x, ramp(x.shape[-2]))),
    _entry("compensate.pulse_gain", "raw", compensate.pulse_gain),
    _entry("compensate.equalise_pulses", "raw", lambda x: compensate.equalise_pulses(x, 1 + ramp(x.shape[-2]))),
    _entry("compensate.autofocus", "raw", compensate.autofocus),
    _entry("compensate.sca", "raw", compensate.sca),
    _entry("compensate.pga", "raw", compensate.pga),
    _entry("compensate.pga_sca", "raw", compensate.pga_sca),
    _entry("compensate.entropy_fixed_point", "raw", compensate.entropy_fixed_point),
    _entry("compensate.link_phases", "raw", compensate.link_phases),
    _entry("compensate.sharpest_phase", "raw", lambda x: compensate.sharpest_phase(x, steps=10)),
    _entry("compensate.phase_polish", "raw", compensate.phase_polish),
    _entry(
        "compensate.rotating_autofocus",
        "raw",
        lambda x: compensate.rotating_autofocus(
            x, 400.0, torch.tensor([1.0, 5.0], dtype=F64).expand(math.prod(x.shape[:-2]), 2), search=4, polish=2
        ),
    ),
    _entry("compensate.correct_pulse_phase", "raw", lambda x: compensate.correct_pulse_phase(x, ramp(x.shape[-2]))),
    _entry(
        "compensate.chirplet_clean",
        "raw",
        lambda x: compensate.chirplet_clean(x, 400.0, atoms=3),
        {"amplitude": 1, "image": 1},
    ),
    _entry("compensate.coarse_rotation", "raw", lambda x: compensate.coarse_rotation(x, range_m=cells(x), **OPTIONS)),
    _entry(
        "compensate.phase_fit_rotation", "raw", lambda x: compensate.phase_fit_rotation(x, range_m=cells(x), **OPTIONS)
    ),
    _entry("compensate.uneven_rotation", "raw", lambda x: compensate.uneven_rotation(x, range_m=cells(x), **OPTIONS)),
    _entry(
        "compensate.search_rotation",
        "raw",
        lambda x: compensate.search_rotation(figure(x), [torch.tensor([0.1, 0.5]), torch.tensor([-2.0, 2.0])]),
    ),
    _entry(
        "compensate.genetic_rotation",
        "raw",
        lambda x: compensate.genetic_rotation(
            figure(x), [0.1, -2.0], [0.5, 2.0], draws=Draws(1), population=6, generations=2
        ),
    ),
    _entry(
        "compensate.evolve_rotation",
        "raw",
        lambda x: compensate.evolve_rotation(
            figure(x), [0.1, -2.0], [0.5, 2.0], draws=Draws(1), population=6, generations=2
        ),
    ),
    _entry(
        "compensate.newton_rotation",
        "raw",
        lambda x: compensate.newton_rotation(figure(x), torch.tensor([0.3, 0.5], dtype=F64), steps=2),
    ),
    _entry(
        "compensate.descend_rotation",
        "raw",
        lambda x: compensate.descend_rotation(figure(x), torch.tensor([0.3, 0.5], dtype=F64), steps=2),
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
    ),
    _entry("compensate.segmented_interference", "sweeps", sweeps(compensate.segmented_interference)),
    _entry("compensate.mirror_product", "sweeps", sweeps(compensate.mirror_product)),
    _entry("compensate.ml_peak", "sweeps", sweeps(compensate.ml_peak)),
    _entry("compensate.spectrum_correlation", "sweeps", sweeps(compensate.spectrum_correlation)),
    _entry("compensate.radial_motion", "sweeps", sweeps(compensate.radial_motion)),
    _entry("compensate.phase_increment", "raw", lambda x: compensate.phase_increment(x, 400.0, (2, 2))),
    _entry("compensate.energy_centre", "raw", lambda x: compensate.energy_centre(x, 400.0, (2, 2))),
    _entry("compensate.lag_products", "raw", lambda x: compensate.lag_products(x, (2, 2)), 0),
    _entry("compensate.point_doppler", "row", lambda x: compensate.point_doppler(x, 400.0, 20.0), 0),
    _entry(
        "compensate.minimum_entropy_velocity",
        "raw",
        lambda x: compensate.minimum_entropy_velocity(
            group(x),
            torch.zeros(x.shape[:-2], dtype=F64),
            0.1,
            5.0,
            parabola_minimum,
            0.1,
        ),
    ),
    _entry(
        "compensate.peak_time_s",
        "image",
        lambda x: compensate.peak_time_s(
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
        "multichannel.along_track_velocity",
        "line",
        lambda x: multichannel.along_track_velocity(x, BISTATIC, motion(x), LIT),
    ),
    _entry("multichannel.interferometry", "line", lambda x: multichannel.interferometry(x, BISTATIC, motion(x), LIT)),
    _entry(
        "multichannel.gradient_likelihood",
        "line",
        lambda x: multichannel.gradient_likelihood(x, BISTATIC, motion(x), LIT, steps=5),
    ),
    _entry(
        "multichannel.maximum_likelihood",
        "line",
        lambda x: multichannel.maximum_likelihood(x, BISTATIC, motion(x), LIT),
        {"amplitude": 1, "noise_power": 2, "energy": 2},
    ),
    _entry(
        "multichannel.moving_point_velocity",
        "line",
        lambda x: multichannel.moving_point_velocity(x, BISTATIC, LIT, contract.FEW_VELOCITIES),
    ),
    _entry(
        "multichannel.explained_energy",
        "line",
        lambda x: multichannel.explained_energy(x, BISTATIC, motion(x), torch.ones(x.shape[-1], dtype=F64)),
        2,
    ),
    _entry(
        "multichannel.sample_whitening",
        "line",
        lambda x: multichannel.sample_whitening(x, BISTATIC),
        {"factor": -1, "log_det": None},
    ),
    _entry(
        "multichannel.line_whitening",
        "range",
        lambda x: multichannel.line_whitening(x.movedim(-1, -3), BISTATIC),
        {"factor": -1, "log_det": None},
    ),
    _entry("multichannel.reconstruct", "line", lambda x: multichannel.reconstruct(x, BISTATIC, motion(x), REBUILD)),
    _entry(
        "multichannel.reconstruct_lines",
        "range",
        lambda x: multichannel.reconstruct_lines(x, BISTATIC, motion(x), REBUILD),
    ),
    _entry(
        "multichannel.remove_transmit_range",
        "line",
        lambda x: multichannel.remove_transmit_range(
            x, times(x), BISTATIC.transmit_range, BISTATIC.wavelength_m, False
        ),
    ),
    _entry(
        "multichannel.scale_azimuth",
        "line",
        lambda x: multichannel.scale_azimuth(x, BISTATIC, times(x), motion(x), with_range=False),
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
        "multichannel.estimate_balance",
        "range",
        lambda x: multichannel.estimate_balance(x, BISTATIC, multichannel.FlatBand(300.0), 3, blocks=4),
    ),
    _entry(
        "multichannel.correct_migration",
        "range",
        on(
            "range",
            lambda s: multichannel.correct_migration(s.data, multichannel.Frame.of(BISTATIC, s), motion(s.data)),
        ),
    ),
    _entry("multichannel.stationary_image", "range", lambda x: multichannel.stationary_image(x, BISTATIC, 4900.0)),
    _entry(
        "multichannel.focus_azimuth",
        "doppler",
        on(
            "doppler",
            lambda s: multichannel.focus_azimuth(s.data, s.axes[-1].values(), BISTATIC, motion(s.data), 300.0),
        ),
    ),
    _entry(
        "multichannel.find_body",
        "one range",
        on(
            "one range",
            lambda s: multichannel.find_body(
                s.data, multichannel.Frame.of(BISTATIC, s), 0.0, 5000.0, multichannel.Extraction(60.0, 5.0)
            ),
        ),
        joint=True,
    ),
    _entry("multichannel.detect", "one image", on("one image", lambda s: multichannel.detect(s))),
    # focus
    _entry("focus.amplitude", "image", focus.amplitude),
    _entry("focus.multilook", "image", lambda x: focus.multilook(x, (2, 2)), 2, refuses_levels=True),
    _entry("focus.to_db", "image", lambda x: focus.to_db(size(x)), 0),
    _entry("focus.azimuth_transform", "raw", lambda x: focus.azimuth_transform(x, "hann", 2)),
    _entry("focus.chirp_z", "raw", lambda x: focus.chirp_z(x, 0.1, 0.01, 17)),
    _entry(
        "focus.keystone", "raw", lambda x: focus.keystone(x, torch.linspace(-2e7, 2e7, x.shape[-1], dtype=F64), 3.2e9)
    ),
    _entry(
        "focus.nufft_type1",
        "raw",
        lambda x: focus.nufft_type1(x, torch.linspace(-0.4, 0.3, x.shape[-1], dtype=F64), 16),
    ),
    _entry("focus.nufft_type2", "raw", lambda x: focus.nufft_type2(x, torch.linspace(-0.4, 0.3, 17, dtype=F64))),
    _entry(
        "focus.matched_fourier", "raw", lambda x: focus.matched_fourier(x, torch.tensor([1.0, 5.0], dtype=F64), 400.0)
    ),
    _entry(
        "focus.range_phase",
        "raw",
        lambda x: focus.range_phase(x, cells(x), 0.1, 400.0, 0.3, torch.tensor([1.0, 5.0], dtype=F64)),
    ),
    _entry(
        "focus.range_compress",
        "raw",
        lambda x: focus.range_compress(x, focus.matched_reference(RADAR.pulse, x.shape[-1], RADAR.sampling_hz)),
    ),
    _entry(
        "focus.compress_dechirped", "dechirped", lambda x: focus.compress_dechirped(x, TURNTABLE, residual_video=False)
    ),
    _entry("focus.compress_sweeps", "sweeps", lambda x: focus.compress_sweeps(x, LADAR)),
    _entry(
        "focus.deramp_azimuth",
        "profiles",
        on("profiles", lambda s: focus.deramp_azimuth(s.data, LADAR, s.axes[-2], s.axes[-1])),
    ),
    _entry(
        "focus.azimuth_matched_filter",
        "profiles",
        on("profiles", lambda s: focus.azimuth_matched_filter(s.data, LADAR, s.axes[-2], s.axes[-1])),
    ),
    _entry(
        "focus.backproject_strip",
        "raw",
        lambda x: focus.backproject_strip(x, RADAR, ramp(5, 1.0), 4020 + ramp(5, 3.0), **DOPPLER),
    ),
    _entry(
        "focus.backproject_spotlight",
        "raw",
        lambda x: focus.backproject_spotlight(x, waves(*x.shape[-2:]), ramp(5, 1.0), ramp(5, 1.0)),
    ),
    _entry("focus.backproject", "raw", direct_sum),
    _entry("focus.image_tiles", "raw", lambda x: tile_plan(*x.shape[-2:]).image(x)),
    _entry("focus.compensated_omega_k", "raw", compensated),
    _entry("focus.omega_k", "raw", lambda x: focus.omega_k(x, RADAR, **DOPPLER)),
    _entry("focus.omega_k_stolt", "raw", lambda x: focus.omega_k_stolt(x, RADAR, **DOPPLER)),
    _entry("focus.range_doppler", "raw", lambda x: focus.range_doppler(x, RADAR, **DOPPLER)),
    _entry("focus.defocus_omega_k", "image", lambda x: focus.defocus_omega_k(x, RADAR, **DOPPLER)),
    _entry("focus.closest_range", "image", lambda x: focus.closest_range(x, RADAR, 5.0)),
    # metrics
    _entry("metrics.entropy", "image", metrics.entropy, 0, least=0.01),
    _entry("metrics.contrast", "image", metrics.contrast, 0),
    _entry("metrics.correlation", "image", lambda x: metrics.correlation(x, x.roll(1, -1)), 0),
    _entry("metrics.error_db", "image", lambda x: metrics.error_db(x, x.roll(1, -1)), 0),
    _entry(
        "metrics.error_after_gain_db", "image", lambda x: metrics.error_after_gain_db(x, x.roll(1, -1)), 0, joint=True
    ),
    _entry("metrics.registered_error_db", "image", lambda x: metrics.registered_error_db(x, x.roll(1, -1).conj()), 0),
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
    ),
    _entry(
        "metrics.phase_rmse",
        "raw",
        lambda x: metrics.phase_rmse(x.real.flatten(-2), torch.zeros(1)),
        {"data": None},
        refuses_levels=True,
    ),
    _entry(
        "metrics.residual_phase",
        "raw",
        lambda x: metrics.residual_phase(x.real.flatten(-2), torch.zeros(1)),
        {"data": None},
        refuses_levels=True,
    ),
    _entry("metrics.strehl", "raw", lambda x: metrics.strehl(x.real.flatten(-2)), {"data": None}, refuses_levels=True),
]


def _on_signal(name: str, kind: str, build: Callable[[], Stage], **values: Any) -> Entry:
    """A stage that the contract does not list."""
    return Entry(name, kind, on(kind, lambda signal: build()(signal, **values)))


MORE_STAGES = [
    _on_signal("AlignEnvelopes", "turntable", compensate.AlignEnvelopes),
    _on_signal("PulseGain", "turntable", compensate.PulseGain),
    _on_signal("SharpestPhase", "turntable", lambda: compensate.SharpestPhase(steps=5)),
    Entry(
        "EqualisePulses",
        "turntable",
        on("turntable", lambda s: compensate.EqualisePulses()(s, 1 + ramp(s.axes[0].n))),
    ),
    Entry("ShiftRange", "turntable", on("turntable", lambda s: compensate.ShiftRange()(s, ramp(s.axes[0].n)))),
    _on_signal("CompressDechirped", "dechirped", lambda: focus.CompressDechirped(DECHIRPED)),
    _on_signal("QuickLook", "image", lambda: focus.QuickLook(16)),
    _on_signal(
        "StoredOmegaK",
        "raw",
        lambda: focus.StoredOmegaK(focus.OmegaK(RADAR), _signal("raw").axes, torch.complex64),
    ),
    _on_signal("EstimateFlatResponse", "wide image", lambda: repair.EstimateFlatResponse(RADAR, contract.FEW_POINTS)),
    _on_signal(
        "MigratingLines",
        "range",
        lambda: multichannel.MigratingLines(BISTATIC, multichannel.Interferometry(BISTATIC, LIT)),
    ),
]
STAGES = [_stage(case) for case in contract.CASES]
ENTRIES = STAGES + MORE_STAGES + FUNCTIONS
REASONS = {
    "core.Stage": "the base class of all stages",
    "core.block_bytes_of": "takes a device only",
    "core.is_plain": "whether a tensor has storage, whatever its values",
    "core.over_blocks": "runs a function; takes no numbers",
    "core.counts": "counts codes, not samples; tests/core/test_outcome.py",
    "core.worst": "joins codes, not samples; tests/core/test_outcome.py",
    "core.use": "names connections; takes no numbers",
    "core.checked_samples": "the check itself; tests/core/test_core.py",
    "core.refuse_non_finite": "the check itself; tests/core/test_core.py",
    "core.refuse_non_finite_values": "the check itself; tests/core/test_core.py",
    "core.best_of": "index arithmetic that callers inside the package have checked",
    "core.is_out_of_memory": "takes an exception only",
    "core.take": "index arithmetic that callers inside the package have checked",
    "core.per_trial": "appends dimensions; no arithmetic",
    "core.device_fault": "takes a device only; tests/core/test_host.py",
    "core.host_value": "reads one number",
    "core.host_values": "reads numbers",
    "core.true_positions": "index arithmetic that callers inside the package have checked",
    "core.validate": "takes the name of a mode; tests/core/test_validate.py",
    "core.validation": "takes no arguments",
    "core.check_value": "reads numbers; tests/core/test_host.py",
    "core.gathered_checks": "takes no arguments; tests/core/test_host.py",
    "core.is_traced": "whether a tensor has values, whatever they are; tests/core/test_host.py",
    "core.untraced": "looks at the kinds of its arguments only; tests/core/test_host.py",
    "core.numbers_on": "makes a tensor of numbers",
    "core.linear_solve": "torch.linalg.solve; tests/core/test_host.py",
    "core.matrix_inverse": "torch.linalg.inv; tests/core/test_host.py",
    "core.cholesky_factor": "torch.linalg.cholesky; tests/core/test_host.py",
    "core.host_largest": "reads one number",
    "core.outer_phasor": "a product of two tables that phasor_tables has made",
    "core.real_dtype": "takes a dtype only",
    "radar.geometry_of": "builds a geometry, whose classes check their fields; tests/focus/test_spotlight.py",
    "io.export_images": "writes files; tests/io/test_export.py",
    "io.export_recording": "writes files; tests/io/test_export.py",
    "io.import_recording": "reads and writes files; tests/io/test_sidecar.py",
    "io.read_images": "reads a file; tests/io/test_export.py",
    "io.write_arrays": "writes files; tests/io/test_export.py",
    "io.write_netcdf": "writes a file; tests/io/test_export.py",
    "io.read_inverse": "reads a file; tests/io/test_damaged.py",
    "io.read_path": "reads a file; tests/io/test_damaged.py",
    "io.samples_checksum": "a checksum of bytes; tests/io/test_strip.py",
    "io.write_strip_geotiff": "writes a file; tests/io/test_geotiff.py",
    "io.read_stripmap": "reads a file; tests/io/test_damaged.py",
    "io.read": "reads a file; tests/io/test_formats.py",
    "io.read_cphd": "reads a file; tests/io/test_formats.py",
    "io.read_history": "reads a file; tests/io/test_formats.py",
    "io.read_sicd": "reads a file; tests/io/test_formats.py",
    "io.format_of": "takes a path only; tests/io/test_formats.py",
    "io.write_cphd": "writes a file; tests/io/test_cphd.py",
    "io.write_geotiff": "writes a file; tests/io/test_geotiff.py",
    "io.write_sicd": "writes a file; tests/io/test_sicd.py",
    "multichannel.ImageMovers": "needs seconds for one scene; tests/multichannel/test_scene_image.py",
    "multichannel.MoversImage": "needs seconds for one scene; tests/multichannel/test_scene_image.py",
    "multichannel.known_motion_chain": "builds a chain of stages that are all in the table",
    "multichannel.body_echo": "works on the Body that find_body, which is in the table, has made",
    "focus.PolarFormat": "resamples frequencies of a geometry; tests/focus/test_polar.py",
    "focus.SpotlightBackprojection": "the stage of backproject_spotlight, which is in the table",
    "focus.PathImage": "the base class of TileImage, OmegaKImage and DirectImage",
    "focus.OmegaKImage": "the stage of compensated_omega_k; tests/focus/test_motion_compensation.py",
    "focus.TileImage": "the stage of image_tiles, which is in the table; tests/focus/test_path_image.py",
    "focus.SpotlightImage": "a TileImage on a grid of its own; tests/focus/test_spotlight_image.py",
    "focus.scene_grid": "works on an AntennaPath, whose class checks it; tests/focus/test_spotlight_image.py",
    "focus.DirectImage": "the stage of backproject, which is in the table; tests/focus/test_path_image.py",
    "focus.focus_strip": "runs a stage over blocks of lines; tests/focus/test_strip.py",
    "focus.focus_block": "runs a stage on one block of lines; tests/focus/test_strip.py",
    "focus.write_strip": "writes a file; tests/focus/test_strip.py",
    "focus.plan_strip": "counts lines and bytes; tests/focus/test_strip.py",
    "focus.recommended_form": "takes requirements only",
    "radar.orbit_range": "works on an Orbit, whose class checks it; tests/scene/test_orbit.py",
    "radar.range_coefficients": "works on an Orbit, whose class checks it; tests/scene/test_orbit.py",
    "radar.seen_point": "works on a satellite's position; tests/scene/test_orbit.py",
    "radar.sweep_middles": "reads an axis that the radar has made",
    "radar.timing_diagram": "checks all its arguments; tests/scene/test_orbit.py",
    "scene.displacement_m": "adds motions, whose classes check them",
    "scene.drawn_motion": "draws motions, whose classes check them",
    "scene.start_phase_rad": "draws phases of effects, whose classes check them",
    "echo.apply_impairments": "applies impairments, whose classes check them; tests/echo",
    "echo.bistatic_echo": "the echo of simulate_bistatic, which is in the table",
    "echo.path_echo": "the echo of simulate_path, which is in the table",
    "echo.calibration_channel": "made of a fibre, whose class checks it; tests/repair/test_triangle_calibrate.py",
    "echo.dechirped_echo": "the echo of simulate_turntable with a pulse length; tests/focus/test_dechirped.py",
    "echo.ladar_echo": "the echo of simulate_ladar, which is in the table",
    "echo.ladar_record": "the echo of simulate_ladar_record, which is in the table",
    "echo.range_model_error_db": "compares two echoes of simulate_ladar; tests/echo/test_ladar.py",
    "echo.sea_echo": "made of a Sea, whose class checks it; tests/echo/test_sea.py",
    "echo.stripmap_echo": "the echo of simulate, which is in the table",
    "echo.target_energy": "works on the truth of a simulation",
    "echo.turntable_echo": "the echo of simulate_turntable, which is in the table",
    "compensate.path_autofocus": "needs a path; tests/compensate/test_path_autofocus.py",
    "compensate.path_phase": "compensate.autofocus, which is in the table, through tiles; tests/compensate/"
    "test_path_autofocus.py",
    "compensate.CorrectPath": "subtracts positions",
    "compensate.PathAutofocus": "the stage of compensate.path_autofocus",
    "compensate.strip_autofocus": "needs a path; tests/compensate/test_strip_autofocus.py",
    "compensate.StripAutofocus": "the stage of compensate.strip_autofocus",
    "compensate.PathPhase": "the stage of compensate.path_phase",
    "metrics.line_of_sight_bound_m": "works on a scene of scatterers; tests/metrics/test_path_bounds.py",
    "compensate.range_error": "integrates an estimate by integrated_range, which is in the table",
    "compensate.turning_points": "reads an axis that the radar has made",
    "multichannel.multichannel_limits": "checks its use of the radar; tests/multichannel/test_requirements.py",
    "multichannel.multichannel_requirements": "checks its use of the radar; tests/multichannel/test_requirements.py",
    "focus.inverse_requirements": "checks all its numbers; tests/study/test_requires.py",
    "focus.ladar_limits": "checks all its numbers; tests/focus/test_ladar_requirements.py",
    "focus.ladar_requirements": "checks all its numbers; tests/focus/test_ladar_requirements.py",
    "focus.requirements": "works on a radar, whose class checks it; tests/study/test_requires.py",
    "focus.profile_axes": "reads an axis that the radar has made",
    "focus.quicklook_looks": "counts samples of a picture",
    "focus.reach_lines": "works on a radar, whose class checks it; tests/focus/test_strip.py",
    "metrics.finite_rms": "statistics of recorded sweeps; tests/metrics/test_intervals.py",
    "metrics.half_width_ratio": "statistics of recorded sweeps; tests/metrics/test_intervals.py",
    "metrics.share_interval": "statistics of recorded sweeps; tests/metrics/test_intervals.py",
    "metrics.trial_statistics": "statistics of recorded sweeps; tests/metrics/test_intervals.py",
    "metrics.pulse_phase_bound_of_scene_rad": "works on a scene of scatterers; tests/metrics/test_phase.py",
    **{
        f"optim.{name}": "minimises a function that is given; tests/optim"
        for name in (
            "adam",
            "differential_evolution",
            "genetic",
            "gradient_minimum",
            "grid_minimum",
            "grid_search",
            "lbfgs",
            "newton",
            "parabola_minimum",
        )
    },
}

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
    "radar.plane_wave_loss": (
        radar.plane_wave_loss,
        {"radius_m": 2.0, "range_m": 900.0, "aperture_rad": 0.1, "wavelength_m": 0.03, "elevation_rad": 0.2},
    ),
    "radar.polynomial_range": (radar.polynomial_range, {"coefficients": (1.0, 2.0), "time_s": ONES}),
    "radar.receive_range": (
        radar.receive_range,
        {"time_s": ONES, **MOTION, "speed_m_s": 300.0, "channel_m": 1.0},
    ),
    "scene.gamma_from_normal": (scene.gamma_from_normal, {"x": 0.3 * ONES, "shape": 1.5}),
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
    "compensate.geometric_velocity_m_s": (
        lambda **given: compensate.geometric_velocity_m_s(LADAR, LINE, **given),
        {"azimuth_m": 0.1, "relative_range_m": 0.2},
    ),
    "compensate.integrated_range": (
        lambda velocity_m_s, at_s: compensate.integrated_range(velocity_m_s, LADAR, LADAR.sweep_axes(8)[1], at_s),
        {"velocity_m_s": torch.ones(8, dtype=F64), "at_s": 1e-5 * ONES},
    ),
    "multichannel.ambiguity_number": (
        _moving(lambda radar_, point: multichannel.ambiguity_number(radar_, point, point)),
        MOTION,
    ),
    "multichannel.azimuth_filter": (
        _moving(lambda radar_, point: multichannel.azimuth_filter(ONES, radar_, point, torch.complex64)),
        MOTION,
    ),
    "multichannel.band_matrix": (_moving(multichannel.band_matrix, bands=3), MOTION),
    "multichannel.condition_number": (_moving(multichannel.condition_number, bands=3), MOTION),
    "multichannel.noise_gain_db": (_moving(multichannel.noise_gain_db, rebuild=REBUILD), MOTION),
    "multichannel.doppler_offsets": (lambda prf_hz: multichannel.doppler_offsets(8, 3, prf_hz), {"prf_hz": 180.0}),
    "focus.cross_range_of": (
        lambda **given: focus.cross_range_of(k=WARP, **given),
        {"doppler_hz": ONES, "omega_rad_s": 0.3, "wavelength_m": 0.03, "duration_s": 0.1},
    ),
    "focus.mean_rate": (lambda **given: focus.mean_rate(k=WARP, **given), {"omega_rad_s": 0.3, "duration_s": 0.1}),
    "focus.lines_for": (focus.lines_for, {"cells": 5.0, "oversampling": 2.0}),
    "focus.flat_reference": (
        lambda sampling_hz: focus.flat_reference(RADAR.pulse, 64, sampling_hz),
        {"sampling_hz": 5e7},
    ),
    "focus.matched_reference": (
        lambda sampling_hz: focus.matched_reference(RADAR.pulse, 64, sampling_hz),
        {"sampling_hz": 5e7},
    ),
    "focus.phase_reference": (
        lambda sampling_hz: focus.phase_reference(RADAR.pulse, 64, sampling_hz),
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
    "metrics.radial_velocity_bound_m_s": (
        lambda **given: metrics.radial_velocity_bound_m_s(BISTATIC, **given),
        {"snr": 10.0, "n_seen": 64.0, "u_a_m_s": 2.0},
    ),
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
