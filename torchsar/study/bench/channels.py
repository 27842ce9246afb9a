"""Estimators of several azimuth channels: velocities of moving points, and errors of channels."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Draws, Estimate, Signal
from torchsar.echo import simulate_bistatic
from torchsar.multichannel import (
    AlongTrackAutofocus,
    ClutterSynchronisation,
    CompressChannels,
    Detector,
    Dwell,
    ElementBeam,
    EstimateBalance,
    EstimateSynchronisation,
    Extraction,
    FlatBand,
    GradientVelocity,
    Interferometry,
    LeastSquares,
    LikelihoodVelocity,
    MigratingLines,
    MoversImage,
    MovingPointVelocity,
    PointMotion,
    Search,
    SignalIntensityRatio,
    WalkAmbiguity,
    correct_balance,
    interferometry,
)
from torchsar.radar import BistaticRadar, LinearFM
from torchsar.scene import BandLimited, BistaticWorld, KSea, MovingPoints, Pattern
from torchsar.study.bench import ocean
from torchsar.study.bench.direct.bistatic import Survey
from torchsar.study.bench.direct.moving import azimuth_echo, compressed_echo, published_radar
from torchsar.study.bench.frame import SNR_DB, Batch, Bench, Entry, Quantity, World, rms
from torchsar.study.bench.nothing import nothing, unlit
from torchsar.study.bench.strips import velocity

F64, C128 = torch.float64, torch.complex128
# settings of the scenes and methods, by choice
RADAR, PULSES, GATE_S = published_radar(), 900, 4.5
GATE, SEARCH = Dwell(GATE_S), Search(u_r_m_s=15.0, u_a_m_s=6.0, y0_m=100.0, u_a_step_m_s=1.0)
FIVE = published_radar(channel_m=(-1.0, -0.5, 0.0, 0.5, 1.0))
LONE = published_radar(channel_m=(0.0,))
SMALL = (360, 64)  # pulses and cells of data with a range axis
SPAN = RADAR.ambiguous_velocity_m_s
LEVELS_DB = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 40.0, 60.0)

Move = tuple[Tensor, Tensor, Tensor]


def moves(trials: int, seed: int, u_r: tuple[float, float] = (-12, 12), u_a: float = 4.0, y0: float = 60.0) -> Move:
    """Draw slant-range speeds, along-track speeds and positions, one per trial."""
    draws = Draws(seed + 5, trials=range(trials))
    return (
        draws.uniform("u_r", (), *u_r),
        draws.uniform("u_a", (), -u_a, u_a),
        draws.uniform("y0", (), -y0, y0),
    )


def named(move: Move) -> dict[str, Tensor]:
    """Values by their names."""
    return dict(zip(("u_r_m_s", "u_a_m_s", "y0_m"), move, strict=True))


def points_of(move: Move) -> MovingPoints:
    """One point per trial, of unit amplitude and random phase."""
    u_r, u_a, y0 = (x[:, None] for x in move)
    return MovingPoints(u_r, u_a, y0, torch.zeros_like(u_r), random_phase=True)


def noise(trials: int, seed: int, *shape: int) -> Tensor:
    """Circular noise of unit power."""
    return Draws(seed, trials=range(trials)).normal("channels", shape, C128)


def line(
    snr_db: float,
    radar: BistaticRadar = RADAR,
    given: tuple[str, ...] = (),
    gate_s: float = GATE_S,
    points: int = 1,
    known_u_a: bool = False,
    u_r: tuple[float, float] = (-12.0, 12.0),
) -> Callable[[int, int], Batch]:
    """Draw azimuth lines of one or more moving points by direct sums."""

    def draw(trials: int, seed: int) -> Batch:
        move = moves(trials, seed, u_r)
        if known_u_a:
            move = (move[0], torch.zeros(trials, dtype=F64), move[2])
        clean = torch.zeros(trials, radar.channels, PULSES, dtype=C128)
        for k in range(points):
            here = move if k == 0 else moves(trials, seed + 31 * k)
            for i in range(trials):
                level = 1.0 if k == 0 else 0.3
                clean[i] += level * azimuth_echo(radar, PULSES, *(float(x[i]) for x in here), gate_s=gate_s)
        data = 10 ** (snr_db / 20) * clean + noise(trials, seed, radar.channels, PULSES)
        truth = named(move)
        return Batch(Signal(data, radar.axes(PULSES)), truth, {name: truth[name] for name in given})

    return draw


def own(snr_db: float, given: tuple[str, ...] = (), known_u_a: bool = False) -> Callable[[int, int], Batch]:
    """Draw azimuth lines of one moving point with our own simulator."""

    def draw(trials: int, seed: int) -> Batch:
        move = moves(trials, seed)
        if known_u_a:
            move = (move[0], torch.zeros(trials, dtype=F64), move[2])
        scene = points_of(move)
        world = BistaticWorld(scene, BandLimited(GATE_S), snr_db=snr_db)
        signal = simulate_bistatic(RADAR, world, PULSES, None, Draws(seed, trials=range(trials)), dtype=C128)[0].signal
        truth = named(move)
        return Batch(signal, truth, {name: truth[name] for name in given})

    return draw


def sea(given: tuple[str, ...] = ()) -> Callable[[int, int], Batch]:
    """Draw azimuth lines of homogeneous stationary clutter, without a moving point."""

    def draw(trials: int, seed: int) -> Batch:
        generator = torch.Generator().manual_seed(seed)
        long, factor = 4 * 8 * 1024, 8
        f = torch.fft.fftfreq(long, 1 / (factor * RADAR.prf_hz), dtype=F64)
        white = torch.view_as_complex(torch.randn(trials, long, 2, generator=generator, dtype=F64))
        spectrum = white * torch.sinc(0.8 * f / 300).abs()
        dx = torch.tensor(RADAR.channel_m, dtype=F64)[:, None]
        delayed = spectrum[:, None] * torch.exp(-2j * math.pi * f * dx / RADAR.speed_m_s)
        data = torch.fft.ifft(delayed, norm="ortho")[..., : factor * PULSES : factor]
        data = data / data.abs().square().mean().sqrt() + 0.1 * noise(trials, seed, 3, PULSES)
        zero = torch.zeros(trials, dtype=F64)
        return Batch(Signal(data, RADAR.axes(PULSES)), None, dict.fromkeys(given, zero))

    return draw


def lines(
    snr_db: float, given: tuple[str, ...] = (), u_r: tuple[float, float] = (-12.0, 12.0), number: int = 0
) -> Callable[[int, int], Batch]:
    """Draw range-compressed channels of one moving point by direct sums over frequency."""

    def draw(trials: int, seed: int) -> Batch:
        move = moves(trials, seed, u_r, 2.0, 20.0)
        data = torch.stack(
            [
                compressed_echo(
                    RADAR,
                    *SMALL,
                    [{"u_r": float(move[0][i]) + number * SPAN, "u_a": float(move[1][i]), "y0": float(move[2][i])}],
                    1.8,
                ).data
                for i in range(trials)
            ]
        )
        noisy = 10 ** (snr_db / 20) * data + noise(trials, seed, 3, *SMALL)
        truth = {**named(move), "ambiguity": torch.full((trials,), float(number), dtype=F64)}
        truth["u_r_m_s"] = truth["u_r_m_s"] + number * SPAN
        values = {name: truth[name] - (number * SPAN if name == "u_r_m_s" else 0) for name in given}
        return Batch(Signal(noisy.to(torch.complex64), RADAR.axes(*SMALL)), truth, values)

    return draw


def raw(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw uncompressed channels of one moving point by an independent generator, and compress."""
    survey, (pulses, cells) = Survey(pulse_s=2e-6, transmit=(0.0, 0.0), wave_m_s=RADAR.wave_speed_m_s), SMALL
    radar = published_radar(pulse=LinearFM(50e6, survey.pulse_s))
    axes = radar.axes(pulses, cells + 256)

    def draw(trials: int, seed: int) -> Batch:
        move = moves(trials, seed, (-12.0, 12.0), 2.0, 20.0)
        line_m = axes[2].values().numpy()
        each = [survey.raw(pulses, line_m, *(float(x[i]) for x in move), lit_s=1.8) for i in range(trials)]
        lines = CompressChannels(radar, "flat")(Signal(torch.from_numpy(np.stack(each)), axes)).data
        noisy = 10 ** (snr_db / 20) * lines[..., 128 : 128 + cells] + noise(trials, seed, 3, *SMALL)
        truth = {**named(move), "ambiguity": torch.zeros(trials, dtype=F64)}
        return Batch(Signal(noisy.to(torch.complex64), RADAR.axes(*SMALL)), truth)

    return draw


def ship(snr_db: float, points: int = 1) -> Callable[[int, int], Batch]:
    """Draw a sea with moving points, as the first of eight targets of an image."""

    def draw(trials: int, seed: int) -> Batch:
        data, speed = [], 6.0 + 3 * Draws(seed, trials=range(trials)).uniform("speed", ())
        for i in range(trials):
            point = {"u_r": float(speed[i]), "r0": 5000.0, "amplitude": 10 ** (snr_db / 20)}
            data.append(compressed_echo(RADAR, 540, 120, [point] * points, 2.0).data)
        noisy = torch.stack(data) + noise(trials, seed, 3, 540, 120)
        return Batch(Signal(noisy.to(torch.complex64), RADAR.axes(540, 120)), {"u_r_m_s": speed})

    return draw


def ships(number: int) -> Callable[[int, int], Batch]:
    """Draw ships of random speeds on a sea, all shown at nearly the same place by an image."""

    def draw(trials: int, seed: int) -> Batch:
        draws = Draws(seed, trials=range(trials))

        def uniform(name: str, low: float, high: float) -> Tensor:
            return draws.uniform(name, (number,), low, high)

        closing, along, level_db = uniform("closing", -10, 10), uniform("along", -6, 6), uniform("level", 15, 25)
        shown, off_m = uniform("shown", -60, 60), uniform("off", -20, 20)
        data = []
        for i in range(trials):
            fleet = {
                str(k): ocean.ship(
                    float(closing[i, k]),
                    float(along[i, k]),
                    azimuth_m=float(shown[i, 0] + off_m[i, k] - 5000 / 300 * closing[i, k]),
                    range_m=float(off_m[i, k]) / 2,
                    level_db=float(level_db[i, k]),
                )
                for k in range(number)
            }
            data.append(ocean.frame_of(fleet, 1000 * seed + i).data)
        return Batch(Signal(torch.stack(data), ocean.RADAR.axes(540, 120)), {"u_r_m_s": closing})

    return draw


def nearest(found: Tensor, truth: Tensor) -> Tensor:
    """Error from the nearest of several true values, (trial, target) or (trial,)."""
    return (found[:, None] - truth.reshape(len(found), -1)).abs().min(-1).values


def strongest(found: Estimate) -> Estimate:
    """The estimate of the strongest target alone."""
    value, std = ({name: x[:, 0] for name, x in table.items()} for table in (found.value, found.std))
    return Estimate(value, std, found.quality[:, 0], found.outcome[:, 0])


def worlds(given: tuple[str, ...] = (), known_u_a: bool = False) -> list[World]:
    """Worlds of a velocity estimator on azimuth lines, with these true values given."""
    at_zero = {name: lambda x: torch.zeros(len(x), dtype=F64) for name in given}
    line_of, own_of = (partial(f, given=given, known_u_a=known_u_a) for f in (line, own))
    return [
        *nothing((3, PULSES), lambda x: Signal(x, RADAR.axes(PULSES)), **at_zero),
        *(World("own", own_of(snr), snr) for snr in LEVELS_DB),
        *(World("direct", line_of(snr), snr) for snr in (-20.0, -10.0, 0.0, 17.0)),
        World("clutter", sea(given)),
        World("two points", line_of(10.0, points=2), 10.0),
        World("partly lit", line_of(10.0, gate_s=1.0), 10.0),
        World("aliased", line_of(10.0, u_r=(SPAN - 4, SPAN + 4)), 10.0),
    ]


def seen_in_sea(snr_db: float) -> Callable[[int, int], Batch]:
    """Draw a moving point in the echo of a sea through the element's pattern."""

    def draw(trials: int, seed: int) -> Batch:
        move = moves(trials, seed, (3.0, 12.0))
        scene = points_of(move)
        world = BistaticWorld(scene, Pattern(), KSea(shape=1.5), snr_db=snr_db)
        signal = simulate_bistatic(RADAR, world, PULSES, None, Draws(seed, trials=range(trials)), dtype=C128)[0].signal
        return Batch(signal, named(move))

    return draw


def clutter(
    power: Callable[[Tensor], Tensor],
    snr_db: float,
    cells: int = 96,
    pulses: int = 256,
    radar: BistaticRadar = RADAR,
) -> Callable[[int, int], Batch]:
    """Draw Gaussian clutter of a Doppler spectrum, with errors of the channels."""

    def draw(trials: int, seed: int) -> Batch:
        long, factor = 4096, 14
        draws = Draws(seed, trials=range(trials))
        f = torch.fft.fftfreq(long, 1 / (factor * radar.prf_hz), dtype=F64)
        level = power(f) * (f.abs() < radar.speed_m_s / radar.wavelength_m)
        spectrum = draws.normal("white", (long, cells), C128) * (level / level.mean()).sqrt()[:, None]
        dx = torch.tensor(radar.channel_m, dtype=F64)[:, None]
        delayed = spectrum[:, None] * torch.exp(-2j * math.pi * f * dx / radar.speed_m_s)[..., None]
        data = torch.fft.ifft(delayed, dim=-2, norm="ortho")[..., : pulses * factor : factor, :]
        data = data + 10 ** (-snr_db / 20) * draws.normal("noise", tuple(data.shape[1:]), C128)
        band = torch.fft.fftfreq(cells, 1 / radar.sampling_hz, dtype=F64).abs() < radar.pulse.bandwidth_hz / 2
        data = torch.fft.ifft(torch.fft.fft(data) * band)
        move = torch.tensor([float(x != 0) for x in radar.channel_m], dtype=F64)
        count = (len(move),)
        truth = {
            "phase_rad": move * draws.uniform("phase", count, -1.0, 1.0),
            "gain_db": move * draws.uniform("gain", count, -1.0, 1.0),
            "delay_s": move * draws.uniform("delay", count, -1e-8, 1e-8),
        }
        data = correct_balance(data, radar, -truth["phase_rad"], -truth["gain_db"], -truth["delay_s"])
        return Batch(Signal(data, radar.axes(pulses, cells)), truth)

    return draw


def flat(f: Tensor) -> Tensor:
    """Clutter over 320 Hz."""
    return (f.abs() < 160).to(F64)


def narrow(f: Tensor) -> Tensor:
    """Clutter over 60 Hz."""
    return (f.abs() < 30).to(F64)


def beam(f: Tensor) -> Tensor:
    """Clutter through the pattern of an element of 0.8 m."""
    return torch.sinc(0.8 * f / 300).square()


def moving_only(trials: int, seed: int) -> Batch:
    """Draw one moving point without clutter, which says nothing about the channels alone."""
    batch = lines(20.0, u_r=(4.0, 12.0))(trials, seed)
    return Batch(batch.data, {"phase_rad": torch.zeros(trials, 3, dtype=F64)})


def drifting_clutter(
    snr_db: float, power: Callable[[Tensor], Tensor], moving: float = 0.0
) -> Callable[[int, int], Batch]:
    """Draw clutter with a clock phase that bends, and a moving point of some amplitude."""

    def draw(trials: int, seed: int) -> Batch:
        still = clutter(power, snr_db)(trials, seed)
        signal, errors = still.data, still.truth or {}
        data = correct_balance(signal.data, RADAR, errors["phase_rad"], errors["gain_db"], errors["delay_s"])
        if moving:
            data = data + moving * compressed_echo(RADAR, 256, 96, [{"u_r": 8.0}]).data
        t = torch.linspace(-1, 1, 256, dtype=F64)
        bend = 10 * Draws(seed + 3, trials=range(trials)).uniform("bend", (), -1, 1)[:, None] * (t.square() - 1 / 3)
        data = data * torch.exp(1j * bend)[:, None, :, None]
        return Batch(signal.with_data(data), {"phase_rad": bend})

    return draw


def direct_path(snr_db: float, drift_s: float = 2e-8) -> Callable[[int, int], Batch]:
    """Draw direct paths of a random phase and a drifting delay, summed over frequency."""

    def draw(trials: int, seed: int) -> Batch:
        draws, n, pulses = Draws(seed, trials=range(trials)), 64, 60
        t = torch.linspace(-1, 1, pulses, dtype=F64)
        phase = math.pi * (2 * draws.uniform("phase", (pulses,)) - 1)
        delay = drift_s * (draws.uniform("drift", (), -1, 1)[:, None] * t + draws.uniform("at", (), -1, 1)[:, None])
        f = torch.fft.fftfreq(n, 1 / RADAR.sampling_hz, dtype=F64)
        f = f[f.abs() < RADAR.pulse.bandwidth_hz / 2]
        at = (torch.arange(n, dtype=F64) - n // 2) / RADAR.sampling_hz
        clean = torch.exp(2j * math.pi * f * (at[:, None] - delay[..., None, None])).mean(-1)
        data = clean * torch.exp(1j * phase)[..., None]
        data = data + 10 ** (-snr_db / 20) * draws.normal("n", (pulses, n), C128)
        return Batch(data, {"phase_rad": phase, "delay_s": delay})

    return draw


def circular(found: Tensor, truth: Tensor) -> Tensor:
    """Rms difference of angles."""
    return rms(torch.remainder(found - truth + math.pi, 2 * math.pi) - math.pi)


DEFOCUS_M_S = 3.0  # u_r displaces by 17 m per m/s, here by the length of a small ship
U_R = Quantity("u_r_m_s", DEFOCUS_M_S, floor=0.002)
U_A = Quantity("u_a_m_s", 3.0, floor=0.01)
Y0 = Quantity("y0_m", 50.0, floor=0.05)


def bare_interferometry(x: Signal) -> Estimate:
    """The function without its stage."""
    return interferometry(x.data, RADAR, PointMotion.of(RADAR, x.data), GATE)


def moving() -> list[Entry]:
    """Estimators of the velocity of moving points."""
    start = ("u_r_m_s", "u_a_m_s", "y0_m")
    near = worlds(start)
    in_range = nothing(
        (3, *SMALL),
        lambda x: Signal(x, RADAR.axes(*SMALL)),
    )
    image = MoversImage(
        RADAR,
        LeastSquares(),
        "subtract",
        Extraction(along_m=60.0, range_m=30.0, integration_s=2.0, segment_s=0.4),
        Detector(suppressed_m_s=()),
        u_a_half_m_s=12.0,
    )
    known = worlds(known_u_a=True)
    moving = MovingPointVelocity(RADAR, GATE, search=SEARCH)
    lone = MovingPointVelocity(LONE, GATE, search=SEARCH)
    ranged = [World("direct", lines(snr), snr) for snr in (-40.0, -30.0, -20.0, -10.0, 10.0)]
    ranged += [World("direct raw", raw(snr), snr) for snr in (-20.0, 10.0)]
    return [
        Entry("MovingPointVelocity", moving, worlds(), [U_R, U_A, Y0]),
        Entry(
            "MovingPointVelocity:one channel",
            lone,
            [World("direct", line(snr, LONE), snr) for snr in (0.0, 20.0)],
            [U_R, U_A, Y0],
        ),
        Entry(
            "MovingPointVelocity:beam",
            MovingPointVelocity(RADAR, ElementBeam(), search=SEARCH),
            [World("sea and point", seen_in_sea(snr), snr) for snr in (10.0, 30.0)],
            [U_R, U_A, Y0],
        ),
        Entry("interferometry", bare_interferometry, known, [U_R, Y0]),
        Entry("Interferometry", Interferometry(RADAR, GATE), known, [U_R, Y0]),
        Entry(
            "AlongTrackAutofocus",
            AlongTrackAutofocus(RADAR, GATE, half_m_s=8.0),
            worlds(("u_r_m_s", "y0_m")),
            [U_A],
        ),
        Entry("LikelihoodVelocity", LikelihoodVelocity(RADAR, GATE), near, [U_R, U_A, Y0]),
        Entry("GradientVelocity", GradientVelocity(RADAR, GATE), near, [U_R, U_A, Y0]),
        Entry("SignalIntensityRatio", SignalIntensityRatio(RADAR, 337.5), known, [U_R]),
        Entry(
            "WalkAmbiguity",
            WalkAmbiguity(RADAR),
            [
                *unlit(in_range),
                *ranged,
                *(World("aliased", lines(snr, number=1), snr) for snr in (-30.0, -20.0, 10.0)),
            ],
            [Quantity("ambiguity", 0.5)],
        ),
        Entry(
            "MigratingLines",
            MigratingLines(RADAR, MovingPointVelocity(RADAR, Dwell(1.8), search=SEARCH), one_line=True),
            [*in_range, *ranged],
            [U_R, U_A, Y0],
        ),
        Entry(
            "MoversImage",
            lambda signal: strongest(image(signal)[1]),
            [
                *nothing((3, 540, 120), lambda x: Signal(x, RADAR.axes(540, 120))),
                *(World("direct", ship(snr), snr) for snr in (-10.0, 0.0, 10.0, 20.0)),
                World("ship on a sea", ships(1), 20.0),
                World("two ships in one place", ships(2), 20.0),
            ],
            [Quantity("u_r_m_s", DEFOCUS_M_S, nearest, 0.01)],
        ),
    ]


def entries() -> list[Entry]:
    """Estimators of the errors of channels and clocks."""
    sync = EstimateSynchronisation(RADAR)
    dummy = Signal(torch.zeros(3, 60, dtype=C128), RADAR.axes(60))
    balance = [
        Quantity("phase_rad", 0.1, circular, 1e-3),
        Quantity("gain_db", 1.0, floor=0.02),
        Quantity("delay_s", 3e-9, floor=2e-11),
    ]
    return [
        Entry(
            "EstimateBalance",
            EstimateBalance(RADAR, FlatBand(360.0), 2),
            [
                *nothing((3, 256, 96), lambda x: Signal(x, RADAR.axes(256, 96))),
                *(World("own", clutter(flat, snr), snr) for snr in SNR_DB),
                World("narrow clutter", clutter(narrow, 20.0), 20.0),
                World("other beam", clutter(beam, 20.0), 20.0),
                World("moving point", moving_only, 20.0),
                World("few cells", clutter(flat, 10.0, 24, 64), 10.0),
            ],
            balance,
        ),
        Entry(
            "EstimateBalance:pattern",
            EstimateBalance(RADAR),
            [
                *nothing((3, 256, 96), lambda x: Signal(x, RADAR.axes(256, 96))),
                *(World("own", clutter(beam, snr), snr) for snr in (-20.0, 0.0, 20.0, 40.0)),
                World("other beam", clutter(flat, 20.0), 20.0),
            ],
            balance,
        ),
        Entry(
            "EstimateBalance:five channels",
            EstimateBalance(FIVE),
            [
                World("own", clutter(beam, 20.0, radar=FIVE), 20.0),
                World("other beam", clutter(flat, 20.0, radar=FIVE), 20.0),
            ],
            balance,
        ),
        Entry(
            "ClutterSynchronisation",
            ClutterSynchronisation(RADAR, 337.5),
            [
                *nothing((3, 256, 96), lambda x: Signal(x, RADAR.axes(256, 96))),
                *(World("own", drifting_clutter(snr, flat), snr) for snr in SNR_DB),
                World("moving point", drifting_clutter(20.0, flat, 20.0), 20.0),
                World("other beam", drifting_clutter(20.0, beam), 20.0),
            ],
            [Quantity("phase_rad", 0.5, circular, 0.05)],
        ),
        Entry(
            "EstimateSynchronisation",
            lambda x: sync(dummy.with_data(x[:, None, :, 0].expand(-1, 3, -1)), direct_path=x),
            [*unlit(nothing((60, 64))), *(World("direct", direct_path(snr), snr) for snr in SNR_DB)],
            [Quantity("phase_rad", 0.5, circular, 1e-4), Quantity("delay_s", 5e-9, floor=1e-13)],
        ),
    ]


BENCH = Bench("channels", "errors of several azimuth channels, and of their clocks", entries)
VELOCITY = Bench("velocity", "the velocity of a strip, or of a moving point", lambda: [velocity(), *moving()])
