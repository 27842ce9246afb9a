"""Uncertainty of an image: the errors of estimates, carried through the stages that use them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchsar.core.draws import Draws
from torchsar.core.estimate import Estimate, Outcome
from torchsar.core.show import Shown, Summary, content

if TYPE_CHECKING:
    from torchsar.core.trace import Trace

Uses = Mapping[str, Mapping[str, str]]


@dataclass(frozen=True, repr=False)
class Spread(Shown):
    """Standard deviations of an image and of its metrics by the errors of estimates.

    >>> import torch
    >>> from torchsar.core import Spread
    >>> Spread(torch.full((2, 2), 0.1), {"entropy": torch.tensor(0.02)})
    Spread(pixels float32 (2, 2); entropy: 0.02)

    `Chain.spread` makes it.

    Args:
        pixels: Standard deviation of the modulus of each pixel, in the shape of the samples.
        metrics: Standard deviations of the metrics of a trace, by their names and in their units.
    """

    pixels: Tensor
    metrics: Mapping[str, Tensor]

    def _summary(self) -> Summary:
        metrics = [(f"{name}: {content(value)}",) for name, value in self.metrics.items()]
        return Summary(f"pixels {content(self.pixels)}", {"standard deviations of metrics": metrics})


@dataclass(frozen=True)
class _Error:
    """Error of a value of an estimate.

    Args:
        estimate: The estimate.
        key: Name of the value.
        trials: Trial dimensions of the estimate.
        in_doubt: "apply" if a stage uses the value also where it is doubtful, else "neutral".
    """

    estimate: Estimate
    key: str
    trials: torch.Size
    in_doubt: str

    @property
    def signs(self) -> tuple[int, ...]:
        """Shape of its independent signs in a trial.

        Values with factors have one for each component, which differ between targets.
        """
        shape, n = self.estimate.std[self.key].shape, len(self.trials)
        factor = self.estimate.factor.get(self.key)
        return tuple(shape[n:] if factor is None else (*self.estimate.outcome.shape[n:], factor.shape[-1]))

    def with_signs(self, signs: Tensor) -> Tensor:
        """Error with these signs, in the shape of the value; zero where its size is not known."""
        std, factor = self.estimate.std[self.key], self.estimate.factor.get(self.key)
        if factor is None:
            error = std * signs.to(std)
        else:
            between = (None,) * (std.ndim - self.estimate.outcome.ndim)
            error = (factor * signs.to(factor)[(..., *between, slice(None))]).sum(-1)
        return torch.where(self._known & error.isfinite(), error, 0)

    @property
    def unknown(self) -> Tensor:
        """True in trials in which the value is used and the size of its error is not known."""
        neutral = self.key in self.estimate.neutral
        # without a neutral value only an empty place of a list of targets has no use
        unused = self.estimate.unused(self.in_doubt) if neutral else self.estimate.outcome == Outcome.ABSENT
        return (~self._known & ~self._wide(unused)).reshape(*self.trials, -1).any(-1)

    @property
    def _known(self) -> Tensor:
        """True where the standard deviation describes the error, in the shape of the value."""
        return self.estimate.std[self.key].isfinite() & self._wide(self.estimate.ok)

    def _wide(self, mask: Tensor) -> Tensor:
        """Mask of the shape of the outcome with the dimensions of the value."""
        return mask[(..., *(None,) * (self.estimate.std[self.key].ndim - mask.ndim))]


def spread_of(
    trace: Trace,
    retrace: Callable[[Trace, str, Mapping[str, Any]], Trace],
    uses: Uses,
    in_doubt: Mapping[str, str],
    of: Collection[str] | None,
    pairs: int,
) -> Spread:
    """Carry the errors of estimates to pixels and metrics; see `Chain.spread`.

    Args:
        trace: Trace of a chain.
        retrace: Repeats stages of the chain from one on, with given values, see `Chain.retrace`.
        uses: Sources of the values that each stage of the chain uses, see `Chain`.
        in_doubt: What each stage does with doubtful estimates, see `Chain`.
        of: Names of the estimates whose errors count; None for all.
        pairs: Largest number of pairs of directions.

    Returns:
        Standard deviations of pixels and metrics.
    """
    if not isinstance(pairs, int) or pairs < 1:
        raise ValueError(f"`pairs` must be a whole number of at least 1, got {pairs!r}; 32 is the default")
    errors, start = _errors(trace, uses, in_doubt, of)
    # values with factors share the signs of their estimate
    slots = {(name, "" if key in x.estimate.factor else key): x.signs for (name, key), x in errors.items()}
    sizes = [math.prod(shape) for shape in slots.values()]
    # an estimate of a stage that also corrects cannot be held; that stage is repeated
    held = {name: x for name, x in trace.estimates.items() if not _corrects(trace, name)}
    plain = {"": trace.signal.data.abs(), **trace.metrics}
    total = {name: torch.zeros_like(x.abs(), dtype=torch.float64) for name, x in plain.items()}
    with torch.no_grad():
        table = _signs(sum(sizes), pairs)
        for row in torch.cat([table, -table]):
            parts = dict(
                zip(slots, (x.reshape(shape) for x, shape in zip(row.split(sizes), slots.values())), strict=True)
            )
            given: dict[str, Any] = dict(held)
            for (name, key), x in errors.items():
                error = x.with_signs(parts[name, "" if key in x.estimate.factor else key])
                given[name] = replace(given[name], value={**given[name].value, key: x.estimate.value[key] + error})
            again = retrace(trace, start, given)
            for name, x in {"": again.signal.data.abs(), **again.metrics}.items():
                change = x.to(torch.promote_types(x.dtype, torch.float32)) - plain[name]
                total[name] += change.abs().double().square() / (2 * len(table))
    lost = torch.stack([x.unknown for x in errors.values()]).any(0)
    found = {
        name: torch.where(lost[(..., *(None,) * (x.ndim - lost.ndim))], math.inf, x.sqrt()) for name, x in total.items()
    }
    return Spread(found.pop("").to(plain[""].dtype), found)


def _errors(
    trace: Trace, uses: Uses, in_doubt: Mapping[str, str], of: Collection[str] | None
) -> tuple[dict[tuple[str, str], _Error], str]:
    """Collect the errors of all estimated values that later stages use and that have a deviation.

    Returns them by (name of the estimate, name of the value), and the name of the first stage that
    uses one, from which the chain is repeated.
    """
    sources = {name: {source.partition(".")[::2] for source in names.values()} for name, names in uses.items()}
    if isinstance(of, str):
        raise ValueError(f"`of` must be a collection of names of estimates, got the text {of!r}; write [{of!r}]")
    wanted = set(trace.estimates) if of is None else set(of)
    if not wanted <= set(trace.estimates):
        raise ValueError(f"`of` names the estimates {sorted(wanted)}, the trace has {sorted(trace.estimates)}")
    for name in wanted:
        if trace.estimates[name].std and _corrects(trace, name):
            raise ValueError(
                f"stage {name!r} both estimates and corrects, and cannot be repeated with another value; estimate and "
                "correct in two stages, or leave it out: `of` names the estimates whose errors count"
            )
    applied = {pair for name, pairs in sources.items() if in_doubt[name] == "apply" for pair in pairs}
    errors = {
        (name, key): _Error(
            trace.estimates[name],
            key,
            trace.outputs[name].trials,
            "apply" if (name, key) in applied else "neutral",
        )
        for name, key in dict.fromkeys(pair for pairs in sources.values() for pair in sorted(pairs))
        if name in wanted and key in trace.estimates[name].std
    }
    if not errors:
        used = sorted(".".join(pair) for pairs in sources.values() for pair in pairs if pair[0] in wanted)
        known = {name: sorted(trace.estimates[name].std) for name in sorted(wanted)}
        raise ValueError(
            f"no value that stages use has a standard deviation: they use {used or 'no estimate'}, and the estimates "
            f"have those of {known}; an estimator with assess=True gives the ones that it can tell"
        )
    return errors, next(name for name, used in sources.items() if used & set(errors))


def _corrects(trace: Trace, name: str) -> bool:
    """True if the stage of an estimate has also changed the signal."""
    return name in trace.inputs and trace.inputs[name] is not trace.outputs[name]


def _signs(count: int, pairs: int) -> Tensor:
    """Signs of independent errors in each pair, float64 (pair, error).

    They are rows of a Hadamard matrix with random signs of its columns. All its rows together give
    the exact variance of a linear function; of more rows than `pairs`, so many are chosen.
    """
    size = 1 << (count - 1).bit_length()
    rows = Draws(0).permutation("rows", size, "cpu")[:pairs]
    parity = rows[:, None] & torch.arange(count)
    for shift in (32, 16, 8, 4, 2, 1):
        parity = parity ^ (parity >> shift)
    flipped = (Draws(0).uniform("columns", (count,), device="cpu") < 0.5).long()
    return 1.0 - 2.0 * ((parity + flipped) & 1).double()
