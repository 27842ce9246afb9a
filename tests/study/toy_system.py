"""A whole system in one file: a tone in noise whose frequency is estimated.

It is a model for systems of your own. A package makes it known by an entry point of the group
`torchsar.systems`, `tone = "tests.study.toy_system"`, and this repository by its place in
`torchsar/study/systems`. Then `run`, `sweep`, `trade`, `requires` and `list` work on configs with
`system: tone`, such as `CONFIG` of `test_toy_system.py`, and nothing else has to change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Estimate, Outcome, Recording, Signal, Stage, Trace, unit_phasor
from torchsar.focus.requirements import Limit, Requirement
from torchsar.metrics.bounds import tone_frequency_bound_hz
from torchsar.study.settings.signature import Catalogue
from torchsar.study.trials.batch import Batch, Judged, Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.system import Column, Noise, System, World

# peak of the spectrum over the noise below which noise alone may give the strongest line
DETECTION_DB = 14.0


@dataclass(frozen=True)
class Receiver:
    """Section `radar`: what the instrument knows about itself.

    Args:
        sample_rate_hz: Complex samples per second.
    """

    sample_rate_hz: float

    def time_axis(self, samples: int) -> Axis:
        return Axis("time", samples, 0.0, 1 / self.sample_rate_hz, "s")


@dataclass(frozen=True, kw_only=True)
class Tone(World):
    """Section `world`: a tone of amplitude 1 and random phase.

    Args:
        samples: Samples of the record.
        frequency_hz: Frequency, which may differ from trial to trial.
        noise: Power of the tone over that of the noise, per sample.
    """

    samples: int
    frequency_hz: Tensor | float
    noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples < 4:
            raise ValueError(f"world.samples must be at least 4, got {self.samples}")


def strongest_line(x: Tensor, sample_rate_hz: float, padding: int) -> Estimate:
    """Estimate the frequency of a tone: the strongest line of its zero-padded spectrum.

    Args:
        x: Samples, (..., time), complex.
        sample_rate_hz: Sampling rate in hertz.
        padding: Length of the spectrum over that of the record.

    Returns:
        `frequency_hz` of shape (...,), between -1/2 and 1/2 of the sampling rate, with its
        standard deviation. `ok` is False where noise alone could give such a line.
    """
    n = x.shape[-1]
    power, line = torch.fft.fft(x, n * padding).abs().double().square().max(-1)
    frequency = torch.fft.fftfreq(n * padding, 1 / sample_rate_hz, dtype=torch.float64, device=x.device)[line]
    rest = (x.abs().double().square().sum(-1) - power / n).clamp_min(1e-12 * power) / n
    q = power / (n * rest)
    std = torch.hypot(tone_frequency_bound_hz(q, n / sample_rate_hz), _step_hz(sample_rate_hz, n, padding) / 12**0.5)
    return Estimate(
        {"frequency_hz": frequency},
        {"frequency_hz": std},
        q / (1 + q),
        Outcome.of(q > 10 ** (DETECTION_DB / 10), Outcome.NOISE),
    )


def _step_hz(sample_rate_hz: float, samples: int, padding: int) -> Tensor:
    """Distance of the lines of a zero-padded spectrum."""
    return torch.tensor(sample_rate_hz / (samples * padding), dtype=torch.float64)


class StrongestLine(Stage):
    """Stage of `strongest_line`.

    Args:
        radar: The receiver.
        padding: Length of the spectrum over that of the record.
    """

    works_on = ("time",)
    provides = ("frequency_hz",)

    def __init__(self, radar: Receiver, padding: int = 8) -> None:
        super().__init__()
        if padding < 1:
            raise ValueError(f"padding must be at least 1, got {padding}")
        self.radar, self.padding = radar, padding

    def forward(self, signal: Signal) -> Estimate:
        return strongest_line(signal.data, self.radar.sample_rate_hz, self.padding)


class ToneSystem(System):
    """Frequency of a tone in noise."""

    name = "tone"
    about = "a tone in noise, its frequency estimated"
    Radar = Receiver
    World = Tone
    tolerance = {"grid_error_hz": 0.05}
    exact = {"strongest_line.padding": {"padding": 64}}
    definitions = {
        "snr": "power of the tone over noise variance, per sample, dB",
        "frequency_error_hz": "estimated minus true frequency",
        "grid_error_hz": "largest distance of a frequency from the nearest line of the spectrum",
    }
    columns = {
        "frequency_error_hz": Column("error of the frequency", "Hz", drawn="rms"),
        "ok": Column("share of trials called reliable"),
        "seconds": Column("time of a trial", "s"),
    }

    @cached_property
    def stages(self) -> Catalogue:
        return Catalogue("stage", "stage", {"strongest_line": StrongestLine}, ["radar"], ["strongest_line.padding"])

    def samples(self, world: Tone, radar: Receiver) -> int:
        return world.samples

    def simulate(self, bench: Bench, world: Tone, draws: Draws) -> Trials:
        axis, count = bench.radar.time_axis(world.samples), len(draws.trials or (0,))
        frequency = torch.as_tensor(world.frequency_hz, dtype=torch.float64).expand(count)
        turns = frequency[:, None] * axis.values() + draws.uniform("phase").reshape(-1, 1)
        level = math.inf if world.noise.snr_db is None else world.noise.snr_db
        std = 10 ** (-torch.as_tensor(level, dtype=torch.float64).expand(count) / 20)
        clean = unit_phasor(turns, bench.dtype)
        noisy = clean + (std[:, None] * draws.normal("noise", (axis.n,), torch.complex128)).to(bench.dtype)
        recorded, ideal = (Recording(Signal(x.to(bench.device), (axis,)), bench.radar) for x in (noisy, clean))
        return Trials(recorded, ideal, {"frequency_hz": frequency, "noise_std": std}, count)

    def judge(self, bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
        (estimate,) = trace.estimates.values()
        return Judged({"frequency_error_hz": estimate["frequency_hz"].cpu() - trials.truth["frequency_hz"]})

    def bounds(self, bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
        n, std = bench.world().samples, batch.trials.truth["noise_std"]
        bound = tone_frequency_bound_hz(n / std.square(), n / bench.radar.sample_rate_hz)
        return {"frequency_error_hz": {"Cramer-Rao": bound}}

    def limits(self, bench: Bench) -> Mapping[Limit, Sequence[str]]:
        world, snr_db = bench.world(), bench.world().noise.snr_db
        peak = math.inf if snr_db is None else float(snr_db) + 10 * math.log10(world.samples)
        said = "noise alone may give the strongest line", "take more samples"
        return {Limit("SNR of the spectrum", peak, DETECTION_DB, "dB", "refuse", *said, True): list(bench.chains)}

    def requirements(self, bench: Bench) -> Sequence[Requirement]:
        least = min(entry["padding"] for m in bench.config.processor.values() for entry in (m.stages or {}).values())
        said = "phase over the record between tone and nearest line", math.pi / (2 * least), math.nan, math.pi / 4
        return [Requirement("lines of the spectrum", *said, "raise the padding")]

    def choices(self, bench: Bench) -> Sequence[Choice]:
        rate, n = bench.radar.sample_rate_hz, bench.world().samples
        predicted = {p: {"grid_error_hz": float(_step_hz(rate, n, p)) / 2} for p in (1, 4, 16, 64)}
        offered = [Alternative(f"padding {p}", {"padding": p}, loss) for p, loss in predicted.items()]
        return [Choice("padding", "strongest_line.padding", offered, partial(_between_lines, bench))]


def _between_lines(bench: Bench) -> Measured:
    """The estimator on tones without noise, many to each line of the spectrum."""
    rate, axis = bench.radar.sample_rate_hz, bench.radar.time_axis(bench.world().samples)
    true = torch.linspace(0, 1, 601, dtype=torch.float64) * rate / axis.n
    tones = unit_phasor(true[:, None] * axis.values(), bench.dtype)

    def loss(one: Alternative, found: Estimate) -> dict[str, float]:
        return {"grid_error_hz": float((found["frequency_hz"] - true).abs().max())}

    return Measured(lambda one: strongest_line(tones, rate, one.keys["padding"]), loss)


SYSTEM = ToneSystem
