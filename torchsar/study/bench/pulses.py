"""Benchmark `autofocus`: the phase of every pulse of a target or scene that turns uniformly."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from torchsar.core import Draws, Estimate, Signal, unit_phasor
from torchsar.echo import (
    GainSteps,
    GateJumps,
    GroundAtRest,
    Impairment,
    Leakage,
    QuadratureError,
    Quantiser,
    simulate_turntable,
)
from torchsar.focus import compress_dechirped
from torchsar.metrics import entropy, phase_rmse, residual_phase
from torchsar.radar import InverseRadar
from torchsar.scene import (
    Aircraft,
    Points,
    Satellite,
    Scene,
    TurntableWorld,
    UniformStartPhase,
)
from torchsar.scene.sea import gamma_from_normal
from torchsar.study.bench.direct.inverse import Ladar, echo
from torchsar.study.bench.frame import Batch, Numbers, Quantity, World
from torchsar.study.bench.nothing import Source, nothing

F64, C128, SINGLE = torch.float64, torch.complex128, torch.complex64
# settings of the scenes and methods, by choice
PULSES, CELLS = 128, 48
ROTATION_RAD_S = 0.016
LADAR = InverseRadar(193.4e12, 150e9, 2000.0, ROTATION_RAD_S)
PLANE = Aircraft(4e-3, 0.08, 0.06)
Draw = Callable[[int, int], Batch]


def signal(x: Tensor) -> Signal:
    """Pulses with the axes of the ladar."""
    return Signal(x.to(SINGLE), LADAR.raw_axes(*x.shape[-2:]))


def noisy(x: Tensor, snr_db: float, seed: int = 4) -> Tensor:
    """Add circular noise; the SNR is the mean power of all samples over the noise variance."""
    noise = Draws(seed, trials=range(len(x))).normal("noise", tuple(x.shape[1:]), C128)
    return x + noise * (x.abs().square().mean((-2, -1), keepdim=True) * 10 ** (-snr_db / 10)).sqrt()


def white(trials: int, n_pulse: int = PULSES, seed: int = 5) -> Tensor:
    """Draw a uniform phase for every pulse, (trial, pulse)."""
    return Draws(seed, trials=range(trials)).uniform("white", (n_pulse,), 0.0, 2 * math.pi)


def turned(x: Tensor, phase_rad: Tensor) -> Tensor:
    """Multiply pulses by exp(j phase)."""
    return x * unit_phasor(phase_rad / (2 * math.pi), C128)[..., None].to(x.dtype)


def quadratic(trials: int, n_pulse: int, seed: int) -> Tensor:
    """Draw second and third order phases of some 30 rad."""
    bend = 30 * Draws(seed, trials=range(trials)).uniform("bend", (2, 1), -1.0, 1.0)
    u = torch.linspace(-1, 1, n_pulse, dtype=F64)
    return bend[:, 0] * u.square() + bend[:, 1] * u**3


def vibration(trials: int, n_pulse: int, seed: int) -> Tensor:
    """Draw sinusoids of 1 to 6 rad and 2 to 12 periods."""
    draws = Draws(seed, trials=range(trials))
    size, periods, begin = (draws.uniform(n, (1,), *of) for n, of in (("size", (1, 6)), ("f", (2, 12)), ("0", (0, 7))))
    return size * torch.sin(2 * math.pi * periods * torch.linspace(0, 1, n_pulse, dtype=F64) + begin)


def wandering(trials: int, n_pulse: int, seed: int) -> Tensor:
    """Draw random walks of 0.5 rad per pulse."""
    return 0.5 * Draws(seed, trials=range(trials)).normal("walk", (n_pulse,)).cumsum(-1)


Phases = Callable[[int, int, int], Tensor]


def observed(scene: Source, snr_db: float, phase: Phases = white, defined: bool = True) -> Draw:
    """Draw scenes with phases and noise. Lost pulses, which are zero, have no true phase."""

    def draw(trials: int, seed: int) -> Batch:
        clean, error = scene(trials, seed), phase(trials, PULSES, seed + 1)
        power = clean.abs().square()
        lost = power.sum(-1, keepdim=True).isnan()
        clean = torch.where(lost, 0, clean)
        power = clean.abs().square().mean((-2, -1))
        data = torch.where(lost, 0, turned(noisy(clean, snr_db, seed + 2), error))
        truth = {"phase_rad": torch.where(lost[..., 0], torch.nan, error)}
        truth["noise_std"] = (power * 10 ** (-snr_db / 10)).sqrt()
        return Batch(signal(data), truth if defined else None, clean=clean)

    return draw


def turntable(
    scene: Scene, snr_db: float, cells: int = 96, impairments: Mapping[str, Impairment] | None = None
) -> Draw:
    """Draw targets on a turntable with white phases, and with impairments of the receiver."""

    def draw(trials: int, seed: int) -> Batch:
        world, draws = (
            TurntableWorld(scene, start_phase=[UniformStartPhase()], snr_db=snr_db),
            Draws(seed, trials=range(trials)),
        )
        recording, truth = simulate_turntable(LADAR, world, PULSES, cells, draws, impairments)
        clean = simulate_turntable(LADAR, TurntableWorld(scene), PULSES, cells, draws)[0].signal.data
        known = {"phase_rad": truth.values["phase_rad"], "noise_std": truth.values["noise_std"].expand(trials)}
        return Batch(recording.signal, known, clean=clean.expand(recording.signal.data.shape))

    return draw


def dechirped(trials: int, seed: int) -> Tensor:
    """Draw dechirped pulses of small aircraft by an independent generator."""
    known = Ladar(LADAR.carrier_hz, LADAR.bandwidth_hz, LADAR.prf_hz, ROTATION_RAD_S, pulses=PULSES, cells=96)
    scenes = [PLANE.scatterers(Draws(seed + i)) for i in range(trials)]
    raw = torch.stack([echo(known, s.azimuth_m, s.range_m, s.amplitude) for s in scenes])
    return compress_dechirped(raw, replace(LADAR, pulse_s=known.pulse_s))


def still(
    trials: int, n_pulse: int = PULSES, n_range: int = 64, per_row: int = 3, width: float = 0.5, seed: int = 3
) -> Tensor:
    """Make points at random positions in every range cell, without a phase error.

    Args:
        trials: Number of trials.
        n_pulse: Number of pulses.
        n_range: Number of range cells.
        per_row: Points per range cell.
        width: Share of the Doppler band that the points occupy.
        seed: Seed of the random numbers.

    Returns:
        Pulses, shape (trial, pulse, range), complex128.
    """
    draws, shape = Draws(seed, trials=range(trials)), (n_range, per_row)
    cycles, amplitude = width * draws.uniform("cycles", shape, -0.5, 0.5), draws.normal("amplitude", shape, C128)
    k = torch.arange(n_pulse, dtype=F64)
    return (amplitude[..., None] * unit_phasor(cycles[..., None] * k, C128)).sum(-2).mT.contiguous()


def direct(per_row: int = 3, width: float = 0.5, cells: int = CELLS, lit: float = 1.0) -> Source:
    """Draw sums of points in every cell, by plain formulas, seen in a first part of the pulses."""

    def draw(trials: int, seed: int) -> Tensor:
        clean = still(trials, PULSES, cells, per_row, width, seed)
        return clean * (torch.arange(PULSES, dtype=F64) < lit * PULSES)[:, None]

    return draw


def lossy(scene: Source, share: float, together: bool = False) -> Source:
    """Lose a share of the pulses, which are NaN: single ones, or one gap."""

    def draw(trials: int, seed: int) -> Tensor:
        draws, k = Draws(seed + 7, trials=range(trials)), torch.arange(PULSES, dtype=F64)
        first = (draws.uniform("gap", (1,), 0.2, 0.8 - share) * PULSES).floor()
        gap = (k >= first) & (k < first + share * PULSES)
        lost = gap if together else draws.uniform("lost", (PULSES,)) < share
        return torch.where(lost[..., None], torch.nan, scene(trials, seed))

    return draw


Level = Callable[[Draws, Tensor, Tensor], Tensor]


def clutter(width: float, level: Level | None = None) -> Source:
    """Draw clutter over a share of the Doppler band: homogeneous, or with a level, which is a
    function of draws, of frequencies in cycles, (Doppler, 1), and of range cells.
    """

    def draw(trials: int, seed: int) -> Tensor:
        long, draws = 4 * PULSES, Draws(seed, trials=range(trials))
        frequency = torch.fft.fftfreq(long, dtype=F64)[:, None]
        spectrum = draws.normal("spectrum", (long, CELLS), C128) * (frequency.abs() < width / 2)
        if level is not None:
            spectrum = spectrum * level(draws, frequency, torch.arange(CELLS, dtype=F64))
        return torch.fft.ifft(spectrum, dim=-2)[:, :PULSES]

    return draw


def texture(draws: Draws, frequency: Tensor, cell: Tensor) -> Tensor:
    """K distribution of shape 0.5, whose texture is constant over 16 Doppler and 4 range cells."""
    normal = draws.normal("texture", (len(frequency) // 64, len(cell) // 4))
    gamma = gamma_from_normal(normal, torch.tensor(0.5, dtype=F64))
    return gamma.repeat_interleave(64, -2).repeat_interleave(4, -1).sqrt()


def edge(draws: Draws, frequency: Tensor, cell: Tensor) -> Tensor:
    """A coast: ground on one side of a line, and a lake 26 dB weaker on the other."""
    at, slope = draws.uniform("at", (1, 1), -0.15, 0.15), draws.uniform("slope", (1, 1), -0.3, 0.3)
    return torch.where(frequency < at + slope * (cell / len(cell) - 0.5), 1.0, 0.05)


def streets(draws: Draws, frequency: Tensor, cell: Tensor) -> Tensor:
    """A town: four bright lines along Doppler and four along range, 20 dB above the ground."""
    rows = draws.uniform("rows", (4, 1, 1), 0, len(cell)).floor()
    lines, ends = draws.uniform("lines", (4, 1, 1), -0.3, 0.3), draws.uniform("ends", (4, 1, 1), 0, len(cell))
    along = ((cell == rows) & (frequency.abs() < 0.2)).any(-3)
    across = (((frequency - lines).abs() < 1.0 / PULSES) & ((cell - ends).abs() < 8)).any(-3)
    return 1.0 + 9.0 * (along | across)


def added(first: Source, second: Source, level_db: float) -> Source:
    """Add a scene of a mean power relative to the other one."""

    def draw(trials: int, seed: int) -> Tensor:
        x, y = first(trials, seed), second(trials, seed + 4)
        power, other = (z.abs().square().mean((-2, -1), keepdim=True) for z in (x, y))
        return x + y * (power / other).sqrt() * 10 ** (level_db / 20)

    return draw


def corners(trials: int, seed: int) -> Tensor:
    """Draw five corner reflectors."""
    return points(Draws(seed + 9, trials=range(trials)), 5)


def scattered(count: int) -> Source:
    """Draw points."""
    return lambda trials, seed: points(Draws(seed + 9, trials=range(trials)), count)


def vehicle(trials: int, seed: int) -> Tensor:
    """Draw six points that move on their own, with quadratic phases, within eight range cells."""
    draws = Draws(seed + 9, trials=range(trials))
    where = draws.uniform("vehicle", (1,), 8.0, CELLS - 8.0) + draws.uniform("off", (6,), -4.0, 4.0)
    own = unit_phasor(quadratic(trials, PULSES, seed + 3) / (2 * math.pi), C128)
    return points(draws.part("vehicle"), 6, history=own[:, None], where=where)


def points(
    draws: Draws,
    count: int,
    course: Tensor | float = 0.0,
    history: Tensor | None = None,
    where: Tensor | None = None,
) -> Tensor:
    """Draw points at any range and cross range, (trial, pulse, range).

    course: Displacement of the pulses in range cells, (..., pulse, 1).
    history: Complex factors of the points, (trial, point, pulse).
    where: Range cells of the points, (trial, point).
    """
    where = draws.uniform("range", (count,), 0, CELLS) if where is None else where
    turns = draws.uniform("cross range", (count,), -0.4, 0.4)
    pulses = torch.exp(2j * math.pi * turns[..., None] * torch.arange(PULSES, dtype=F64))
    pulses = pulses * draws.normal("amplitude", (count,), torch.complex128)[..., None]
    frequency = torch.fft.fftfreq(CELLS, dtype=F64)
    at = torch.exp(-2j * math.pi * frequency * where[..., None])
    spectrum = torch.einsum("tkp,tkf->tpf", pulses if history is None else pulses * history, at)
    return CELLS**0.5 * torch.fft.ifft(spectrum * torch.exp(-2j * math.pi * course * frequency))


def another(count: int) -> Source:
    """Draw scenes of points that are others from some pulse on; their phases cannot be compared."""

    def draw(trials: int, seed: int) -> Tensor:
        before, after = (points(Draws(seed + k, trials=range(trials)), count) for k in (9, 509))
        change = Draws(seed, trials=range(trials)).uniform("change", (), PULSES / 4, 3 * PULSES / 4)
        return torch.where((torch.arange(PULSES) < change[:, None])[..., None], before, after)

    return draw


def fluctuating(count: int, pulses: float) -> Source:
    """Draw points whose complex amplitudes change at random within so many pulses."""

    def draw(trials: int, seed: int) -> Tensor:
        draws, keep = Draws(seed + 9, trials=range(trials)), math.exp(-1 / pulses)
        steps = draws.normal("scintillation", (count, PULSES), torch.complex128)
        values = [steps[..., 0]]
        for step in steps[..., 1:].unbind(-1):
            values.append(keep * values[-1] + math.sqrt(1 - keep**2) * step)
        return points(draws, count, history=torch.stack(values, -1))

    return draw


def scintillating(snr_db: float, count: int, pulses: float) -> Draw:
    """Draw noisy scintillating points with white phases."""
    return observed(fluctuating(count, pulses), snr_db)


def walking(count: int, pulses: float) -> Source:
    """Draw points that stay visible while their phases walk at random within so many pulses."""

    def draw(trials: int, seed: int) -> Tensor:
        draws = Draws(seed + 9, trials=range(trials))
        walk = math.sqrt(2 / pulses) * draws.normal("walk", (count, PULSES)).cumsum(-1)
        return points(draws, count, history=torch.exp(1j * walk))

    return draw


def displaced(count: int, jitter: float) -> Source:
    """Draw points whose pulses are displaced in range by `jitter` cells rms."""

    def draw(trials: int, seed: int) -> Tensor:
        draws = Draws(seed + 9, trials=range(trials))
        return points(draws, count, jitter * draws.normal("displacement", (PULSES, 1)))

    return draw


def phase_error(found: Tensor, truth: Tensor) -> Tensor:
    """Rms error without constant and linear phase, which only displace the image, over the pulses
    that have a true phase.
    """
    return phase_rmse(found, truth.nan_to_num(), truth.isfinite())


def scores(batch: Batch, found: Estimate, far: Tensor) -> Numbers:
    """Scores of phases: entropy above that of the true phases, images that are sharper and wrong,
    error of the image without noise, the Cramer-Rao bound of a known scene, and the error over it.
    """
    truth = batch.truth or {}
    phase, true, data = found.value["phase_rad"].double(), truth["phase_rad"].double(), batch.data.data
    excess = of_image(data, phase) - of_image(data, true.nan_to_num())
    numbers = {"entropy_excess_nats": excess, "sharper_wrong": far & (excess < 0)}
    if batch.clean is None:
        return numbers
    energy = batch.clean.abs().square().sum(-1).double()
    seen = energy > 1e-6 * energy.mean(-1, keepdim=True)
    residual = residual_phase(phase, true.nan_to_num(), seen)
    amplitude = (energy * torch.exp(1j * residual)).sum(-1).abs() / energy.sum(-1)
    known = true.isfinite()
    variance = truth["noise_std"].double()[:, None].square() / (2 * energy)
    bound = (torch.where(known, variance, 0).sum(-1) / known.sum(-1) * (1 - 2 / known.sum(-1))).sqrt()
    bound = torch.where((bound > 0) & bound.isfinite(), bound, torch.nan)
    numbers["image_error_db"] = 10 * torch.log10((2 * (1 - amplitude)).clamp_min(1e-12))
    return numbers | {"bound": bound, "over_bound": phase_error(phase, true) / bound}


def of_image(data: Tensor, phase_rad: Tensor) -> Tensor:
    """Entropy of the image of pulses without their phases."""
    return entropy(torch.fft.fft(turned(data, -phase_rad), dim=-2)).double()


def kinds(track: str, *worlds: tuple[str, Draw, float]) -> list[World]:
    """Worlds of one track."""
    return [World(name, draw, snr_db, track) for name, draw, snr_db in worlds]


def _damaged(**impairments: Impairment) -> Draw:
    """Draw aircraft at 10 dB with impairments of the receiver."""
    return turntable(PLANE, 10.0, impairments=impairments)


def worlds() -> list[World]:
    """All worlds of the benchmark."""
    plane, simple = PLANE, direct()
    satellite, point = Satellite(150, 0.03, 0.04), Points([0.01], [0.0], random_phase=True)
    ground, town = clutter(0.6), clutter(0.6, streets)
    return [
        *nothing((PULSES, CELLS), signal),
        *kinds(
            "targets",
            *(("own", turntable(plane, snr), snr) for snr in (-30.0, -20.0, -10.0, -5.0, 0.0, 20.0, 60.0)),
            *(("satellite", turntable(satellite, snr), snr) for snr in (-5.0, 10.0)),
            *(("direct pulses", observed(dechirped, snr), snr) for snr in (-5.0, 10.0)),
            ("one point", turntable(point, -5.0, CELLS), -5.0),
        ),
        *kinds(
            "points",
            *(("direct", observed(simple, snr), snr) for snr in (-10.0, 10.0)),
            ("one row", observed(direct(cells=1), 10.0), 10.0),
            ("few points", observed(direct(1, cells=4), 10.0), 10.0),
            ("many points", observed(direct(40), 10.0), 10.0),
            ("aliased", observed(direct(3, 1.5), 10.0), 10.0),
            ("partly lit", observed(direct(lit=0.6), 10.0), 10.0),
            ("corners on clutter", observed(added(ground, corners, 0.0), 10.0), 10.0),
            ("lost pulses", observed(lossy(simple, 0.2), 10.0), 10.0),
            ("gap", observed(lossy(simple, 0.2, True), 10.0), 10.0),
        ),
        *kinds(
            "smooth phases",
            *(
                (f"{name} phase", observed(simple, snr, phase), snr)
                for name, phase in (("quadratic", quadratic), ("vibration", vibration), ("walking", wandering))
                for snr in (-5.0, 10.0)
            ),
        ),
        *kinds(
            "clutter",
            ("clutter 60 %", observed(ground, 5.0), 5.0),
            ("clutter 90 %", observed(clutter(0.9), 10.0), 10.0),
            ("K texture", observed(clutter(0.6, texture), 10.0), 10.0),
            ("coast", observed(clutter(0.6, edge), 10.0), 10.0),
            ("town", observed(town, 10.0), 10.0),
        ),
        *kinds(
            "receiver",
            *((f"leakage {level:g} dB", _damaged(a=Leakage(level)), 10.0) for level in (-10.0, 0.0)),
            ("spur", _damaged(a=Leakage(-3.0, sample_cycles=0.21, pulse_cycles=0.13)), 10.0),
            ("ground at rest", _damaged(a=GroundAtRest(0.0)), 10.0),
            ("unequal I and Q", _damaged(a=QuadratureError(1.0, 8.0)), 10.0),
            ("gain steps", _damaged(a=GainSteps()), 10.0),
            ("gate jumps", _damaged(a=GateJumps(2.0)), 10.0),
            ("two bits", _damaged(a=Quantiser(2, 2.0)), 10.0),
            *((f"displaced {count} points", observed(displaced(count, 0.6), 15.0), 15.0) for count in (6, 60)),
        ),
        *kinds(
            "more than one motion",
            *(
                (f"vehicle {level:g} dB", observed(added(scattered(30), vehicle, level), 10.0), 10.0)
                for level in (-5.0, 5.0)
            ),
            ("vehicle in clutter", observed(added(ground, vehicle, 0.0), 10.0), 10.0),
            *(
                (f"another scene of {count} points", observed(another(count), 20.0, defined=False), 20.0)
                for count in (8, 40)
            ),
            *(
                (f"scintillating {count} points", scintillating(snr, count, 16.0), snr)
                for count in (8, 40)
                for snr in (0.0, 20.0)
            ),
            ("changing sea", observed(fluctuating(200, 64.0), 10.0), 10.0),
            *(("walking 3 points", observed(walking(3, 40.0), snr), snr) for snr in (5.0, 20.0)),
        ),
    ]


# tolerances of use
PHASES = [Quantity("phase_rad", 0.5, phase_error, 0.005)]
WORLDS = tuple(worlds())
