"""Alternation between estimators; each works on data corrected with the results of the others."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchsar.core.estimate import Estimate
from torchsar.core.signal import Signal
from torchsar.core.stage import Stage


@dataclass(frozen=True)
class Turn:
    """One estimator of `Alternate`, with the stage that corrects the data by its estimated values.

    >>> from torchsar import compensate
    >>> from torchsar.core import Turn
    >>> turn = Turn(compensate.Sca(), compensate.CorrectPulsePhase())
    >>> turn.estimator.provides
    ('phase_rad',)

    Args:
        estimator: Stage that returns an Estimate.
        corrector: Stage that removes the estimated effect from the signal before the other
            estimators run; None if the other estimators take the values as arguments instead.
    """

    estimator: nn.Module
    corrector: nn.Module | None = None


class Alternate(Stage):
    """Joint estimate of several effects, by running one estimator for each of them in turn.

    >>> import torch
    >>> from torchsar import Axis, Signal, compensate
    >>> from torchsar.core import Alternate, Turn
    >>> axes = Axis("pulse", 3, 0.0, 0.1, "s"), Axis("range", 2, 0.0, 1.0, "m")
    >>> envelope = Turn(compensate.AlignEnvelopes(assess=False), compensate.ShiftRange())
    >>> both = Alternate(rounds=2, envelope=envelope, phase=Turn(compensate.Sca(assess=False)))
    >>> both(Signal(torch.tensor([[1, 0], [1j, 0], [-1, 0]]), axes))["phase_rad"]
    tensor([0.0000, 1.5708, 3.1416])

    Each turn has an estimator of one effect. It may also have a corrector, a stage that removes
    this effect from the signal. One round runs the estimators of all turns in the order given.

    Before an estimator runs, the correctors of all other turns are applied to the original signal,
    each with the latest values of its own estimator. Correction always starts from the original
    signal, so that errors of an early round do not remain in the data. An estimator also receives,
    as arguments, the latest values (its own included) whose names are parameters of its `forward`.
    A value that no turn has estimated yet is not passed, so that the default of the parameter
    applies. Inside a round the estimated values are used whatever their outcomes, since an estimate
    is often doubtful before the other effects are corrected. The outcome of the result is the worst
    of the last outcomes of the estimators and of those of the values that they last used: an
    estimate from data corrected by a wrong value may look right.

    Args:
        rounds: Number of rounds, at least one.
        **turns: Two or more objects `Turn` (estimator and corrector) by name, in the order in which
            they run.

    Raises:
        TypeError: If a turn is not a `Turn`, the number of rounds is not whole, a stage is not a
            torch.nn.Module, or on a call, an estimator does not return an Estimate or a corrector
            a Signal.
        ValueError: If there are fewer than two turns or less than one round, if an estimator needs
            a value that no earlier turn provides in the first round, or if a corrector needs a
            value that its own estimator does not provide.
    """

    differentiable = "where ok"

    def __init__(self, rounds: int = 3, **turns: Turn) -> None:
        super().__init__()
        for name, turn in turns.items():
            if not isinstance(turn, Turn) or not isinstance(turn.estimator, nn.Module):
                raise TypeError(f"Alternate: {name!r} must be a Turn(estimator) of a stage, got {turn!r}")
            if not isinstance(turn.corrector, nn.Module | None):
                raise TypeError(f"Alternate: the corrector of {name!r} must be a stage or None, got {turn.corrector!r}")
        if not isinstance(rounds, int):
            raise TypeError(f"Alternate: rounds must be a whole number, got {rounds!r}")
        if len(turns) < 2 or rounds < 1:
            raise ValueError(
                f"Alternate needs at least two estimators and one round, got {list(turns)} and rounds={rounds}"
            )
        self.rounds = rounds
        self.estimators = nn.ModuleDict({name: turn.estimator for name, turn in turns.items()})
        self.correctors = nn.ModuleDict(
            {name: turn.corrector for name, turn in turns.items() if turn.corrector is not None}
        )
        self.provides = tuple(
            dict.fromkeys(key for turn in turns.values() for key in getattr(turn.estimator, "provides", ()))
        )
        self.neutral = {
            key: number for turn in turns.values() for key, number in getattr(turn.estimator, "neutral", {}).items()
        }
        self._check()

    def _check(self) -> None:
        """Reject estimators and correctors whose required values are not available in time."""
        available: set[str] = set()
        for name, estimator in self.estimators.items():
            missing = [p.name for p in _parameters(estimator) if p.default is p.empty and p.name not in available]
            if missing:
                raise ValueError(
                    f"Alternate: the estimator {name!r} needs the values {missing} in the first round, but the "
                    f"estimators before it provide {sorted(available) or 'nothing'}; change the order of the "
                    "estimators, or give these parameters of its `forward` a default"
                )
            available |= set(getattr(estimator, "provides", ()))
        for name, corrector in self.correctors.items():
            missing = {p.name for p in _parameters(corrector) if p.default is p.empty} - set(
                getattr(self.estimators[name], "provides", ())
            )
            if missing:
                raise ValueError(
                    f"Alternate: the corrector of the estimator {name!r} needs the values {sorted(missing)}, which "
                    "this estimator does not provide"
                )

    def forward(self, signal: Signal) -> Estimate:
        """Run all rounds of the alternating estimators and merge their last estimates into one.

        Args:
            signal: Signal on the axes that the estimators and correctors work on.

        Returns:
            Estimate with the values and standard deviations of all estimators; where several
            provide the same name, the last of them counts. Per trial, `quality` is the lowest of
            the qualities, and `outcome` the worst of the estimators and of the values that they
            last used. Keys of `info` are "TURN.KEY", with the name of the turn in front.
        """
        found: dict[str, Estimate] = {}
        # for each estimator: outcomes of the values of other estimators that it used
        used: dict[str, list[Tensor]] = {}
        for _ in range(self.rounds):
            for name, estimator in self.estimators.items():
                values = {key: value for estimate in found.values() for key, value in estimate.value.items()}
                used[name] = [estimate.outcome for other, estimate in found.items() if other != name]
                result = estimator(self._without_others(signal, name, found), **_accepted(estimator, values))
                if not isinstance(result, Estimate):
                    raise TypeError(
                        f"Alternate: the estimator {name!r} ({type(estimator).__name__}) must return an Estimate, got "
                        f"{type(result).__name__}"
                    )
                found[name] = result
        return _merged(found, [outcome for outcomes in used.values() for outcome in outcomes])

    def _without_others(self, signal: Signal, name: str, found: dict[str, Estimate]) -> Signal:
        """Correct the signal with the results of all estimators except the named one."""
        for other, corrector in self.correctors.items():
            if other != name and other in found:
                signal = corrector(signal, **_accepted(corrector, found[other].value))
                if not isinstance(signal, Signal):
                    raise TypeError(
                        f"Alternate: the corrector of {other!r} ({type(corrector).__name__}) must return a Signal, got "
                        f"{type(signal).__name__}"
                    )
        return signal


def _parameters(stage: nn.Module) -> list[inspect.Parameter]:
    """Parameters of `forward` after the signal."""
    return list(inspect.signature(stage.forward).parameters.values())[1:]


def _accepted(stage: nn.Module, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Values, out of those given, that are parameters of the stage's `forward`."""
    return {p.name: values[p.name] for p in _parameters(stage) if p.name in values}


def _merged(found: dict[str, Estimate], used: Sequence[Tensor]) -> Estimate:
    """Estimate of all values, with the worst outcome of all parts and of those in `used`."""
    parts = list(found.values())
    quality = functools.reduce(torch.minimum, [part.quality.double() for part in parts])
    outcome = functools.reduce(torch.maximum, [*(part.outcome for part in parts), *used])
    value, std = (
        {key: entry for part in parts for key, entry in getattr(part, table).items()} for table in ("value", "std")
    )
    info = {f"{name}.{key}": entry for name, part in found.items() for key, entry in part.info.items()}
    return Estimate(value, std, quality, outcome, info)
