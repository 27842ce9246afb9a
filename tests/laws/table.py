"""Which laws hold for which entry of the table of extremes, and why not where they do not."""

from __future__ import annotations

import importlib
import math
import typing
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tests.extremes.judge import Results, outcome
from tests.extremes.table import ENTRIES, RADAR, Entry, _signal, ramp, samples
from torchsar import compensate, core, echo, focus, multichannel, radar, repair, scene
from torchsar.core import Signal
from torchsar.echo.stripmap import Placed

DOUBLE, F64 = torch.complex128, torch.float64
ALL = [entry for entry in ENTRIES if not entry.kind.startswith("one ") and not entry.joint]
STAGES_IN = (compensate, focus, multichannel, repair, core)


def axes(entry: Entry) -> tuple[str, ...]:
    """Names of the axes of the samples of an entry."""
    return _signal(entry.kind).names


def draw(entry: Entry, seed: int, trials: int = 1) -> Tensor:
    """Samples of the kind of an entry with noise, (trial, ...)."""
    x = samples(entry.kind, trials, DOUBLE)
    return x + 0.3 * torch.randn(x.shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def called(entry: Entry, x: Tensor) -> Results:
    """Results of an entry that accepts the samples."""
    found = outcome(lambda: entry.call(x))
    assert not isinstance(found, str), found
    return found


def _returns(entry: Entry) -> object:
    """Return type of the function, or of the `forward` of the stage."""
    name = entry.name.split(":")[0]
    if "." in name:
        package, name = name.split(".")
        function = getattr(importlib.import_module(f"torchsar.{package}"), name)
    else:
        function = next(getattr(module, name) for module in STAGES_IN if hasattr(module, name)).forward
    return typing.get_type_hints(function)["return"]


def gives_samples(entry: Entry) -> bool:
    """Whether the result is samples that grow with the samples given."""
    return _returns(entry) in (Tensor, Signal) and entry.degree.get("data", 1) == 1


TO_SAMPLES = [entry for entry in ALL if gives_samples(entry)]
ESTIMATORS = [entry for entry in ALL if not gives_samples(entry)]

# entries whose samples are no linear function of the samples given
NOT_LINEAR = {
    "Detect:detect": "a modulus",
    "QuickLook": "a modulus",
    "focus.amplitude": "a modulus",
    "BandLimitedFill:band_limited_fill": "the spectrum that fills a gap is estimated from the lines",
    "repair.band_limited_fill": "the spectrum that fills a gap is estimated from the lines",
    "SparseFill:sparse_fill": "the strong scatterers that fill a gap are selected from the lines",
    "repair.sparse_fill": "the strong scatterers that fill a gap are selected from the lines",
    "ChirpletClean:chirplet_clean": "the strongest chirps are selected one after the other",
    "StoredOmegaK": "works on complex64 with its own axes only; OmegaK, which it stores, is in the table",
}
LINEAR = [entry for entry in TO_SAMPLES if entry.name not in NOT_LINEAR]

# entries whose results do not follow the phase of the samples; why
NO_PHASE = {
    "metrics.phase_rmse": "works on real phases",
    "metrics.residual_phase": "works on real phases",
    "metrics.strehl": "works on real phases",
    "StoredOmegaK": NOT_LINEAR["StoredOmegaK"],
}

# results that follow the scale of the samples in steps only; why
STEPS = {("repair.find_contamination", "density"): "counts in `level_of` of a trial, a power of two"}

_LINES = "depends on the number of the line"
_RANGE = "depends on the range"
# linear entries that do not commute with circular shifts along an axis; why
NOT_SHIFTED = {
    "pulse": {
        "Backproject:backproject": _LINES,
        "focus.backproject_strip": _LINES,
        "focus.backproject_spotlight": _LINES,
        **dict.fromkeys(
            ("focus.image_tiles", "focus.compensated_omega_k"), "the path of a pulse depends on its number"
        ),
        "PaddedLines:padded": "appends zeros",
        "repair.split_record": "a sweep may begin in one block and end in the next",
        "focus.backproject": "the path of a pulse depends on its number",
        **dict.fromkeys(("ZeroFill:zero_fill", "LinearFill:linear_fill"), "gaps at fixed lines"),
        **dict.fromkeys(("repair.zero_fill", "repair.linear_fill"), "gaps at fixed lines"),
        "repair.place_lines": "moves lines to fixed places",
        **dict.fromkeys(("CorrectImbalance:correct_imbalance", "repair.correct_imbalance"), "alternating channels"),
        **dict.fromkeys(("CorrectPulsePhase:correct_pulse_phase", "compensate.correct_pulse_phase"), _LINES),
        **dict.fromkeys(("EqualisePulses", "compensate.equalise_pulses"), _LINES),
        **dict.fromkeys(("ShiftRange", "compensate.shift_range"), _LINES),
        **dict.fromkeys(("CompensateMotion:compensate_motion", "compensate.compensate_motion"), _LINES),
        **dict.fromkeys(("RangePhase:range_phase", "focus.range_phase"), _LINES),
        **dict.fromkeys(("DerampAzimuth:deramp_azimuth", "focus.deramp_azimuth"), _LINES),
        **dict.fromkeys(("RemoveTransmitRange:remove_transmit_range", "multichannel.remove_transmit_range"), _LINES),
        **dict.fromkeys(("AzimuthScaling:azimuth_scaling", "multichannel.scale_azimuth"), _LINES),
        **dict.fromkeys(("CorrectMigration:correct_migration", "multichannel.correct_migration"), _LINES),
        "RemoveSynchronisation:remove_synchronisation": _LINES,
        "focus.keystone": _LINES,
        **dict.fromkeys(
            (
                "AzimuthTransform:azimuth_transform",
                "TargetImage:target_image",
                "MatchedFourier:matched_fourier",
                "AzimuthMatchedFilter:azimuth_matched_filter",
                "StationaryImage:stationary_image",
                "FocusPlan:focus_plan",
                "Reconstruct:reconstruct",
                "Reconstruct:reconstruct_lines",
                "multichannel.stationary_image",
                "multichannel.reconstruct",
                "multichannel.reconstruct_lines",
                "core.fft_lines",
                "core.spectrum_in_blocks",
                "core.transform_in_blocks",
                "focus.azimuth_transform",
                "focus.matched_fourier",
                "focus.azimuth_matched_filter",
            ),
            "transforms the axis or changes its length",
        ),
    },
    "range": {
        **dict.fromkeys(
            (
                "OmegaK:omega_k",
                "FocusStrip:focus_strip",
                "OmegaK:omega_k_flat",
                "OmegaKStolt:omega_k_stolt",
                "RangeDoppler:range_doppler",
                "Backproject:backproject",
                "PaddedLines:padded",
                "focus.backproject",
                "focus.backproject_strip",
                "focus.backproject_spotlight",
                "focus.compensated_omega_k",
                "focus.image_tiles",
                "focus.omega_k",
                "focus.omega_k_stolt",
                "focus.range_doppler",
                "focus.defocus_omega_k",
                "focus.closest_range",
                "RangePhase:range_phase",
                "focus.range_phase",
                "DerampAzimuth:deramp_azimuth",
                "focus.deramp_azimuth",
                "AzimuthMatchedFilter:azimuth_matched_filter",
                "focus.azimuth_matched_filter",
                "StationaryImage:stationary_image",
                "multichannel.stationary_image",
                "multichannel.correct_migration",
                "focus.keystone",
            ),
            _RANGE,
        ),
        **dict.fromkeys(
            (
                "CorrectJitter:correct_jitter",
                "repair.correct_jitter",
                "repair.correct_jitter_exact",
            ),
            "the jitter has a place on the clock",
        ),
        **dict.fromkeys(
            (
                "core.centred_fft",
                "core.centred_ifft",
                "core.spectrum_in_blocks",
                "core.to_frequency",
                "radar.frequency_samples",
                "radar.range_profiles",
                "focus.chirp_z",
                "focus.nufft_type1",
                "focus.nufft_type2",
            ),
            "transforms the axis or changes its length",
        ),
    },
}

# estimators whose values do not depend on a circular shift in range, which is all those of phases,
# gains, envelopes and clocks
RANGE_FREE = (
    *("Sca:sca", "Pga:pga", "PgaSca:pga_sca", "EntropyFixedPoint:entropy_fixed_point", "LinkPhases:link_phases"),
    *("Autofocus:autofocus", "PhasePolish:phase_polish", "SharpestPhase", "AlignEnvelopes"),
    *("PulseGain", "EstimateImbalance:estimate_imbalance", "PilotJitter:pilot_jitter", "BlindJitter:blind_jitter"),
    *("EstimateBalance:estimate_balance", "WalkAmbiguity:walk_ambiguity", "compensate.align_envelopes"),
    "compensate.pulse_gain",
    *("compensate.autofocus", "compensate.sca", "compensate.pga", "compensate.pga_sca", "compensate.link_phases"),
    "compensate.entropy_fixed_point",
    *("compensate.sharpest_phase", "compensate.phase_polish", "metrics.entropy"),
    *("metrics.contrast", "metrics.correlation", "metrics.error_db"),
)

# linear entries that keep the energy of any samples, and the factor by which it grows
ENERGY = {
    "CorrectResponse:correct_response": 1,
    "CorrectPulsePhase:correct_pulse_phase": 1,
    "TargetImage:target_image": 1,
    "RangePhase:range_phase": 1,
    "CircularShift:circular_shift": 1,
    "CompensateMotion:compensate_motion": 1,
    "DerampAzimuth:deramp_azimuth": 1,
    "RemoveTransmitRange:remove_transmit_range": 1,
    "AzimuthScaling:azimuth_scaling": 1,
    "RemoveSynchronisation:remove_synchronisation": 1,
    "ShiftRange": 1,
    "CompressDechirped": 1 / 64,
    "core.centred_fft": 64,
    "core.centred_ifft": 1 / 64,
    "core.fft_lines": 48,
    "core.spectrum_in_blocks": 48 * 64,
    "core.transform_in_blocks": 48,
    "core.to_frequency": 64,
    "core.from_frequency": 1,
    "radar.frequency_samples": 1,
    "radar.range_profiles": 1,
    "repair.circular_shift": 1,
    "repair.correct_response": 1,
    "compensate.shift_range": 1,
    "compensate.correct_pulse_phase": 1,
    "compensate.compensate_motion": 1,
    "multichannel.remove_transmit_range": 1,
    "multichannel.scale_azimuth": 1,
    "focus.range_phase": 1,
    "focus.compress_dechirped": 1 / 64,
    "focus.deramp_azimuth": 1,
    "focus.omega_k": 1,
    "focus.defocus_omega_k": 1,
}


@dataclass(frozen=True)
class Pair:
    """A linear map and its adjoint.

    Args:
        name: What they are.
        forward: The map, of x (trial, *given).
        adjoint: The other, of y (trial, *made).
        given: Shape of x.
        made: Shape of y, or with `in_range` of what it is made of.
        tolerance: Relative difference of <A x, y> and <x, A' y> that the interpolation allows.
        in_range: y is itself a result of the map, since lines are cut where echoes have faded.
    """

    name: str
    forward: Callable[[Tensor], Tensor]
    adjoint: Callable[[Tensor], Tensor]
    given: tuple[int, ...]
    made: tuple[int, ...]
    tolerance: float = 1e-11
    in_range: bool = False


POINTS = torch.tensor([-0.41, -0.2, 0.013, 0.31, 0.47], dtype=F64)
SHIFTS = ramp(16, 0.17)
ALONG, RANGES = torch.tensor([3.0, 4.7, 6.0], dtype=F64), torch.tensor([4031.0, 4040.5, 4052.3], dtype=F64)
FREQUENCIES = 9.3e9 + 8e6 * torch.arange(24, dtype=F64)
ANGLES = torch.linspace(0.2, 0.35, 16, dtype=F64)
WAVES = radar.FarField.turntable(FREQUENCIES, ANGLES)


def _strip(amplitude: Tensor) -> Tensor:
    """Raw echo (trial, pulse, range) of points that are always lit, at zero Doppler."""
    world = scene.StripmapWorld(scene.Points([0.0], [0.0]), scene.AlwaysLit(), doppler_hz=0.0)
    crossing_s = ALONG / RADAR.velocity_m_s
    placed = Placed(crossing_s, crossing_s, RANGES, amplitude)
    return echo.stripmap_echo(placed, world, RADAR, 24, 64, DOUBLE)


def _strip_adjoint(raw: Tensor) -> Tensor:
    """Backprojection of correlations with the pulse; it keeps the phase of the range of a point."""
    pulse = RADAR.pulse.spectrum(64, RADAR.sampling_hz).conj()
    image = focus.backproject_strip(raw, RADAR, ALONG, RANGES, doppler_hz=0.0, reference=pulse)
    return image * torch.exp(4j * math.pi / RADAR.wavelength_m * RANGES)


def _far(amplitude: Tensor) -> Tensor:
    """Range profiles (trial, pulse, range) of points on a turntable, by the direct sum."""
    away = ALONG * torch.cos(ANGLES)[:, None] + 2.0 * torch.sin(ANGLES)[:, None]
    turns = 2 / WAVES.wave_speed_m_s * FREQUENCIES[:, None] * away[:, None]
    return radar.range_profiles((torch.exp(-2j * math.pi * turns) @ amplitude[:, None, :, None])[..., 0])


PAIRS = [
    Pair("FFT", core.centred_fft, lambda y: 16 * core.centred_ifft(y), (3, 16), (3, 16)),
    Pair("frequency samples", radar.frequency_samples, radar.range_profiles, (3, 16), (3, 16)),
    Pair(
        "NUFFT",
        lambda x: focus.nufft_type2(x, POINTS),
        lambda y: focus.nufft_type1(y, POINTS, 16),
        (3, 16),
        (3, 5),
        1e-9,
    ),
    Pair(
        "shift in range",
        lambda x: compensate.shift_range(x, SHIFTS),
        lambda y: compensate.shift_range(y, -SHIFTS),
        (16, 9),
        (16, 9),
    ),
    Pair(
        "phase of pulses",
        lambda x: compensate.correct_pulse_phase(x, SHIFTS),
        lambda y: compensate.correct_pulse_phase(y, -SHIFTS),
        (16, 9),
        (16, 9),
    ),
    Pair(
        "omega-K and its inverse",
        lambda x: focus.omega_k(x, RADAR, doppler_hz=5.0),
        lambda y: focus.defocus_omega_k(y, RADAR, doppler_hz=5.0),
        (24, 64),
        (24, 64),
    ),
    Pair("echo of a strip and backprojection", _strip, _strip_adjoint, (3,), (3,), 2e-3, in_range=True),
    Pair(
        "echo of a turntable and backprojection",
        _far,
        lambda y: focus.backproject_spotlight(y, WAVES, ALONG, 2.0 + 0 * ALONG),
        (3,),
        (16, 24),
        1e-8,
    ),
]
