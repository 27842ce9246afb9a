"""Estimators of receiver damage: channels, jitter, response, interference, lines and triggers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Estimate, Recording, Signal, Stage
from torchsar.echo import ChannelResponse, QuadratureError, apply_impairments, simulate
from torchsar.echo.jitter import sample_unevenly
from torchsar.focus import OmegaK
from torchsar.radar import LinearFM, StripmapRadar, TriangularLadar
from torchsar.repair import (
    BalanceQuadrature,
    BlindJitter,
    DropInterference,
    EstimateFlatResponse,
    EstimateImbalance,
    EstimateResponse,
    LineIntegrity,
    NotchInterference,
    PilotJitter,
    SplitSweeps,
    SubtractInterference,
    estimate_response_points,
    estimate_response_sharpest,
    find_trigger,
)
from torchsar.repair.response import band_axis, band_grid
from torchsar.scene import Dwell, Points, RandomPoints, Scene, Speckle, StripmapWorld
from torchsar.study.bench.direct.stripmap import Instrument, echo
from torchsar.study.bench.direct.triangles import ground, record, table1
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World, rms
from torchsar.study.bench.nothing import nothing, unlit
from torchsar.study.bench.strips import turntable

F64, C128 = torch.float64, torch.complex128
# settings of the scenes and methods, by choice
RADAR = StripmapRadar(3.2e9, LinearFM(200e6, 1e-6), 250e6, 800.0, 7000.0, 700e3, integration_s=0.2)
LINES, CELLS = 256, 256
IMAGE = (288, 640)  # lines and samples of recordings whose response is sought
TABLE1, GROUND = table1(), ground(keep_every=4)


def signal(x: Tensor) -> Signal:
    """Lines with the axes of a strip."""
    return Signal(x, RADAR.raw_axes(*x.shape[-2:]))


def cast(x: Tensor) -> Tensor:
    """Single precision."""
    return x.to(torch.complex64)


def speckle(draws: Draws, lines: int, cells: int, doppler: float = 0.3, band: float = 0.77) -> Tensor:
    """Clutter of unit power with a raised cosine in Doppler and a flat band in range."""
    white = torch.fft.fft2(draws.normal("speckle", (lines, cells), C128))
    f = torch.fft.fftfreq(lines, dtype=F64)[:, None]
    inside = torch.fft.fftfreq(cells, dtype=F64).abs() < band / 2
    x = torch.fft.ifft2(white * (1 + torch.cos(2 * math.pi * (f - doppler))) * inside)
    return x / x.abs().square().mean((-2, -1), keepdim=True).sqrt()


def imbalance(
    snr_db: float, doppler: float = 0.3, lines: int = LINES, cells: int = CELLS, points: bool = False
) -> Callable[[int, int], Batch]:
    """Draw clutter that two unlike channels record in turn."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        x = speckle(draws, lines, cells, doppler)
        if points:
            k = torch.arange(lines, dtype=F64) - lines / 2
            chirp = torch.exp(1j * math.pi * 0.8 * k.square() / lines)
            x = torch.zeros_like(x)
            x[..., cells // 3] = chirp * math.sqrt(cells)
        gain = torch.stack([torch.ones(trials, dtype=F64), draws.uniform("gain", (), 0.7, 1.4)], -1)
        phase = torch.stack([torch.zeros(trials, dtype=F64), draws.uniform("phase", (), -1.2, 1.2)], -1)
        x = x * torch.polar(gain, phase)[:, torch.arange(lines) % 2, None]
        x = 10 ** (snr_db / 20) * x + draws.normal("noise", (lines, cells), C128)
        return Batch(signal(cast(x)), {"gain": gain, "phase_rad": phase})

    return draw


def unequal(snr_db: float, scene: Scene | None = None) -> Callable[[int, int], Batch]:
    """Draw clutter, or a scene, with unequal I and Q components."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        gain, phase = draws.uniform("gain", (), -2.0, 2.0), draws.uniform("phase", (), -9.0, 9.0)
        if scene is None:
            x = 10 ** (snr_db / 20) * speckle(draws, LINES, CELLS) + draws.normal("noise", (LINES, CELLS), C128)
            recording = Recording(signal(cast(x)), RADAR)
        else:
            recording = simulate(RADAR, StripmapWorld(scene, Dwell(0.05), snr_db=snr_db), LINES, 384, draws)[0]
        impaired = QuadratureError(gain, phase)(recording, draws)[0].signal
        return Batch(impaired, {"gain_db": gain, "phase_deg": phase})

    return draw


def jitter(
    snr_db: float, size: float = 0.1, band: float = 0.77, lines: int = 64, converter: bool = True
) -> Callable[[int, int], Batch]:
    """Draw clutter sampled with a periodic jitter of four samples, and noise of the converter, or
    noise that is sampled with the jitter.
    """

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        offsets = size * draws.normal("offsets", (4,)).clamp(-2, 2)
        offsets = offsets - offsets.mean(-1, keepdim=True)
        x = 10 ** (snr_db / 20) * speckle(draws, lines, 512, band=band)
        noise = draws.normal("noise", (lines, 512), C128)
        x = sample_unevenly(x, offsets) + noise if converter else sample_unevenly(x + noise, offsets)
        return Batch(signal(cast(x)), {"offset_samples": offsets.repeat(1, 2)})

    return draw


def one_tone(trials: int, seed: int) -> Batch:
    """Draw a single line in the spectrum of each range line, without jitter."""
    draws = Draws(seed, trials=range(trials))
    turns = draws.uniform("tone", (64, 1), 0.1, 0.4) * torch.arange(512, dtype=F64)
    x = torch.polar(torch.ones_like(turns), 2 * math.pi * turns) + 0.1 * draws.normal("noise", (64, 512), C128)
    return Batch(signal(cast(x)), {"offset_samples": torch.zeros(trials, 8, dtype=F64)})


def pilot(snr_db: float, size: float = 0.05, drift: float = 0.0) -> Callable[[int, int], Batch]:
    """Draw pilot tones with a periodic jitter of four samples, and a frequency that may drift."""

    def draw(trials: int, seed: int) -> Batch:
        draws, n = Draws(seed, trials=range(trials)), torch.arange(1024, dtype=F64)
        offsets = size * draws.normal("offsets", (4,)).clamp(-2, 2)
        offsets = offsets - offsets.mean(-1, keepdim=True)
        at = n + offsets.repeat(1, 256)
        turns = draws.uniform("f", (), 0.1, 0.4)[:, None] * at + drift * (at / 1024).square()
        x = torch.polar(torch.ones_like(turns), 2 * math.pi * torch.remainder(turns, 1))
        x = x + 10 ** (-snr_db / 20) * draws.normal("noise", (1024,), C128)
        return Batch(x, {"offset_samples": offsets.repeat(1, 2)})

    return draw


def same_offsets(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error of offsets that may have another, whole multiple of the period."""
    n = truth.shape[-1]
    return rms(found.repeat(1, n)[:, :n] if found.shape[-1] < n else found[:, :n] - truth)


def curve(u: Tensor) -> Tensor:
    """Phase response with a cubic part and ripple, without a straight line."""
    slope = 3 * (1.2 / 5 + 0.5 / (3 * math.pi))  # 3 times the mean of u times the curve
    return 1.2 * u**3 + 0.5 * torch.sin(3 * math.pi * u) - slope * u


def response(
    scene: Scene, snr_db: float, phase: Callable[[Tensor], Tensor] = curve, reference: str = "matched"
) -> Callable[[int, int], Batch]:
    """Draw images whose range spectra carry a phase response."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        recording, _ = simulate(RADAR, StripmapWorld(scene, Dwell(0.2), snr_db=snr_db), *IMAGE, draws)
        damaged, _ = apply_impairments(recording, {"r": ChannelResponse(phase)}, draws)
        image = OmegaK(RADAR, reference)(damaged.signal)
        return Batch(image, {"phase_rad": phase(band_grid()).expand(trials, -1)})

    return draw


def timed(trials: int, seed: int) -> Batch:
    """Draw images with the response `curve`, from echoes whose edges lie between samples."""
    lines, samples = IMAGE
    pulse, middle = RADAR.pulse, (samples - RADAR.pulse_samples) / 2
    instrument = Instrument(
        RADAR.carrier_hz,
        pulse.rate_hz_s,
        pulse.duration_s,
        RADAR.sampling_hz,
        RADAR.prf_hz,
        RADAR.velocity_m_s,
        RADAR.near_range_m,
    )
    draws = Draws(seed, trials=range(trials))
    crossing = (lines / 2 + draws.uniform("crossing", (12,), -60.0, 60.0)) / RADAR.prf_hz
    slant = RADAR.near_range_m + (middle + draws.uniform("slant", (12,), -160.0, 160.0)) * RADAR.range_step_m
    gain = draws.normal("gain", (12,), C128)
    rows = zip(crossing.numpy(), slant.numpy(), gain.numpy(), strict=True)
    raw = torch.stack(
        [torch.from_numpy(echo(instrument, t, r, lines, samples, dwell_s=0.2, amplitude=a)) for t, r, a in rows]
    )
    x = raw + 0.3 * draws.normal("noise", (lines, samples), C128)
    psi = curve(band_axis(samples, pulse.bandwidth_hz / RADAR.sampling_hz).clamp(-1, 1))
    x = torch.fft.ifft(torch.fft.fft(x) * torch.polar(torch.ones_like(psi), psi))
    return Batch(OmegaK(RADAR)(signal(cast(x))), {"phase_rad": curve(band_grid()).expand(trials, -1)})


def interference(ratio_db: float, share: float = 0.2) -> Callable[[int, int], Batch]:
    """Draw clutter with tones in a share of the lines; none of them is lost."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))
        x = speckle(draws, LINES, CELLS)
        hit = draws.uniform("hit", (LINES, 1)) < share
        turns = draws.uniform("f", (LINES, 1), -0.3, 0.3) * torch.arange(CELLS, dtype=F64)
        tone = torch.polar(torch.ones_like(turns), 2 * math.pi * turns) * 10 ** (ratio_db / 20)
        return Batch(signal(cast(x + hit * tone)), {"data": cast(x)})

    return draw


def undamaged(trials: int, seed: int) -> Batch:
    """Draw noise, which a correction of interference must leave as it is."""
    x = none_of((LINES, CELLS))[0].draw(trials, seed).data
    return Batch(x, {"data": x.data})


def none_of(shape: tuple[int, int]) -> list[World]:
    """Strips of noise and of zeros."""
    return nothing(shape, signal)


def repaired(stage: Stage) -> Callable[[Signal], Estimate]:
    """Run a correction and add the corrected lines to the values of its estimate."""

    def run(x: Signal) -> Estimate:
        out, found = stage(x)
        return replace(found, value={**found.value, "data": out.data})

    return run


def line_error(found: Tensor, truth: Tensor) -> Tensor:
    """Relative rms error of lines."""
    return rms(torch.view_as_real(found - truth)) / rms(torch.view_as_real(truth))


def numbers(lost: float, wrong: float) -> Callable[[int, int], Batch]:
    """Draw lines of which some are lost, with numbers of which some are wrong."""

    def draw(trials: int, seed: int) -> Batch:
        draws, n = Draws(seed, trials=range(trials)), 200
        kept = draws.uniform("lost", (n + 200,)) >= lost
        kept[:, 0] = True
        number = torch.stack([row.nonzero()[:n, 0] for row in kept])
        x = draws.normal("x", (n, 8), torch.complex64)
        bad = draws.uniform("bad", (n,)) < wrong
        seen = torch.where(bad, (draws.uniform("number", (n,)) * 5000).long(), number)
        return Batch(signal(x), {"number": number.double()}, {"line_number": seen + 100})

    return draw


def placed(x: Signal, line_number: Tensor) -> Estimate:
    """Run `LineIntegrity` and give its verified numbers, relative to the first, as a value."""
    found = LineIntegrity()(x, line_number)[1]
    number = found.info["number"].double()
    return replace(found, value={"number": torch.where(number < 0, torch.nan, number - 100)})


def wrong_numbers(found: Tensor, truth: Tensor) -> Tensor:
    """Share of placed lines at a wrong position."""
    placed = torch.isfinite(found)
    wrong = placed & (found != truth)
    return wrong.sum(-1) / placed.sum(-1).clamp_min(1)


def trigger(
    radar: TriangularLadar, n_period: int, snr_db: float, block: int | None = None, **scene: Any
) -> Callable[[int, int], Batch]:
    """Draw records of a random trigger by direct evaluation."""

    def draw(trials: int, seed: int) -> Batch:
        share = Draws(seed, trials=range(trials)).uniform("trigger", ())
        start = share * radar.period_s * (1 if block is None else 0.8)
        x = torch.stack(
            [
                record(radar, float(t), n_period, block, snr_db=snr_db, seed=seed + i, **scene)
                for i, t in enumerate(start)
            ]
        )
        return Batch(x, {"trigger_s": start})

    return draw


def no_record(radar: TriangularLadar, n_period: int, block: int) -> list[World]:
    """Records of noise and of zeros."""
    real = radar.detection == "real"
    return nothing((n_period, block), lambda x: x.real if real else x)


def timing(radar: TriangularLadar) -> Callable[[Tensor, Tensor], Tensor]:
    """Error of a trigger modulo the period."""

    def error(found: Tensor, truth: Tensor) -> Tensor:
        return (torch.remainder(found - truth + radar.sweep_s, radar.period_s) - radar.sweep_s).abs()

    return error


def split(x: Tensor) -> tuple[Signal, Estimate]:
    """Run `SplitSweeps` with an estimated trigger."""
    return SplitSweeps(TABLE1, "search")(Signal(x, TABLE1.record_axes(*x.shape[-2:])))


# settings of the scenes and methods, by choice
MANY = RandomPoints(40, 1100.0, 200.0, spread_db=6.0)
FIELD = Speckle(3000, 1100.0, 380.0)


def flat_phase(u: Tensor) -> Tensor:
    """No phase response."""
    return torch.zeros_like(u)


def fine_ripple(u: Tensor) -> Tensor:
    """Ripple of more periods than the degrees of the estimators describe."""
    return 0.4 * torch.sin(13 * math.pi * u)


def entries() -> list[Entry]:
    """Entries of the estimators of receiver damage."""
    none = none_of((LINES, CELLS))
    images = [
        *unlit(nothing(IMAGE, lambda x: Signal(x, RADAR.image_axes(RADAR.raw_axes(*IMAGE))))),
        *(World("own", response(MANY, snr), snr) for snr in (-30.0, -20.0, -10.0, 0.0, 20.0, 40.0)),
        World("clutter", response(FIELD, 20.0), 20.0),
        World("one point", response(Points([0.0], [0.0], random_phase=True), 20.0), 20.0),
        World("few points", response(RandomPoints(3, 600.0, 150.0), 20.0), 20.0),
        World("no response", response(MANY, 20.0, flat_phase), 20.0),
        World("fine ripple", response(MANY, 20.0, fine_ripple), 20.0),
        World("direct", timed, 20.0),
    ]
    # twice the standard deviation from which on the phase is not ok; the truth is farther from zero
    phase = [Quantity("phase_rad", 0.25, floor=0.01)]
    waves = [
        none[1],
        World("noise without interference", undamaged, None),
        World("no interference", interference(-300.0), None),
        *(World("own", interference(snr), snr) for snr in (-10.0, 0.0, 10.0, 30.0, 60.0)),
        World("most lines", interference(30.0, 0.9), 30.0),
    ]
    cured = [Quantity("data", 1.0, line_error)]
    few = {"points": 60, "orders": (4, 8, 16), "passes": 2}
    sharp = partial(estimate_response_sharpest, **few)
    return [
        Entry(
            "EstimateImbalance",
            EstimateImbalance(),
            [
                *none,
                *(World("own", imbalance(snr), snr) for snr in SNR_DB),
                World("few lines", imbalance(10.0, lines=10, cells=16), 10.0),
                World("one row", imbalance(10.0, cells=1), 10.0),
                World("one point", imbalance(20.0, points=True), 20.0),
                World("turntable", turntable),
            ],
            [Quantity("gain", 0.2, floor=1e-3), Quantity("phase_rad", 0.3, floor=1e-3)],
        ),
        Entry(
            "BalanceQuadrature",
            BalanceQuadrature(),
            [
                *[world for world in none if world.name == "zeros"],
                *(World("own", unequal(snr), snr) for snr in (-10.0, 10.0, 40.0)),
                World("few points", unequal(40.0, RandomPoints(3, 100.0, 60.0)), 40.0),
            ],
            [Quantity("gain_db", 0.5, floor=0.01), Quantity("phase_deg", 4.0, floor=0.1)],
        ),
        Entry(
            "BlindJitter",
            BlindJitter(max_period=8),
            [
                *none_of((64, 512)),
                *(World("own", jitter(snr), snr) for snr in SNR_DB),
                World("small jitter", jitter(20.0, 0.005), 20.0),
                World("noise with jitter", jitter(10.0, converter=False), 10.0),
                World("narrow band", jitter(20.0, band=0.2), 20.0),
                World("one row", jitter(20.0, lines=1), 20.0),
                World("one tone", one_tone, 20.0),
            ],
            [Quantity("offset_samples", 0.03, same_offsets, 2e-4)],
        ),
        Entry(
            "PilotJitter",
            lambda x: PilotJitter(8)(signal(torch.zeros(len(x), 4, 4, dtype=x.dtype)), pilot=x),
            [
                *nothing((1024,)),
                *(World("own", pilot(snr), snr) for snr in SNR_DB),
                World("no jitter", pilot(20.0, 0.0), 20.0),
                World("drifting", pilot(20.0, drift=3.0), 20.0),
            ],
            [Quantity("offset_samples", 0.03, same_offsets, 1e-6)],
        ),
        Entry("EstimateResponse", EstimateResponse(RADAR, sharp), images, phase),
        Entry(
            "EstimateResponse:default",
            EstimateResponse(RADAR),
            [images[0], *(w for w in images if (w.name, w.snr_db) in (("own", 20.0), ("clutter", 20.0)))],
            phase,
        ),
        Entry(
            "EstimateFlatResponse",
            EstimateFlatResponse(RADAR, sharp),
            [images[0], World("own", response(MANY, 20.0, reference="flat"), 20.0)],
            phase,
        ),
        Entry("estimate_response_points", EstimateResponse(RADAR, estimate_response_points), images, phase),
        Entry("SubtractInterference", repaired(SubtractInterference()), waves, cured),
        Entry("NotchInterference", repaired(NotchInterference()), waves, cured),
        Entry("DropInterference", repaired(DropInterference()), waves, cured),
        Entry(
            "LineIntegrity",
            placed,
            [
                World("own", numbers(0.0, 0.0)),
                World("own", numbers(0.05, 0.05)),
                World("own", numbers(0.1, 0.3)),
                World("random numbers", numbers(0.0, 1.0)),
            ],
            [Quantity("number", 0.02, wrong_numbers)],
        ),
        Entry(
            "find_trigger",
            lambda x: find_trigger(x, TABLE1),
            [
                *no_record(TABLE1, 24, 2 * TABLE1.sweep_samples),
                *(World("direct", trigger(TABLE1, 24, snr), snr) for snr in SNR_DB),
                World("many points", trigger(TABLE1, 24, 10.0, scatterers=SCATTERED), 10.0),
            ],
            [Quantity("trigger_s", 2e-8, timing(TABLE1))],
        ),
        Entry(  # which side of the reference the scene lies on must be given: it shows in no sample
            "find_trigger:nearer",
            lambda x: find_trigger(x, TABLE1, nearer=True),
            [World("direct", trigger(TABLE1, 24, snr, scatterers=((-1.5, 1.0),)), snr) for snr in (-20.0, 10.0)],
            [Quantity("trigger_s", 2e-8, timing(TABLE1))],
        ),
        Entry(
            "find_trigger:real",
            lambda x: find_trigger(x, GROUND),
            [
                *no_record(GROUND, 32, 9000),
                *(
                    World("direct", trigger(GROUND, 32, snr, 9000, scatterers=((10.5, 1.0), (10.8, 0.12))), snr)
                    for snr in (-20.0, 0.0, 20.0)
                ),
            ],
            [Quantity("trigger_s", 1e-8, timing(GROUND))],
        ),
        Entry(
            "SplitSweeps",
            split,
            [
                *no_record(TABLE1, 24, 2 * TABLE1.sweep_samples),
                *(World("direct", trigger(TABLE1, 24, snr), snr) for snr in (-30.0, 0.0, 20.0)),
            ],
            [Quantity("trigger_s", 2e-8, timing(TABLE1))],
        ),
    ]


# settings of the scenes and methods, by choice
SCATTERED = tuple((0.3 + 0.05 * i, 1 + 0.5 * math.sin(7.0 * i * i)) for i in range(40))


BENCH = Bench("repair", "damage by a receiver", entries)
