"""The table of stages: one row for each, with what is promised of it, for all families of tests.

A new stage joins by one row here, and with it the function, if `Stage.of` made the stage of one.
Another function joins by one row in `functions` or `numbers`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import torch
from torch import Tensor

from tests.compensate import turning
from tests.helpers import (
    small_bistatic,
    small_bistatic_echo,
    small_ladar,
    small_ladar_recording,
    small_radar,
    small_recording,
)
from torchsar import compensate, focus, multichannel, repair
from torchsar.core import Alternate, Estimate, Signal, Stage, Turn, to_frequency
from torchsar.radar import InverseRadar

RADAR = small_radar()
TURNTABLE = InverseRadar(3.2e9, 50e6, 400.0, 0.01)
LADAR = small_ladar()
BISTATIC = small_bistatic()
FEW_POINTS = partial(repair.estimate_response_sharpest, points=40, orders=(4, 8), passes=2)

LINE_NUMBER = "depends on the number of the line"
ON_RANGE = "depends on the range"
ON_DOPPLER = "depends on the Doppler frequency"
NEW_AXIS = "transforms the axis or changes its length"


@dataclass(frozen=True)
class Laws:
    """Which laws hold for a row whose result is samples or an estimate; by default all of them.

    Args:
        linear: Why the result is not linear in the samples.
        phase: Why the results do not follow the phase of the samples.
        pulse: Why a circular shift along the pulses does not shift the result.
        range: The same along the range.
        energy: Factor by which the energy of any samples grows; None if it depends on them.
        range_free: An estimate does not depend on a circular shift in range, which holds for all
            phases, gains, envelopes and clocks.
        steps: Results that follow the level of the samples in steps of a power of two only.
    """

    linear: str = ""
    phase: str = ""
    pulse: str = ""
    range: str = ""
    energy: float | None = None
    range_free: bool = False
    steps: tuple[str, ...] = ()


ALL_LAWS, RANGE_FREE = Laws(), Laws(range_free=True)


@dataclass(frozen=True)
class Case:
    """A stage and what may be asked of it.

    Args:
        name: A name of the row; several rows may stand for settings of one stage.
        build: Makes the stage.
        values: Gives, for a signal, the values per trial that the stage is called with.
        vmap: It works under `torch.vmap`.
        tolerance: Relative difference between a batch and its trials that rounding explains.
        doppler: It works on lines that are transformed along azimuth.
        image: It works on an image of a strip in place of raw lines.
        keeps_complex: Its samples stay complex.
        n_range: Number of range cells that it needs.
        ladar: It works on a "record", "sweeps" or "profiles" of a triangular ladar.
        channels: It works on several channels: "range", one "line", or "doppler" of it rebuilt.
        turning: It works on targets that turn.
        zero_ok: Why a trial of zeros may be ok.
        laws: Which laws hold for it.
        degree: The power of the level of the samples with which its samples grow; None if they do
            not follow a power.
    """

    name: str
    build: Callable[[], Stage]
    values: Callable[[Signal], dict[str, Tensor]] = field(default=lambda signal: {})
    vmap: bool = True
    tolerance: float = 1e-9
    doppler: bool = False
    image: bool = False
    keeps_complex: bool = True
    n_range: int = 64
    ladar: str = ""
    channels: str = ""
    turning: bool = False
    zero_ok: str = ""
    laws: Laws = ALL_LAWS
    degree: int | None = 1


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
    tone = tone + 1e-3 * torch.randn(512, dtype=tone.dtype, generator=torch.Generator().manual_seed(1))
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


SEARCH = compensate.EntropyObjective(oversampling=1.0, order=2)
LIT = multichannel.Dwell(1.4)
FEW_VELOCITIES = multichannel.Search(u_r_m_s=3.0, u_a_m_s=2.0, y0_m=20.0, u_a_step_m_s=1.0)


CASES = [
    Case("range_compress", lambda: focus.RangeCompress(RADAR)),
    Case("omega_k", lambda: focus.OmegaK(RADAR), _geometry, laws=Laws(range=ON_RANGE)),
    Case("omega_k_flat", lambda: focus.OmegaK(RADAR, "flat"), _geometry, laws=Laws(range=ON_RANGE)),
    Case("omega_k_stolt", lambda: focus.OmegaKStolt(RADAR), _geometry, laws=Laws(range=ON_RANGE)),
    Case("doppler_transform", focus.DopplerTransform, laws=Laws(pulse=NEW_AXIS)),
    Case(
        "correct_range_migration",
        lambda: focus.CorrectRangeMigration(RADAR),
        _geometry,
        doppler=True,
        laws=Laws(pulse=ON_DOPPLER, range=ON_RANGE),
    ),
    Case(
        "azimuth_compress",
        lambda: focus.AzimuthCompress(RADAR),
        _geometry,
        doppler=True,
        laws=Laws(pulse=NEW_AXIS, range=ON_RANGE),
    ),
    Case("keystone", lambda: focus.Keystone(RADAR), laws=Laws(pulse="scales slow time about the middle pulse")),
    Case("range_doppler", lambda: focus.RangeDoppler(RADAR), _geometry, laws=Laws(range=ON_RANGE)),
    Case("backproject", lambda: focus.Backproject(RADAR), _geometry, laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE)),
    Case(
        "padded",
        lambda: focus.PaddedLines(focus.OmegaK(RADAR), 16),
        _geometry,
        laws=Laws(pulse="appends zeros", range=ON_RANGE),
    ),
    Case("closest_range", lambda: focus.ClosestRange(RADAR), _geometry, image=True),
    Case("focus_strip", lambda: focus.FocusStrip(RADAR), _geometry, laws=Laws(range=ON_RANGE)),
    Case("detect", lambda: focus.Detect(), image=True, keeps_complex=False, laws=Laws(linear="a modulus")),
    Case("phase_increment", lambda: compensate.PhaseIncrement(RADAR, (2, 2))),
    Case("energy_centre", lambda: compensate.EnergyCentre(RADAR, (2, 2))),
    Case("doppler_centroid", lambda: compensate.DopplerCentroid(RADAR), vmap=False),
    Case(
        "effective_velocity",
        lambda: compensate.EffectiveVelocity(focus.OmegaK(RADAR), 5.0),
        lambda s: {"doppler_hz": _geometry(s)["doppler_hz"]},
        vmap=False,
        tolerance=1e-6,
    ),
    Case(
        "point_doppler",
        lambda: compensate.PointDoppler(RADAR),
        vmap=False,
        image=True,
        tolerance=1e-6,
    ),
    Case(
        "line_integrity",
        lambda: repair.LineIntegrity(),
        _numbers,
        vmap=False,
        zero_ok="it is the numbers of the lines that are right",
    ),
    Case("zero_fill", lambda: repair.ZeroFill(), _missing, laws=Laws(pulse="gaps at fixed lines")),
    Case(
        "linear_fill",
        lambda: repair.LinearFill(RADAR),
        lambda s: {**_missing(s), "doppler_hz": _geometry(s)["doppler_hz"]},
        laws=Laws(pulse="gaps at fixed lines"),
    ),
    Case(
        "band_limited_fill",
        lambda: repair.BandLimitedFill(),
        _missing,
        laws=Laws(linear="the spectrum that fills a gap is estimated from the lines"),
    ),
    Case(
        "sparse_fill",
        lambda: repair.SparseFill(RADAR),
        lambda s: {**_missing(s), **_geometry(s)},
        tolerance=1e-7,
        laws=Laws(linear="the strong scatterers that fill a gap are selected from the lines"),
    ),
    Case(
        "subtract_interference",
        lambda: repair.SubtractInterference(),
        vmap=False,
        zero_ok="lines of zeros hold no interference",
    ),
    Case(
        "notch_interference",
        lambda: repair.NotchInterference(),
        vmap=False,
        zero_ok="lines of zeros hold no interference",
    ),
    Case(
        "drop_interference",
        lambda: repair.DropInterference(),
        vmap=False,
        zero_ok="lines of zeros hold no interference",
    ),
    Case("remove_constant", lambda: repair.RemoveConstant("cell", 2), laws=Laws(pulse="a polynomial of the pulse")),
    Case("remove_constant_of_pulse", lambda: repair.RemoveConstant("pulse")),
    Case(
        "remove_pulses",
        lambda: repair.RemovePulses(),
        vmap=False,
        laws=Laws(linear="finds the parts that are hit"),
    ),
    Case("remove_tones", lambda: repair.RemoveTones(), laws=Laws(linear="finds tones")),
    Case(
        "balance_quadrature",
        lambda: repair.BalanceQuadrature(),
        laws=Laws(phase="I and Q are told apart"),
    ),
    Case(
        "correct_jitter",
        lambda: repair.CorrectJitter(),
        _offsets,
        laws=Laws(range="the jitter has a place on the clock"),
    ),
    Case(
        "pilot_jitter",
        lambda: repair.PilotJitter(),
        _pilot,
        vmap=False,
        laws=RANGE_FREE,
        zero_ok="the jitter comes from the pilot",
    ),
    Case(
        "blind_jitter",
        lambda: repair.BlindJitter(max_period=4),
        vmap=False,
        n_range=128,
        laws=RANGE_FREE,
    ),
    Case("estimate_imbalance", lambda: repair.EstimateImbalance(), laws=RANGE_FREE),
    Case("correct_imbalance", lambda: repair.CorrectImbalance(), _imbalance, laws=Laws(pulse="alternating channels")),
    Case(
        "estimate_response",
        lambda: repair.EstimateResponse(RADAR, FEW_POINTS),
        vmap=False,
        image=True,
        tolerance=1e-6,
        n_range=300,
    ),
    Case("correct_response", lambda: repair.CorrectResponse(RADAR), _response, image=True, laws=Laws(energy=1)),
    Case("sca", lambda: compensate.Sca(), vmap=False, laws=RANGE_FREE),
    Case("pga", lambda: compensate.Pga(), vmap=False, laws=RANGE_FREE),
    Case("pga_sca", lambda: compensate.PgaSca("synchronised", "measured"), vmap=False, laws=RANGE_FREE),
    Case("entropy_fixed_point", lambda: compensate.EntropyFixedPoint(), vmap=False, laws=RANGE_FREE),
    Case(
        "link_phases",
        lambda: compensate.LinkPhases(),
        vmap=False,
        tolerance=1e-6,
        laws=RANGE_FREE,
    ),
    Case("autofocus", lambda: compensate.Autofocus(), vmap=False, laws=RANGE_FREE),
    Case(
        "correct_pulse_phase", lambda: compensate.CorrectPulsePhase(), _phases, laws=Laws(pulse=LINE_NUMBER, energy=1)
    ),
    Case("azimuth_transform", lambda: focus.AzimuthTransform(TURNTABLE, "hann", 2), laws=Laws(pulse=NEW_AXIS)),
    Case("target_image", lambda: focus.TargetImage(TURNTABLE), laws=Laws(pulse=NEW_AXIS, energy=1)),
    Case(
        "range_phase",
        lambda: focus.RangePhase(TURNTABLE),
        _turn,
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE, energy=1),
    ),
    Case("matched_fourier", lambda: focus.MatchedFourier(TURNTABLE), _warp, laws=Laws(pulse=NEW_AXIS)),
    Case(
        "rotation_search",
        lambda: compensate.EntropyRotation(TURNTABLE, "grid", [0.1, -2.0], [0.5, 2.0], [2, 3], objective=SEARCH),
        vmap=False,
    ),
    Case(
        "rotation_genetic",
        lambda: compensate.EntropyRotation(
            TURNTABLE, "genetic", [0.1, -2.0], [0.5, 2.0], population=6, generations=2, objective=SEARCH
        ),
        vmap=False,
    ),
    Case(
        "rotation_evolution",
        lambda: compensate.EntropyRotation(
            TURNTABLE, "evolution", [0.1, -2.0], [0.5, 2.0], population=6, generations=2, objective=SEARCH
        ),
        vmap=False,
    ),
    Case(
        "rotation_newton",
        lambda: compensate.EntropyRotation(
            TURNTABLE, "newton", start=[0.3, 0.5], steps=2, objective=replace(SEARCH, taps=6)
        ),
        vmap=False,
        tolerance=1e-3,
    ),
    Case(
        "rotation_descent",
        lambda: compensate.EntropyRotation(
            TURNTABLE, "descent", start=[0.3, 0.5], steps=2, objective=replace(SEARCH, variables="shape")
        ),
        vmap=False,
        tolerance=1e-3,
    ),
    Case("rotation_coarse", lambda: compensate.CoarseRotation(TURNTABLE), vmap=False),
    Case(
        "rotation_phase_fit",
        lambda: compensate.CoarseRotation(TURNTABLE, fits=4),
        vmap=False,
        tolerance=1e-6,
    ),
    # of a target that turns: what is fitted to an echo that shows no rotation is chance
    # iterations end at 1e-9 of the position, by how the memory of the data is aligned
    Case(
        "rotation",
        lambda: compensate.UnevenRotation(turning.RADAR),
        vmap=False,
        turning=True,
        tolerance=1e-8,
    ),
    Case(
        "rotation_autofocus",
        lambda: compensate.RotationAutofocus(TURNTABLE, 4, 2),
        _turn,
        vmap=False,
        tolerance=1e-6,
    ),
    Case(
        "chirplet_clean",
        lambda: compensate.ChirpletClean(TURNTABLE, atoms=3),
        vmap=False,
        tolerance=1e-6,
        laws=Laws(linear="the strongest chirps are selected one after the other"),
    ),
    Case(
        "alternate",
        lambda: Alternate(
            2,
            phase=Turn(compensate.EntropyFixedPoint(), compensate.CorrectPulsePhase()),
            rotation=Turn(compensate.CoarseRotation(TURNTABLE)),
        ),
        vmap=False,
        tolerance=1e-6,
    ),
    Case("split_sweeps", lambda: repair.SplitSweeps(LADAR, 3.3e-6), ladar="record"),
    Case("circular_shift", lambda: repair.CircularShift(LADAR, 3.3e-6), ladar="record", laws=Laws(energy=1)),
    Case("blank_turning_points", lambda: repair.BlankTurningPoints(LADAR, 100.0), ladar="sweeps"),
    Case(
        "calibrate_sweeps",
        lambda: repair.CalibrateSweeps(LADAR, 1e-9),
        _calibration,
        vmap=False,
        ladar="sweeps",
    ),
    Case("segmented_interference", lambda: compensate.SegmentedInterference(LADAR), ladar="sweeps"),
    Case("segmented_sum", lambda: compensate.SegmentedInterference(LADAR, "sum", "per_pulse"), ladar="sweeps"),
    Case("mirror_product", lambda: compensate.MirrorProduct(LADAR), ladar="sweeps"),
    Case("mirror_product_record", lambda: compensate.MirrorProduct(LADAR, (-0.3, 0.3), "record"), ladar="sweeps"),
    Case("ml_peak", lambda: compensate.MlPeak(LADAR), ladar="sweeps"),
    Case("spectrum_correlation", lambda: compensate.SpectrumCorrelation(LADAR), ladar="sweeps"),
    Case("radial_motion", lambda: compensate.RadialMotion(LADAR), vmap=False, ladar="sweeps"),
    Case(
        "compensate_motion",
        lambda: compensate.CompensateMotion(LADAR),
        _velocities,
        ladar="sweeps",
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    Case("compress_sweeps", lambda: focus.CompressSweeps(LADAR), ladar="sweeps"),
    Case(
        "deramp_azimuth",
        lambda: focus.DerampAzimuth(LADAR),
        ladar="profiles",
        laws=Laws(pulse=LINE_NUMBER, range=ON_RANGE, energy=1),
    ),
    Case(
        "azimuth_matched_filter",
        lambda: focus.AzimuthMatchedFilter(LADAR),
        ladar="profiles",
        laws=Laws(pulse=NEW_AXIS, range=ON_RANGE),
    ),
    Case("phase_polish", lambda: compensate.PhasePolish(), vmap=False, ladar="profiles", laws=RANGE_FREE),
    Case("compress_channels", lambda: multichannel.CompressChannels(BISTATIC), channels="range"),
    Case(
        "remove_transmit_range",
        lambda: multichannel.RemoveTransmitRange(BISTATIC),
        channels="range",
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    Case(
        "azimuth_scaling",
        lambda: multichannel.AzimuthScaling(BISTATIC),
        _some_motion("u_r_m_s", "u_a_m_s"),
        channels="line",
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    Case(
        "correct_migration",
        lambda: multichannel.CorrectMigration(BISTATIC, multichannel.Keystone(whole_swath=False)),
        _motion,
        tolerance=1e-8,
        channels="range",
        laws=Laws(pulse=LINE_NUMBER),
    ),
    Case(
        "estimate_balance",
        lambda: multichannel.EstimateBalance(BISTATIC, multichannel.FlatBand(300.0), 3, blocks=4),
        vmap=False,
        tolerance=1e-6,
        channels="range",
        laws=RANGE_FREE,
    ),
    Case("correct_balance", lambda: multichannel.CorrectBalance(BISTATIC), _balance, channels="range"),
    Case(
        "clutter_synchronisation",
        lambda: multichannel.ClutterSynchronisation(BISTATIC, 300.0),
        vmap=False,
        tolerance=1e-6,
        channels="range",
        laws=RANGE_FREE,
    ),
    Case(
        "estimate_synchronisation",
        lambda: multichannel.EstimateSynchronisation(BISTATIC),
        _direct_path,
        vmap=False,
        channels="line",
        zero_ok="the phase comes from the direct path",
    ),
    Case(
        "remove_synchronisation",
        lambda: multichannel.RemoveSynchronisation(BISTATIC),
        _errors,
        channels="range",
        laws=Laws(pulse=LINE_NUMBER, energy=1),
    ),
    Case(
        "reconstruct",
        lambda: multichannel.Reconstruct(BISTATIC),
        _motion,
        vmap=False,
        channels="line",
        laws=Laws(pulse=NEW_AXIS),
    ),
    Case(
        "reconstruct_lines",
        lambda: multichannel.Reconstruct(BISTATIC, multichannel.MinimumMeanSquare(4)),
        _motion,
        channels="range",
        laws=Laws(pulse=NEW_AXIS),
    ),
    Case(
        "focus_azimuth",
        lambda: multichannel.FocusAzimuth(BISTATIC, bandwidth_hz=300.0),
        _motion,
        channels="doppler",
        laws=Laws(pulse=ON_DOPPLER),
    ),
    Case(
        "focus_plan",
        lambda: multichannel.FocusPlan(BISTATIC, bandwidth_hz=300.0, u_r_m_s=5.0, u_a_m_s=2.0),
        vmap=False,
        channels="line",
        laws=Laws(pulse=NEW_AXIS),
    ),
    Case(
        "stationary_image",
        lambda: multichannel.StationaryImage(BISTATIC, form="bulk"),
        vmap=False,
        channels="range",
        laws=Laws(pulse=NEW_AXIS, range=ON_RANGE),
    ),
    Case(
        "walk_ambiguity",
        lambda: multichannel.WalkAmbiguity(BISTATIC),
        _motion,
        vmap=False,
        tolerance=1e-6,
        channels="range",
        laws=RANGE_FREE,
    ),
    Case(
        "interferometry",
        lambda: multichannel.Interferometry(BISTATIC, LIT),
        _motion,
        vmap=False,
        tolerance=1e-7,
        channels="line",
    ),
    Case(
        "along_track",
        lambda: multichannel.AlongTrackAutofocus(BISTATIC, LIT),
        _some_motion("u_r_m_s", "y0_m"),
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
    Case(
        "likelihood_velocity",
        lambda: multichannel.LikelihoodVelocity(BISTATIC, LIT),
        _motion,
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
    Case(
        "gradient_velocity",
        lambda: multichannel.GradientVelocity(BISTATIC, LIT),
        _motion,
        vmap=False,
        tolerance=1e-3,
        channels="line",
    ),
    Case(
        "moving_point",
        lambda: multichannel.MovingPointVelocity(BISTATIC, LIT, search=FEW_VELOCITIES),
        vmap=False,
        tolerance=1e-5,
        channels="line",
    ),
    Case(
        "signal_intensity",
        lambda: multichannel.SignalIntensityRatio(BISTATIC, 300.0, multichannel.LeastSquares(2), step_m_s=2.0),
        vmap=False,
        tolerance=1e-6,
        channels="line",
    ),
]


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
    signal = focus.CompressSweeps(LADAR)(signal) if kind == "profiles" else signal
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
    return multichannel.Reconstruct(BISTATIC)(line) if kind == "doppler" else line


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
    if case.doppler:
        return to_frequency(signal, "pulse")
    return Signal(signal.data, RADAR.image_axes(signal.axes)) if case.image else signal
