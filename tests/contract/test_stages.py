"""What every stage promises: one list of stages, one family of tests.

A new stage joins by one line.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import pytest
import torch
from torch import Tensor

import torchsar
from tests.compensate import turning
from tests.helpers import (
    assert_forward_equals_backward,
    small_bistatic,
    small_bistatic_echo,
    small_ladar,
    small_ladar_recording,
    small_radar,
    small_recording,
)
from torchsar.compensate import (
    AlignEnvelopes,
    Autofocus,
    ChirpletClean,
    CoarseRotation,
    CompensateMotion,
    CorrectPath,
    CorrectPulsePhase,
    DopplerCentroid,
    EffectiveVelocity,
    EnergyCentre,
    EntropyFixedPoint,
    EntropyObjective,
    EqualisePulses,
    LinkPhases,
    MirrorProduct,
    MlPeak,
    PathAutofocus,
    PathPhase,
    Pga,
    PgaSca,
    PhaseFitRotation,
    PhaseIncrement,
    PhasePolish,
    PointDoppler,
    PulseGain,
    RadialMotion,
    RotationAutofocus,
    RotationDescent,
    RotationEvolution,
    RotationGenetic,
    RotationNewton,
    RotationSearch,
    Sca,
    SegmentedInterference,
    SharpestPhase,
    ShiftRange,
    SpectrumCorrelation,
    StripAutofocus,
    UnevenRotation,
)
from torchsar.core import Alternate, Estimate, Signal, Stage, Turn, real_dtype
from torchsar.focus import (
    AzimuthMatchedFilter,
    AzimuthTransform,
    Backproject,
    ClosestRange,
    CompressSweeps,
    DerampAzimuth,
    Detect,
    FocusStrip,
    MatchedFourier,
    OmegaK,
    OmegaKStolt,
    PaddedLines,
    RangeCompress,
    RangeDoppler,
    RangePhase,
    TargetImage,
)
from torchsar.multichannel import (
    AlongTrackAutofocus,
    AzimuthScaling,
    CompressChannels,
    CorrectBalance,
    CorrectMigration,
    Detector,
    Dwell,
    EstimateBalance,
    EstimateSynchronisation,
    Extraction,
    FlatBand,
    FocusAzimuth,
    FocusPlan,
    GradientVelocity,
    Interferometry,
    Keystone,
    LeastSquares,
    LikelihoodVelocity,
    MigratingLines,
    MinimumMeanSquare,
    MoversImage,
    MovingPointVelocity,
    Reconstruct,
    RemoveSynchronisation,
    RemoveTransmitRange,
    Search,
    SignalIntensityRatio,
    StationaryImage,
    WalkAmbiguity,
)
from torchsar.radar import InverseRadar
from torchsar.repair import (
    BandLimitedFill,
    BlankTurningPoints,
    BlindJitter,
    CalibrateSweeps,
    CircularShift,
    CorrectImbalance,
    CorrectJitter,
    CorrectResponse,
    DropInterference,
    EstimateFlatResponse,
    EstimateImbalance,
    EstimateResponse,
    LinearFill,
    LineIntegrity,
    NotchInterference,
    PilotJitter,
    SparseFill,
    SplitSweeps,
    SubtractInterference,
    ZeroFill,
    estimate_response_sharpest,
)

RADAR = small_radar()
TURNTABLE = InverseRadar(3.2e9, 50e6, 400.0, 0.01)
LADAR = small_ladar()
BISTATIC = small_bistatic()
FEW_POINTS = partial(estimate_response_sharpest, points=40, orders=(4, 8), passes=2)


@dataclass(frozen=True)
class Case:
    """A stage, the per-trial values it is called with (name -> trial index -> value), and what may
    be asked of it.
    """

    name: str
    build: Callable[[], Stage]
    values: Callable[[Signal], dict[str, Tensor]] = field(default=lambda signal: {})
    differentiable: bool = True
    vmap: bool = True
    tolerance: float = 1e-9
    image: bool = False
    keeps_complex: bool = True
    n_range: int = 64
    ladar: str = ""
    channels: str = ""
    turning: bool = False


def _geometry(signal: Signal) -> dict[str, Tensor]:
    count = signal.trials.numel()
    at = torch.arange(count, dtype=torch.float64).reshape(signal.trials)
    return {"doppler_hz": 5.0 * at - 3.0, "velocity_m_s": 120.0 + at}


def _missing(signal: Signal) -> dict[str, Tensor]:
    lines = torch.arange(signal.axes[0].n)
    return {
        "missing": torch.stack([(lines % 11) == 3 + i for i in range(signal.trials.numel())]).reshape(
            *signal.trials, -1
        )
    }


def _numbers(signal: Signal) -> dict[str, Tensor]:
    lines = torch.arange(signal.axes[0].n)
    return {"line_number": (lines + 100 + (lines > 20)).expand(*signal.trials, -1).contiguous()}


def _offsets(signal: Signal) -> dict[str, Tensor]:
    base = torch.tensor([0.05, -0.03, 0.02, -0.04], dtype=torch.float64)
    return {
        "offset_samples": base
        * (1 + 0.1 * torch.arange(signal.trials.numel(), dtype=torch.float64).reshape(*signal.trials, 1))
    }


def _pilot(signal: Signal) -> dict[str, Tensor]:
    n = torch.arange(512, dtype=torch.float64)
    offsets = 0.05 * torch.sin(2 * torch.pi * (n % 4) / 4)
    tone = torch.polar(torch.ones_like(n), 2 * torch.pi * 0.1371 * (n + offsets))
    return {"pilot": tone.to(signal.data.dtype).expand(*signal.trials, -1).contiguous()}


def _imbalance(signal: Signal) -> dict[str, Tensor]:
    one = torch.ones(*signal.trials, 1, dtype=torch.float64)
    return {"gain": torch.cat([one, 1.2 * one], -1), "phase_rad": torch.cat([0 * one, 0.5 * one], -1)}


def _response(signal: Signal) -> dict[str, Tensor]:
    u = torch.linspace(-1, 1, 129, dtype=torch.float64)
    return {"phase_rad": (0.5 * u**3).expand(*signal.trials, -1).contiguous()}


def _phases(signal: Signal) -> dict[str, Tensor]:
    at = torch.arange(signal.trials.numel() * signal.axes[0].n, dtype=torch.float64)
    return {"phase_rad": (0.7 * at.square()).reshape(*signal.trials, -1)}


def _velocities(signal: Signal) -> dict[str, Tensor]:
    n = signal.axis("pulse").n
    at = torch.arange(signal.trials.numel() * n, dtype=torch.float64)
    return {"velocity_m_s": (0.1 * torch.sin(0.3 * at)).reshape(*signal.trials, n)}


def _calibration(signal: Signal) -> dict[str, Tensor]:
    u = LADAR.fast_time_axis().values()
    turns = LADAR.chirp_rate_hz_s * 1e-9 * (u + 2e-8 * torch.sin(2 * torch.pi * u / LADAR.sweep_s))
    tone = torch.stack([turns, -turns])[:, None]
    return {
        "calibration": torch.polar(torch.ones_like(tone), 2 * torch.pi * tone)
        .to(signal.data.dtype)
        .expand(*signal.trials, 2, 1, len(u))
        .contiguous()
    }


def _turn(signal: Signal) -> dict[str, Tensor]:
    at = torch.arange(signal.trials.numel(), dtype=torch.float64).reshape(signal.trials)
    return {"omega_rad_s": 0.3 + 0.1 * at, "warp_k": torch.stack([1.0 + at, 5.0 - at], -1), "yc_m": 2.0 * at}


def _warp(signal: Signal) -> dict[str, Tensor]:
    return {"warp_k": _turn(signal)["warp_k"]}


def _motion(signal: Signal) -> dict[str, Tensor]:
    at = torch.arange(signal.trials.numel(), dtype=torch.float64).reshape(signal.trials)
    return {"u_r_m_s": 3.0 + at, "u_a_m_s": 2.0 - at, "y0_m": 5.0 * at}


def _some_motion(*names: str) -> Callable[[Signal], dict[str, Tensor]]:
    return lambda signal: {name: _motion(signal)[name] for name in names}


def _balance(signal: Signal) -> dict[str, Tensor]:
    one = torch.ones(*signal.trials, 1, dtype=torch.float64)
    return {
        "phase_rad": torch.cat([0.3 * one, 0 * one, -0.2 * one], -1),
        "gain_db": torch.cat([one, 0 * one, 0.5 * one], -1),
    }


def _errors(signal: Signal) -> dict[str, Tensor]:
    at = torch.arange(signal.trials.numel() * signal.axis("pulse").n, dtype=torch.float64)
    return {"phase_rad": torch.sin(0.7 * at).reshape(*signal.trials, -1)}


def _direct_path(signal: Signal) -> dict[str, Tensor]:
    phase = _errors(signal)["phase_rad"]
    shape = torch.sinc((torch.arange(16, dtype=torch.float64) - 8) * BISTATIC.pulse.bandwidth_hz / BISTATIC.sampling_hz)
    return {"direct_path": (torch.polar(torch.ones_like(phase), phase)[..., None] * shape).to(signal.data.dtype)}


SEARCH = EntropyObjective(oversampling=1.0, order=2)
LIT = Dwell(1.4)
FEW_VELOCITIES = Search(u_r_m_s=3.0, u_a_m_s=2.0, y0_m=20.0, u_a_step_m_s=1.0)


CASES = [
    Case("range_compress", lambda: RangeCompress(RADAR)),
    Case("omega_k", lambda: OmegaK(RADAR), _geometry),
    Case("omega_k_flat", lambda: OmegaK(RADAR, "flat"), _geometry),
    Case("omega_k_stolt", lambda: OmegaKStolt(RADAR), _geometry),
    Case("range_doppler", lambda: RangeDoppler(RADAR), _geometry),
    Case("backproject", lambda: Backproject(RADAR), _geometry),
    Case("padded", lambda: PaddedLines(OmegaK(RADAR), 16), _geometry),
    Case("closest_range", lambda: ClosestRange(RADAR), _geometry, image=True),
    Case("focus_strip", lambda: FocusStrip(RADAR), _geometry),
    Case("detect", lambda: Detect(), image=True, keeps_complex=False),
    Case("phase_increment", lambda: PhaseIncrement(RADAR, (2, 2))),
    Case("energy_centre", lambda: EnergyCentre(RADAR, (2, 2))),
    Case("doppler_centroid", lambda: DopplerCentroid(RADAR), differentiable=False, vmap=False),
    Case(
        "effective_velocity",
        lambda: EffectiveVelocity(OmegaK(RADAR), 5.0),
        lambda s: {"doppler_hz": _geometry(s)["doppler_hz"]},
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
    ),
    Case("point_doppler", lambda: PointDoppler(RADAR), differentiable=False, vmap=False, image=True, tolerance=1e-6),
    Case("line_integrity", lambda: LineIntegrity(), _numbers, differentiable=False, vmap=False),
    Case("zero_fill", lambda: ZeroFill(), _missing),
    Case("linear_fill", lambda: LinearFill(RADAR), lambda s: {**_missing(s), "doppler_hz": _geometry(s)["doppler_hz"]}),
    Case("band_limited_fill", lambda: BandLimitedFill(), _missing, differentiable=False),
    Case(
        "sparse_fill",
        lambda: SparseFill(RADAR),
        lambda s: {**_missing(s), **_geometry(s)},
        differentiable=False,
        tolerance=1e-7,
    ),
    Case("subtract_interference", lambda: SubtractInterference(), differentiable=False, vmap=False),
    Case("notch_interference", lambda: NotchInterference(), differentiable=False, vmap=False),
    Case("drop_interference", lambda: DropInterference(), differentiable=False, vmap=False),
    Case("correct_jitter", lambda: CorrectJitter(), _offsets),
    Case("pilot_jitter", lambda: PilotJitter(), _pilot, differentiable=False, vmap=False),
    Case("blind_jitter", lambda: BlindJitter(max_period=4), differentiable=False, vmap=False, n_range=128),
    Case("estimate_imbalance", lambda: EstimateImbalance()),
    Case("correct_imbalance", lambda: CorrectImbalance(), _imbalance),
    Case(
        "estimate_response",
        lambda: EstimateResponse(RADAR, FEW_POINTS),
        differentiable=False,
        vmap=False,
        image=True,
        tolerance=1e-6,
        n_range=300,
    ),
    Case("correct_response", lambda: CorrectResponse(RADAR), _response, image=True),
    Case("sca", lambda: Sca(), vmap=False),
    Case("pga", lambda: Pga(), vmap=False),
    Case("pga_sca", lambda: PgaSca("synchronised", "measured"), vmap=False),
    Case("entropy_fixed_point", lambda: EntropyFixedPoint(), vmap=False),
    Case("link_phases", lambda: LinkPhases(), differentiable=False, vmap=False, tolerance=1e-6),
    Case("autofocus", lambda: Autofocus(), vmap=False),
    Case("correct_pulse_phase", lambda: CorrectPulsePhase(), _phases),
    Case("azimuth_transform", lambda: AzimuthTransform(TURNTABLE, "hann", 2)),
    Case("target_image", lambda: TargetImage(TURNTABLE)),
    Case("range_phase", lambda: RangePhase(TURNTABLE), _turn),
    Case("matched_fourier", lambda: MatchedFourier(TURNTABLE), _warp),
    Case(
        "rotation_search",
        lambda: RotationSearch(TURNTABLE, [0.1, -2.0], [0.5, 2.0], [2, 3], objective=SEARCH),
        differentiable=False,
        vmap=False,
    ),
    Case(
        "rotation_genetic",
        lambda: RotationGenetic(TURNTABLE, [0.1, -2.0], [0.5, 2.0], population=6, generations=2, objective=SEARCH),
        differentiable=False,
        vmap=False,
    ),
    Case(
        "rotation_evolution",
        lambda: RotationEvolution(TURNTABLE, [0.1, -2.0], [0.5, 2.0], population=6, generations=2, objective=SEARCH),
        differentiable=False,
        vmap=False,
    ),
    Case(
        "rotation_newton",
        lambda: RotationNewton(TURNTABLE, [0.3, 0.5], steps=2, objective=replace(SEARCH, taps=6)),
        differentiable=False,
        vmap=False,
        tolerance=1e-3,
    ),
    Case(
        "rotation_descent",
        lambda: RotationDescent(TURNTABLE, [0.3, 0.5], steps=2, objective=replace(SEARCH, variables="shape")),
        differentiable=False,
        vmap=False,
        tolerance=1e-3,
    ),
    Case("rotation_coarse", lambda: CoarseRotation(TURNTABLE), differentiable=False, vmap=False),
    Case("rotation_phase_fit", lambda: PhaseFitRotation(TURNTABLE), differentiable=False, vmap=False, tolerance=1e-6),
    # of a target that turns: what is fitted to an echo that shows no rotation is chance
    # iterations end at 1e-9 of the position, by how the memory of the data is aligned
    Case(
        "rotation",
        lambda: UnevenRotation(turning.RADAR),
        differentiable=False,
        vmap=False,
        turning=True,
        tolerance=1e-8,
    ),
    Case(
        "rotation_autofocus",
        lambda: RotationAutofocus(TURNTABLE, 4, 2),
        _turn,
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
    ),
    Case("chirplet_clean", lambda: ChirpletClean(TURNTABLE, atoms=3), differentiable=False, vmap=False, tolerance=1e-6),
    Case(
        "alternate",
        lambda: Alternate(
            2, phase=Turn(EntropyFixedPoint(), CorrectPulsePhase()), rotation=Turn(CoarseRotation(TURNTABLE))
        ),
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
    ),
    Case("split_sweeps", lambda: SplitSweeps(LADAR, 3.3e-6), ladar="record"),
    Case("circular_shift", lambda: CircularShift(LADAR, 3.3e-6), ladar="record"),
    Case("blank_turning_points", lambda: BlankTurningPoints(LADAR, 100.0), ladar="sweeps"),
    Case(
        "calibrate_sweeps",
        lambda: CalibrateSweeps(LADAR, 1e-9),
        _calibration,
        differentiable=False,
        vmap=False,
        ladar="sweeps",
    ),
    Case("segmented_interference", lambda: SegmentedInterference(LADAR), ladar="sweeps"),
    Case("segmented_sum", lambda: SegmentedInterference(LADAR, "sum", "per_pulse"), ladar="sweeps"),
    Case("mirror_product", lambda: MirrorProduct(LADAR), ladar="sweeps"),
    Case("mirror_product_record", lambda: MirrorProduct(LADAR, (-0.3, 0.3), "record"), ladar="sweeps"),
    Case("ml_peak", lambda: MlPeak(LADAR), ladar="sweeps"),
    Case("spectrum_correlation", lambda: SpectrumCorrelation(LADAR), differentiable=False, ladar="sweeps"),
    Case("radial_motion", lambda: RadialMotion(LADAR), vmap=False, ladar="sweeps"),
    Case("compensate_motion", lambda: CompensateMotion(LADAR), _velocities, ladar="sweeps"),
    Case("compress_sweeps", lambda: CompressSweeps(LADAR), ladar="sweeps"),
    Case("deramp_azimuth", lambda: DerampAzimuth(LADAR), ladar="profiles"),
    Case("azimuth_matched_filter", lambda: AzimuthMatchedFilter(LADAR), ladar="profiles"),
    Case("phase_polish", lambda: PhasePolish(), vmap=False, ladar="profiles"),
    Case("compress_channels", lambda: CompressChannels(BISTATIC), channels="range"),
    Case("remove_transmit_range", lambda: RemoveTransmitRange(BISTATIC), channels="range"),
    Case("azimuth_scaling", lambda: AzimuthScaling(BISTATIC), _some_motion("u_r_m_s", "u_a_m_s"), channels="line"),
    Case(
        "correct_migration",
        lambda: CorrectMigration(BISTATIC, Keystone(whole_swath=False)),
        _motion,
        tolerance=1e-8,
        channels="range",
    ),
    Case(
        "estimate_balance",
        lambda: EstimateBalance(BISTATIC, FlatBand(300.0), 3, blocks=4),
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
        channels="range",
    ),
    Case("correct_balance", lambda: CorrectBalance(BISTATIC), _balance, channels="range"),
    Case(
        "estimate_synchronisation",
        lambda: EstimateSynchronisation(BISTATIC),
        _direct_path,
        differentiable=False,
        vmap=False,
        channels="line",
    ),
    Case("remove_synchronisation", lambda: RemoveSynchronisation(BISTATIC), _errors, channels="range"),
    Case("reconstruct", lambda: Reconstruct(BISTATIC), _motion, vmap=False, channels="line"),
    Case("reconstruct_lines", lambda: Reconstruct(BISTATIC, MinimumMeanSquare(4)), _motion, channels="range"),
    Case("focus_azimuth", lambda: FocusAzimuth(BISTATIC, bandwidth_hz=300.0), _motion, channels="doppler"),
    Case(
        "focus_plan",
        lambda: FocusPlan(BISTATIC, bandwidth_hz=300.0, u_r_m_s=5.0, u_a_m_s=2.0),
        vmap=False,
        channels="line",
    ),
    Case("stationary_image", lambda: StationaryImage(BISTATIC, form="bulk"), vmap=False, channels="range"),
    Case(
        "walk_ambiguity",
        lambda: WalkAmbiguity(BISTATIC),
        _motion,
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
        channels="range",
    ),
    Case(
        "interferometry",
        lambda: Interferometry(BISTATIC, LIT),
        _motion,
        differentiable=False,
        vmap=False,
        tolerance=1e-7,
        channels="line",
    ),
    Case(
        "along_track",
        lambda: AlongTrackAutofocus(BISTATIC, LIT),
        _some_motion("u_r_m_s", "y0_m"),
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
    Case(
        "likelihood_velocity",
        lambda: LikelihoodVelocity(BISTATIC, LIT),
        _motion,
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
    Case(
        "gradient_velocity",
        lambda: GradientVelocity(BISTATIC, LIT),
        _motion,
        differentiable=False,
        vmap=False,
        tolerance=1e-3,
        channels="line",
    ),
    Case(
        "moving_point",
        lambda: MovingPointVelocity(BISTATIC, LIT, search=FEW_VELOCITIES),
        differentiable=False,
        vmap=False,
        tolerance=1e-5,
        channels="line",
    ),
    Case(
        "signal_intensity",
        lambda: SignalIntensityRatio(BISTATIC, 300.0, LeastSquares(2), step_m_s=2.0),
        differentiable=False,
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
]
IDS = [case.name for case in CASES]


def results(out: Signal | Estimate | tuple) -> dict[str, Tensor]:
    """Every tensor of what a stage returns, by name."""
    parts = out if isinstance(out, tuple) else (out,)
    named: dict[str, Tensor] = {}
    for part in parts:
        if isinstance(part, Signal):
            named["data"] = part.data
        else:
            named |= {**part.value, "ok": part.ok, "quality": part.quality}
    return named


@cache
def raw(trials: int | None, dtype: torch.dtype = torch.complex128, n_pulse: int = 48, n_range: int = 64) -> Signal:
    recording, _ = small_recording(n_pulse, n_range, trials=trials, dtype=dtype)
    # levels of 60 dB apart: a loud trial must not change a quiet one
    if trials is not None:
        level = torch.logspace(0, 3, trials).to(dtype)
        return recording.signal.with_data(recording.signal.data * level[:, None, None])
    return recording.signal


@cache
def raw_ladar(kind: str, trials: int | None, dtype: torch.dtype, n_pulse: int) -> Signal:
    """The same of a triangular ladar: "record", "sweeps", or "profiles" of the up sweeps."""
    signal = small_ladar_recording(n_pulse, trials=trials, dtype=dtype, record=kind == "record")[0].signal
    signal = CompressSweeps(LADAR)(signal) if kind == "profiles" else signal
    if trials is None:
        return signal
    level = torch.logspace(0, 3, trials).to(dtype)
    return signal.with_data(signal.data * level[(slice(None),) + (None,) * len(signal.axes)])


_echo = cache(small_bistatic_echo)


@cache
def raw_turning(trials: int | None, dtype: torch.dtype, n_pulse: int) -> Signal:
    """The same of targets that turn, every trial another one."""
    data = turning.targets(trials or 1, n_pulse=n_pulse).to(dtype)
    data = data[0] if trials is None else data * torch.logspace(0, 3, trials).to(dtype)[:, None, None]
    return Signal(data, turning.RADAR.raw_axes(n_pulse, turning.BINS))


def raw_channels(kind: str, like: Signal) -> Signal:
    """Channels of a bistatic receiver, as many trials and pulses: "range", "line" without the range
    axis, or "doppler", rebuilt.
    """
    n_pulse, n_range = (
        (like.axes[0].n, 32 if like.axes[0].n > 8 else 16) if kind == "range" else (6 * like.axes[0].n, 4)
    )
    signal = _echo(n_pulse, n_range, like.trials.numel() if like.trials else None, like.data.dtype)
    if like.trials:
        level = torch.logspace(0, 3, len(signal.data)).to(like.data.dtype)
        signal = signal.with_data(signal.data * level[:, None, None, None])
    if kind == "range":
        return signal
    line = Signal(signal.data[..., signal.axes[2].n // 2], signal.axes[:2])
    return Reconstruct(BISTATIC)(line) if kind == "doppler" else line


def entering(case: Case, signal: Signal) -> Signal:
    """What the stage works on: the raw signal, an image of it, or as many trials and pulses of a
    ladar, of several channels, or (eight times as many pulses) of targets that turn.
    """
    trials, dtype, n_pulse = signal.trials.numel() if signal.trials else None, signal.data.dtype, signal.axes[0].n
    if case.channels:
        return raw_channels(case.channels, signal)
    if case.ladar:
        return raw_ladar(case.ladar, trials, dtype, n_pulse)
    if case.turning:
        return raw_turning(trials, dtype, 8 * n_pulse)
    return Signal(signal.data, RADAR.image_axes(signal.axes)) if case.image else signal


def single(values: dict[str, Tensor], i: int) -> dict[str, Tensor]:
    return {name: value[i] for name, value in values.items()}


@dataclass(frozen=True)
class Called:
    """A stage that was stored, loaded and moved, its input, and what it returned."""

    stage: Stage
    signal: Signal
    values: dict[str, Tensor]
    results: dict[str, Tensor]
    left_alone: bool


@cache
def called(case: Case, dtype: torch.dtype = torch.complex128) -> Called:
    """A call with two trials, 60 dB apart, and a third one of zeros, which several tests share."""
    stage, signal = case.build(), entering(case, raw(2, dtype, n_range=case.n_range))
    signal = signal.with_data(torch.cat([signal.data, torch.zeros_like(signal.data[:1])]))
    values, before = case.values(signal), signal.data.clone()
    stage.load_state_dict(stage.state_dict())
    found = results(stage.to("cpu")(signal, **values))
    return Called(stage, signal, values, found, torch.equal(signal.data, before))


def assert_equal_trials(
    case: Case, found: dict[str, Tensor], wanted: dict[str, Tensor], std: dict[str, Tensor]
) -> None:
    """To the tolerance times the value or, if that is larger, times its predicted deviation.

    A quality lies between 0 and 1: how exact a quality of 1e-13 is says nothing.
    """
    for name, value in wanted.items():
        measured = value.dtype != torch.bool and value.numel() and name != "quality"
        scale = float(value.abs().max()) if measured else 1.0
        deviation = std.get(name, torch.zeros(())).nan_to_num(posinf=0.0)
        torch.testing.assert_close(
            found[name],
            value,
            atol=case.tolerance * max(scale, float(deviation.max()) if deviation.numel() else 0.0, 1e-30),
            rtol=0,
            msg=lambda m, n=name: f"{n}: {m}",
        )


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_batch_equals_singles(case: Case) -> None:
    """Beside a trial of another level and an empty one, as a batch of one trial, and alone."""
    of = called(case)
    for i in range(2):
        out = of.stage(of.signal.with_data(of.signal.data[i]), **single(of.values, i))
        alone, std = results(out), out.std if isinstance(out, Estimate) else {}
        assert_equal_trials(case, single(of.results, i), alone, std)
        if i == 0:
            first = of.signal.with_data(of.signal.data[:1])
            batch = results(of.stage(first, **{name: value[:1] for name, value in of.values.items()}))
            assert_equal_trials(case, single(batch, 0), alone, std)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_dtype_and_device_are_kept(case: Case, dtype: torch.dtype) -> None:
    of = called(case, dtype)
    if "data" in of.results:
        data = of.results["data"]
        assert data.dtype == (dtype if case.keeps_complex else real_dtype(dtype))
        assert data.device == of.signal.data.device


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_results_are_finite_also_of_an_empty_trial(case: Case, dtype: torch.dtype) -> None:
    assert all(torch.isfinite(value).all() for value in called(case, dtype).results.values())


@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_state_moves_and_input_is_left_alone(case: Case) -> None:
    assert called(case).left_alone


@pytest.mark.parametrize(
    "case", [c for c in CASES if c.differentiable], ids=[c.name for c in CASES if c.differentiable]
)
def test_gradients(case: Case) -> None:
    stage, signal = case.build(), entering(case, raw(2, n_pulse=8, n_range=32))
    values = case.values(signal)
    floating = {name: value.requires_grad_() for name, value in values.items() if value.is_floating_point()}

    def outputs(data: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        out = results(stage(signal.with_data(data), **{**values, **dict(zip(floating, tensors, strict=True))}))
        return tuple(value for value in out.values() if value.is_floating_point() or value.is_complex())

    data = signal.data / signal.data.abs().flatten(1).amax(1)[(slice(None),) + (None,) * (signal.data.ndim - 1)]
    inputs = (data.requires_grad_(), *floating.values())
    assert torch.autograd.gradcheck(outputs, inputs, fast_mode=True, atol=1e-4, rtol=1e-3)
    assert_forward_equals_backward(outputs, inputs)


@pytest.mark.parametrize("case", [c for c in CASES if c.vmap], ids=[c.name for c in CASES if c.vmap])
def test_vmap_equals_batch(case: Case) -> None:
    stage, signal = case.build(), entering(case, raw(3, n_range=case.n_range))
    values = case.values(signal)
    mapped = results(torch.vmap(lambda one, given: stage(one, **given))(signal, values))
    for name, value in results(stage(signal, **values)).items():
        scale = float(value.abs().max()) if value.dtype != torch.bool and value.numel() else 1.0
        torch.testing.assert_close(mapped[name], value, atol=case.tolerance * max(scale, 1e-30), rtol=0)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("case", CASES, ids=IDS)
def test_non_finite_input_is_refused(case: Case, bad: float) -> None:
    stage, signal = case.build(), entering(case, raw(2, n_range=case.n_range))
    data = signal.data.clone()
    position = (1, *(0,) * (data.ndim - 3), *(min(i, n - 1) for i, n in zip((3, 5), data.shape[1:][-2:])))
    data[position] = bad
    with pytest.raises(
        ValueError, match=r"1 of \d+ samples are NaN or Inf, the first at index " + re.escape(str(position))
    ):
        stage(signal.with_data(data), **case.values(signal))


def _estimators() -> set[type[Stage]]:
    """Every stage of the library that may return an Estimate."""
    for module in pkgutil.walk_packages(torchsar.__path__, "torchsar."):
        if not module.name.startswith(("torchsar.study", "torchsar.cli", "torchsar.plot")):
            importlib.import_module(module.name)
    waiting, found = [Stage], set()
    while waiting:
        stages = waiting.pop().__subclasses__()
        waiting += stages
        found |= {s for s in stages if "Estimate" in str(inspect.signature(s.forward).return_annotation)}
    return {s for s in found if s.__module__.startswith("torchsar.") and not s.__name__.startswith("_")}


# estimators that are not in the list above, with how they are built
MORE = {
    "AlignEnvelopes": AlignEnvelopes,
    "EstimateFlatResponse": lambda: EstimateFlatResponse(RADAR),
    "MigratingLines": lambda: MigratingLines(BISTATIC, Interferometry(BISTATIC, LIT)),
    "MoversImage": lambda: MoversImage(BISTATIC, LeastSquares(2), "subtract", Extraction(1.4, 4.0), Detector()),
    "CorrectPath": CorrectPath,
    "PathAutofocus": PathAutofocus,
    "PathPhase": PathPhase,
    "StripAutofocus": lambda: StripAutofocus(100.0, 40.0, 6.0),
    "PulseGain": PulseGain,
    "SharpestPhase": SharpestPhase,
    "SplitSweeps": lambda: SplitSweeps(LADAR, "search"),
}


def test_every_estimator_has_neutral_values_or_says_why_not() -> None:
    built = [case.build() for case in CASES] + [build() for build in MORE.values()]
    assert _estimators() - {type(stage) for stage in built} == set(), "add these to CASES or MORE"
    for stage in built:
        assert set(stage.neutral) == set(stage.provides), type(stage).__name__
        reasons = [value for value in stage.neutral.values() if isinstance(value, str)]
        assert all(len(reason.split()) > 3 for reason in reasons), type(stage).__name__


def test_a_neutral_value_has_no_effect_or_is_nominal() -> None:
    """Correctors leave the signal unchanged when they get the neutral values."""
    pairs = [
        (Autofocus(), CorrectPulsePhase(), (48,)),
        (EstimateImbalance(), CorrectImbalance(), (2,)),
        (PilotJitter(), CorrectJitter(), (4,)),
        (AlignEnvelopes(), ShiftRange(), (48,)),
        (PulseGain(), EqualisePulses(), (48,)),
        (LineIntegrity(), LinearFill(RADAR), (48,)),
    ]
    signal = raw(2)
    for estimator, corrector, shape in pairs:
        known = {name for name in inspect.signature(corrector.forward).parameters if name in estimator.neutral}
        given = {
            name: torch.full((2,) if name == "period" else (2, *shape), value)
            for name, value in estimator.neutral.items()
            if name in known and not isinstance(value, str)
        }
        out = corrector(signal, **given)
        torch.testing.assert_close(out.data, signal.data, rtol=0, atol=1e-12 * float(signal.data.abs().max()))
    pointing = replace(RADAR, pointing_doppler_hz=-250.0)
    assert DopplerCentroid(pointing).neutral["doppler_hz"] == -250.0
    assert DopplerCentroid(pointing).neutral["ambiguity"] == -1.0
    assert PhaseIncrement(pointing).neutral["doppler_baseband_hz"] == 150.0
    assert EffectiveVelocity(OmegaK(RADAR)).neutral["velocity_m_s"] == RADAR.velocity_m_s
