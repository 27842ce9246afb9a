"""The frame of all benchmarks: worlds, what is judged, and the scores of methods.

A benchmark is a list of entries. An entry joins a method to the worlds in which it is tried. A
world draws data by a fixed seed and gives the truth, or says that there is nothing to be found.
"""

from __future__ import annotations

import math
import os
import pickle
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Estimate, Signal
from torchsar.metrics.intervals import share_interval, trial_statistics
from torchsar.study.memory import PeakMemory

NOTHING = ("noise", "zeros", "real noise", "bright cells", "bright lines")  # worlds with nothing to be found
SURE = 5.0  # an error of more predicted standard deviations is wrong where the method is sure
SNR_DB = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 40.0, 60.0)
BLOCK = 25  # trials that are drawn at once; scenes depend on it
SPLITS = {"test": 1000, "validation": 2000, "train": 3000}  # seeds of the first blocks


@dataclass(frozen=True)
class Batch:
    """Data of one world.

    Args:
        data: Signal or tensor with one trial dimension.
        truth: True values by name, shape (trial, ...); None where nothing can be found.
        values: Values that the method is given, by name.
        clean: Echo without errors and noise, shape of the data; None where it has no use.
    """

    data: Any
    truth: Mapping[str, Tensor] | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    clean: Tensor | None = None

    def parts(self, size: int) -> Iterator[Batch]:
        """Divide the batch into parts of at most `size` trials."""
        x = samples(self.data)
        trials = len(x)
        if size >= trials:
            yield self
            return

        def cut(value: Any, at: slice) -> Any:
            if isinstance(value, Signal):
                return value.with_data(value.data[at])
            return value[at] if isinstance(value, Tensor) and value.shape[:1] == (trials,) else value

        for first in range(0, trials, size):
            at = slice(first, first + size)
            truth = None if self.truth is None else {name: cut(value, at) for name, value in self.truth.items()}
            values = {name: cut(value, at) for name, value in self.values.items()}
            yield Batch(cut(self.data, at), truth, values, cut(self.clean, at))


def sealed(blocks: Sequence[Batch]) -> tuple[list[Batch], bytes]:
    """Blocks without their truth, and the truth as bytes: no frame above a method holds it."""
    hidden = [(block.truth, block.clean) for block in blocks]
    return [replace(block, truth=None, clean=None) for block in blocks], pickle.dumps(hidden)


def samples(data: Any) -> Tensor:
    """The tensor of data."""
    return data.data if isinstance(data, Signal) else data


@dataclass(frozen=True)
class World:
    """A kind of data, with a function that draws a number of trials of it by seed.

    Args:
        name: Name.
        draw: Function of the number of trials and the seed.
        snr_db: SNR in decibels, where it is one.
        track: Group of worlds whose trials are also summed up together.
    """

    name: str
    draw: Callable[[int, int], Batch]
    snr_db: float | None = None
    track: str = ""

    @property
    def label(self) -> str:
        return self.name if self.snr_db is None else f"{self.name}, {self.snr_db:g} dB"

    def blocks(self, trials: int, split: str = "test", draw: int = 0) -> list[Batch]:
        """Draw trials in blocks; `draw` chooses others than the frozen ones."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            seed = SPLITS[split] + 1_000_003 * draw
            return [self.draw(min(BLOCK, trials - first), seed + first) for first in range(0, trials, BLOCK)]


def rms(x: Tensor, truth: Tensor | None = None) -> Tensor:
    """Rms over all dimensions but the first, (trial, ...) -> (trial,), where the truth is known."""
    if truth is not None and truth.shape == x.shape:
        return x.double().where(truth.isfinite(), torch.nan).reshape(len(x), -1).square().nanmean(-1).sqrt()
    return x.double().reshape(len(x), -1).square().mean(-1).sqrt()


def difference(found: Tensor, truth: Tensor) -> Tensor:
    """Rms over the trailing dimensions of the difference, (trial, ...) -> (trial,)."""
    return rms((found - truth).double())


@dataclass(frozen=True)
class Quantity:
    """What is judged of an estimate.

    Args:
        name: Name of the value.
        tolerance: Error up to which the value is of use.
        error: Error of each trial from the value and the truth.
        floor: Error so small that no standard deviation is expected to explain it.
        predicted: Whether the error has the unit of the predicted standard deviation.
    """

    name: str
    tolerance: float
    error: Callable[[Tensor, Tensor], Tensor] = difference
    floor: float = 0.0
    predicted: bool = True


@dataclass(frozen=True)
class Entry:
    """A method and its worlds.

    Args:
        name: Name; a suffix after `:` names a setting.
        run: The method, called with the data of a batch and its values.
        worlds: Worlds in which it is tried.
        judged: What is judged.
    """

    name: str
    run: Callable[..., Any]
    worlds: Sequence[World]
    judged: Sequence[Quantity]


Numbers = dict[str, Tensor]
Scores = Callable[[Batch, Estimate, Tensor], Numbers]


@dataclass(frozen=True)
class Bench:
    """A benchmark.

    Args:
        name: Name for the command line.
        about: What is estimated.
        entries: Function that gives its methods; the first one has the worlds of new methods.
        scores: Further numbers of each trial from the batch, the estimate and the errors.
        per_pulse: Whether a method gives one value per pulse.
    """

    name: str
    about: str
    entries: Callable[[], Sequence[Entry]]
    scores: Scores | None = None
    per_pulse: bool = False


def estimate_of(out: Any) -> Estimate:
    """Return the estimate that a stage gives alone or beside a signal."""
    return next(part for part in (out if isinstance(out, tuple) else (out,)) if isinstance(part, Estimate))


def counted(entry: Entry, batch: Batch, found: Estimate, scores: Scores | None = None) -> Numbers:
    """Numbers of each trial: verdicts as bool, errors and other scores as float64.

    `merit` is 1 where the method is sure and right, -1 where it is sure and wrong, 1/2 where it
    doubts a right value, and 0 otherwise. To be sure then pays above a probability of 2/3 only.
    """
    ok = found.ok.reshape(len(found.ok), -1).any(-1).cpu()
    if batch.truth is None:
        return {"ok": ok, "sure_wrong": ok, "merit": -ok.double()}
    wrong, right, numbers = torch.zeros_like(ok), torch.ones_like(ok), {}
    judged = [quantity for quantity in entry.judged if quantity.name in batch.truth]
    for quantity in judged:
        name, std = quantity.name, found.std.get(quantity.name)
        error = quantity.error(found.value[name], batch.truth[name]).double().cpu()
        far = ~(error <= quantity.tolerance)
        wrong, right = wrong | far, right & ~far
        numbers.setdefault("error", error)
        if quantity.predicted and std is not None:
            deviation = rms(std, batch.truth[name]).cpu()
            wrong = wrong | (error > SURE * deviation + quantity.floor)
            numbers |= {f"error:{name}": error[ok], f"std:{name}": deviation[ok]}
    merit = torch.where(ok, 1 - 2 * wrong.double(), 0.5 * right.double())
    numbers |= {"ok": ok, "right": right, "sure_wrong": ok & wrong, "needless": ~ok & right, "merit": merit}
    return numbers if scores is None else numbers | scores(batch, found, ~right)


def refused(batch: Batch) -> Numbers:
    """Numbers of trials that a method does not accept."""
    no = torch.zeros(len(samples(batch.data)), dtype=torch.bool)
    numbers = {"ok": no, "sure_wrong": no, "merit": no.double()}
    return numbers if batch.truth is None else numbers | {"right": no, "needless": no}


def processor_seconds() -> float:
    """Processor time of this process and of those that it has started and that have ended."""
    return time.process_time() + sum(os.times()[2:4])


def pair_seconds(x: Tensor, least: float = 0.01) -> float:
    """Processor time of a transform of all samples along the pulses, forward and back."""
    count, began = 0, time.process_time()
    while (spent := time.process_time() - began) < least or not count:
        torch.fft.ifft(torch.fft.fft(x, dim=min(1, x.ndim - 1)))
        count += 1
    return spent / count


def tried(
    entry: Entry, blocks: Sequence[Batch], truth: bytes, scores: Scores | None = None, batch: int = BLOCK
) -> tuple[list[Numbers], str | None]:
    """Run a method on `sealed` blocks of a world. The truth is opened after its last call.

    Returns the numbers of each block, the processor time of the method (`time:method`) and that of
    bare transforms (`time:pairs`) among them, and the sentence with which the method refuses.
    """
    answers: list[tuple[Estimate, Numbers] | None] = []
    sentence = None
    for part in (part for block in blocks for part in block.parts(batch)):
        began = processor_seconds()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                estimate = estimate_of(entry.run(part.data, **part.values))
        except ValueError as refusal:
            sentence = str(refusal)
            answers.append(None)
            continue
        spent = processor_seconds() - began
        pair = pair_seconds(samples(part.data))
        times = {"time:method": torch.tensor([spent]), "time:pairs": torch.tensor([pair])}
        answers.append((estimate, times))
    pairs = zip(blocks, pickle.loads(truth), strict=True)
    whole = (replace(block, truth=values, clean=clean) for block, (values, clean) in pairs)
    found = [
        refused(part) if answer is None else counted(entry, part, answer[0], scores) | answer[1]
        for part, answer in zip((part for block in whole for part in block.parts(batch)), answers, strict=True)
    ]
    return found, sentence


def joined(parts: Sequence[Numbers]) -> Numbers:
    """Join numbers of several blocks or worlds."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {name: torch.cat([part[name] for part in parts if name in part]) for name in names}


def row(numbers: Numbers) -> dict[str, Any]:
    """Sum up trials: shares, medians and the mean merit as [value, low, high] with 95 % intervals.

    `calibration` is the rms error over the rms predicted standard deviation of the trials that are
    ok, of the quantity for which it is farthest from 1; `pairs` is the time in bare transforms.
    """
    found: dict[str, Any] = {"trials": len(numbers["ok"])}
    for name, x in numbers.items():
        if ":" in name:
            continue
        if x.dtype == torch.bool:
            share, interval = share_interval(x.numpy(), np.ones(1, dtype=bool))
            found[name] = [share, *interval]
        else:
            kind, statistics = "mean" if name == "merit" else "median", trial_statistics(x.double().numpy(), seed=1)
            found[name] = [statistics[kind], *statistics[f"{kind}_interval"]]
    ratios = []
    for name in (name[4:] for name in numbers if name.startswith("std:")):
        error, std = (numbers[f"{key}:{name}"].square().mean().sqrt() for key in ("error", "std"))
        if std > 0 and error > 0:
            ratios.append(float(error / std))
    found["calibration"] = max(ratios, key=lambda ratio: abs(math.log(ratio)), default=None)
    if "time:method" in numbers:
        found["pairs"] = float(numbers["time:method"].sum() / numbers["time:pairs"].sum().clamp_min(1e-12))
    return {name: rounded(value) for name, value in found.items()}


def rounded(value: Any) -> Any:
    """Numbers to five digits; None where they are not finite."""
    if isinstance(value, list):
        return [rounded(x) for x in value]
    if isinstance(value, float | np.floating | np.ndarray):
        return float(f"{float(value):.5g}") if math.isfinite(value) else None
    return value


def scored(
    bench: Bench,
    entries: Sequence[Entry],
    trials: int,
    *,
    most: int = 0,
    small: bool = False,
    draw: int = 0,
    batch: int = BLOCK,
    say: Callable[[str, int], object] = lambda *_: None,
) -> dict[str, Any]:
    """Score methods, world by world, since they share the data of a world.

    Args:
        bench: Benchmark.
        entries: Methods.
        trials: Number of trials in a world.
        most: Number of trials in the row of a world in which a method was sure and wrong; tracks
            and sums have `trials` of each world.
        small: Whether to leave out worlds: every fourth is tried, with at most 6 trials.
        draw: Number of other scenes than the frozen ones, from 1 on.
        batch: Largest number of trials that a method is given at once.
        say: Function that is told each world before it is tried, and their number.

    Returns:
        Rows by method: `worlds`, `tracks`, `all`, and `memory`, the peak in sizes of the data.
    """
    worlds = list({id(world): world for entry in entries for world in entry.worlds}.values())
    worlds, trials, most = (worlds[::4], min(trials, 6), 0) if small else (worlds, trials, most)
    parts: dict[str, dict[str, Numbers]] = {entry.name: {} for entry in entries}
    methods: dict[str, dict[str, Any]] = {entry.name: {"worlds": {}, "tracks": {}, "all": None} for entry in entries}
    for world in worlds:
        say(world.label, len(worlds))
        drawn = sealed(world.blocks(trials, draw=draw))
        for entry in (entry for entry in entries if any(world is own for own in entry.worlds)):
            method = methods[entry.name]
            if "memory" not in method:
                method["memory"] = _memory(entry, drawn[0][0])
            found, sentence = tried(entry, *drawn, bench.scores, batch)
            parts[entry.name][world.label] = numbers = joined(found)
            if most > trials and numbers["sure_wrong"].any():
                more = sealed(world.blocks(most, draw=draw))
                numbers = joined(tried(entry, *more, bench.scores, batch)[0])
            method["worlds"][world.label] = row(numbers) | ({"refused": sentence} if sentence else {})
    for entry in entries:
        mine, method = parts[entry.name], methods[entry.name]
        tracks = {world.label: world.track for world in entry.worlds}
        for track in dict.fromkeys(tracks[label] for label in mine):
            method["tracks"][track] = row(joined([mine[label] for label in mine if tracks[label] == track]))
        method["all"] = row(joined(list(mine.values()))) if mine else None
    return methods


def _memory(entry: Entry, batch: Batch) -> float | None:
    """Peak memory of a call in sizes of the data; None where it is not known."""
    try:
        with PeakMemory() as peak, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            entry.run(batch.data, **batch.values)
    except ValueError:
        return None
    x = samples(batch.data)
    return None if peak.bytes is None else rounded(peak.bytes / (x.numel() * x.element_size()))


def in_worlds_of(entry: Entry, name: str, run: Callable[..., Any]) -> Entry:
    """Another method in the worlds of an entry."""
    return replace(entry, name=name, run=run)
