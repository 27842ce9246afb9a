"""How a verdict is judged: worlds, quantities with the tolerance of use, and the rows of the table.

An entry joins an estimator to the worlds in which it is tried. A world draws a batch of data and
gives the truth, or says that there is nothing to be found; then every `ok` is false.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import math
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from scipy.stats import beta
from torch import Tensor, nn

from torchsar.core import Draws, Estimate

PACKAGES = ("core", "repair", "compensate", "multichannel", "focus", "metrics", "optim", "io")
NOTHING = ("noise", "zeros", "real noise", "bright cells", "bright lines")  # worlds with nothing to be found
SURE, RATIO = 5.0, (0.5, 2.0)  # predicted standard deviations of a false ok; bar of predicted over true
FALSE = 0.02  # bar of the lower end of the 95 % interval of the share that is ok and wrong
DOUBT = 0.05  # bar of needless doubt, 10 dB above the threshold
SNR_DB = (-30.0, -20.0, -10.0, 0.0, 10.0, 20.0, 40.0, 60.0)


@dataclass(frozen=True)
class Batch:
    """Data of one world.

    Args:
        data: Signal or tensor with one trial dimension.
        truth: True values by name, shape (trial, ...); None where nothing can be found.
        values: Values that the estimator is given, by name.
    """

    data: Any
    truth: Mapping[str, Tensor] | None = None
    values: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class World:
    """A kind of data, with a function that draws a number of trials of it by seed."""

    name: str
    draw: Callable[[int, int], Batch]
    snr_db: float | None = None


def difference(found: Tensor, truth: Tensor) -> Tensor:
    """Rms over the trailing dimensions of the difference, (trial, ...) -> (trial,)."""
    return rms((found - truth).double())


def rms(x: Tensor) -> Tensor:
    """Rms over all dimensions but the first, (trial, ...) -> (trial,)."""
    return x.double().reshape(len(x), -1).square().mean(-1).sqrt()


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
    """An estimator and its worlds.

    Args:
        name: Public name, with `package.` before it; a suffix after `:` names a setting.
        run: The estimator, called with the data of a batch and its values.
        worlds: Worlds in which it is tried.
        judged: What is judged.
        share: Share of the trials that its cost allows.
    """

    name: str
    run: Callable[..., Any]
    worlds: Sequence[World]
    judged: Sequence[Quantity]
    share: float = 1.0


def estimate_of(out: Any) -> Estimate:
    """Return the estimate that a stage gives alone or beside a signal."""
    return next(part for part in (out if isinstance(out, tuple) else (out,)) if isinstance(part, Estimate))


def audit(entries: Sequence[Entry], trials: Callable[[Entry, World], int]) -> Iterator[dict[str, Any]]:
    """Give the rows of entries, world by world, since several entries share the data of a world.

    Args:
        entries: Estimators.
        trials: Number of trials of an estimator in a world.

    Yields:
        Rows, see `judge`.
    """
    worlds = {id(world): world for entry in entries for world in entry.worlds}
    for world in worlds.values():
        drawn = World(world.name, functools.cache(world.draw), world.snr_db)
        for entry in entries:
            if any(world is own for own in entry.worlds):
                yield judge(entry, drawn, trials(entry, world))


def judge(entry: Entry, world: World, trials: int, seed: int = 1, block: int = 25) -> dict[str, Any]:
    """Run an estimator in a world and count its verdicts.

    Args:
        entry: Estimator.
        world: World.
        trials: Number of trials.
        seed: Seed of the draws.
        block: Trials that are computed at once.

    Returns:
        A row: estimator, world, snr_db, trials, ok, false_ok and needless as shares of the trials,
        rms_over_std (None where no trial is ok or no standard deviation is given), and refused, the
        sentence of the estimator if it does not accept the data.
    """
    row: dict[str, Any] = {"estimator": entry.name, "world": world.name, "snr_db": world.snr_db, "trials": trials}
    parts = []
    try:
        for first in range(0, trials, block):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                batch = world.draw(min(block, trials - first), 1000 * seed + first)
                parts.append(counted(entry, batch, estimate_of(entry.run(batch.data, **batch.values))))
    except ValueError as refusal:
        return {**row, "ok": 0.0, "false_ok": 0.0, "needless": 0.0, "rms_over_std": None, "refused": str(refusal)}
    ok, wrong, useful = (torch.cat([part[i] for part in parts]) for i in range(3))
    row |= {
        "ok": float(ok.double().mean()),
        "false_ok": float((ok & wrong).double().mean()),
        "needless": float((~ok & useful).double().mean()),
        "rms_over_std": None,
    }
    ratios = []
    for pairs in zip(*(part[3] for part in parts), strict=True):
        error, std = (torch.cat([pair[i] for pair in pairs])[ok] for i in range(2))
        if len(error) and bool((std > 0).any()) and float(error.square().mean().sqrt()) > 0:
            ratios.append(float((error.square().mean() / std.square().mean()).sqrt()))
    if ratios:
        row["rms_over_std"] = max(ratios, key=lambda r: abs(math.log(r)))
    return row


def counted(entry: Entry, batch: Batch, found: Estimate) -> tuple[Tensor, Tensor, Tensor, list[tuple[Tensor, Tensor]]]:
    """Per trial: ok, wrong, of use, and (error, predicted standard deviation) of each quantity."""
    ok = found.ok.reshape(len(found.ok), -1).any(-1)
    if batch.truth is None:
        everything = torch.ones_like(ok)
        return ok, everything, ~everything, []
    wrong, useful, pairs = torch.zeros_like(ok), torch.ones_like(ok), []
    for judged in entry.judged:
        if judged.name not in batch.truth:
            continue
        error = judged.error(found.value[judged.name], batch.truth[judged.name]).cpu()
        far = ~(error <= judged.tolerance)
        wrong, useful = wrong | far, useful & ~far
        if judged.predicted and judged.name in found.std:
            std = rms(found.std[judged.name])
            wrong = wrong | (error > SURE * std + judged.floor)
            pairs.append((error, std))
    return ok, wrong, useful, pairs


def verdict(row: Mapping[str, Any]) -> list[str]:
    """List the bars that a row misses."""
    missed = []
    nothing = row["world"] in NOTHING
    share = row["ok" if nothing else "false_ok"]
    count, trials = round(share * row["trials"]), row["trials"]
    if count and float(beta.ppf(0.025, count, trials - count + 1)) > FALSE:
        missed.append(f"ok {row['ok']:.2f}" if nothing else f"false ok {row['false_ok']:.2f}")
    ratio = row["rms_over_std"]
    if ratio is not None and row["trials"] * row["ok"] >= 20 and not 1 / RATIO[1] <= ratio <= 1 / RATIO[0]:
        missed.append(f"rms over std {ratio:.2f}")
    return missed


def doubted(rows: Sequence[Mapping[str, Any]]) -> Iterator[Mapping[str, Any]]:
    """Rows of needless doubt: more than 5 % of the trials, 10 dB or more above the threshold.

    The threshold is the lowest SNR of the same estimator and world from which on at least 95 % of
    the estimates are within the tolerance of use, whatever their verdict.
    """
    for row in rows:
        if row["snr_db"] is None or row["needless"] <= DOUBT:
            continue
        same = [r for r in rows if (r["estimator"], r["world"]) == (row["estimator"], row["world"])]
        useless = [r["snr_db"] for r in same if r["ok"] - r["false_ok"] + r["needless"] < 1 - DOUBT]
        below = [r["snr_db"] for r in same if r["snr_db"] < row["snr_db"]]
        useful = [snr_db for snr_db in below if snr_db > max(useless, default=-math.inf)]
        if useful and row["snr_db"] - min(useful) >= 10:
            yield row


def estimators() -> Iterator[str]:
    """Public functions and stages whose result has a verdict, by introspection, as package.name."""
    for package in PACKAGES:
        module = importlib.import_module(f"torchsar.{package}")
        for name in sorted(module.__all__):
            thing = getattr(module, name)
            if inspect.isclass(thing):
                if not issubclass(thing, nn.Module):
                    continue
                thing = thing.forward
            if inspect.isfunction(thing) and _judges(typing.get_type_hints(thing).get("return")):
                yield f"{package}.{name}"


def _judges(hint: Any) -> bool:
    """Whether a return type has a verdict `ok`, such as `Estimate`, or holds one that has."""
    if inspect.isclass(hint) and "ok" in {*getattr(hint, "__annotations__", {}), *vars(hint)}:
        return True
    return any(_judges(part) for part in typing.get_args(hint))


def white(shape: Sequence[int], dtype: torch.dtype = torch.complex64) -> Callable[[int, int], Tensor]:
    """Draw circular white noise (trial, *shape)."""
    return lambda trials, seed: Draws(seed, trials=range(trials)).normal("alone", tuple(shape), dtype)


def silent(shape: Sequence[int], dtype: torch.dtype = torch.complex64) -> Callable[[int, int], Tensor]:
    """Draw zeros (trial, *shape)."""
    return lambda trials, seed: torch.zeros(trials, *shape, dtype=dtype)


def uneven(shape: Sequence[int], dim: int, most: int = 3) -> Callable[[int, int], Tensor]:
    """Draw white noise, 20 or 40 dB stronger in 1 to `most` places of a dimension of `shape`."""
    noise = white(shape)

    def draw(trials: int, seed: int) -> Tensor:
        x = noise(trials, seed).movedim(dim, -1)
        order = Draws(seed, trials=range(trials)).uniform("audit.places", (x.shape[-1],)).argsort(-1).argsort(-1)
        number = torch.arange(seed, seed + trials)[:, None]
        level = torch.where(order <= number % most, 10.0 ** (1 + number // most % 2), 1.0)
        level = level.reshape(trials, *[1] * (x.ndim - 2), -1)
        return (x * level).movedim(-1, dim)

    return draw


def real(shape: Sequence[int]) -> Callable[[int, int], Tensor]:
    """Draw white noise (trial, *shape) whose imaginary part is zero."""
    noise = white(shape)

    def draw(trials: int, seed: int) -> Tensor:
        x = noise(trials, seed).real
        return torch.complex(x, torch.zeros_like(x))

    return draw


def nothing(shape: Sequence[int], wrap: Callable[[Tensor], Any] = lambda x: x, **values: Any) -> list[World]:
    """Make the worlds in which nothing can be found, for data of this shape."""

    def of(draw: Callable[[int, int], Tensor]) -> Callable[[int, int], Batch]:
        def batch(trials: int, seed: int) -> Batch:
            x = draw(trials, seed)
            return Batch(wrap(x), None, {name: v(x) if callable(v) else v for name, v in values.items()})

        return batch

    return [
        World("noise", of(white(shape))),
        World("zeros", of(silent(shape))),
        World("real noise", of(real(shape))),
        World("bright cells", of(uneven(shape, -1))),
        *([World("bright lines", of(uneven(shape, -2)))] if len(shape) > 1 else []),
    ]


def unlit(worlds: Sequence[World]) -> list[World]:
    """Leave out bright cells, for estimators that are right about a cell that stays bright."""
    return [world for world in worlds if world.name != "bright cells"]
