"""Estimators in turn, each on the original data with what the others have found taken out."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from torchsar.core.estimate import Estimate
from torchsar.core.signal import Signal
from torchsar.core.stage import Stage


@dataclass(frozen=True)
class Turn:
    """One side of an alternation.

    corrector: the stage that takes its values out of the data for the others, or None where these
    use the values themselves.
    """

    estimator: nn.Module
    corrector: nn.Module | None = None


class Alternate(Stage):
    """`Alternate(rounds=3, phase=Turn(autofocus, corrector), rotation=Turn(estimator))`: an
    estimator of everything that its turns estimate.

    A round runs the turns in the order given. Each sees the ORIGINAL signal after the correctors of
    all other turns, each with its own turn's latest values, and is handed those latest values, its
    own among them, that its `forward` has parameters for; in the first round it does without what
    is not there yet. Errors of a turn so never stay in the data. ok: all turns are; quality: the
    least; a name that several turns offer is that of the last. Raises ValueError for fewer than two
    turns, less than one round, or a parameter that no turn can offer before it is needed.
    """

    def __init__(self, rounds: int = 3, **turns: Turn) -> None:
        super().__init__()
        if len(turns) < 2 or rounds < 1:
            raise ValueError(
                f"an alternation needs two turns or more and one round or more, got {list(turns)} and rounds={rounds}"
            )
        self.rounds = rounds
        self.estimators = nn.ModuleDict({name: turn.estimator for name, turn in turns.items()})
        self.correctors = nn.ModuleDict(
            {name: turn.corrector for name, turn in turns.items() if turn.corrector is not None}
        )
        self.provides = tuple(
            dict.fromkeys(key for turn in turns.values() for key in getattr(turn.estimator, "provides", ()))
        )
        self._check()

    def _check(self) -> None:
        offered: set[str] = set()
        for name, estimator in self.estimators.items():
            missing = [p.name for p in _parameters(estimator) if p.default is p.empty and p.name not in offered]
            if missing:
                raise ValueError(
                    f"the turn {name!r} needs {missing} in the first round, but the turns before it offer "
                    f"{sorted(offered) or 'nothing'}; change the order, or give it a default"
                )
            offered |= set(getattr(estimator, "provides", ()))
        for name, corrector in self.correctors.items():
            missing = {p.name for p in _parameters(corrector) if p.default is p.empty} - set(
                getattr(self.estimators[name], "provides", ())
            )
            if missing:
                raise ValueError(
                    f"the corrector of the turn {name!r} needs {sorted(missing)}, which its estimator does not offer"
                )

    def forward(self, signal: Signal) -> Estimate:
        found: dict[str, Estimate] = {}
        for _ in range(self.rounds):
            for name, estimator in self.estimators.items():
                values = {key: value for estimate in found.values() for key, value in estimate.value.items()}
                found[name] = estimator(self._without_others(signal, name, found), **_accepted(estimator, values))
        return _merged(found)

    def _without_others(self, signal: Signal, name: str, found: dict[str, Estimate]) -> Signal:
        for other, corrector in self.correctors.items():
            if other != name and other in found:
                signal = corrector(signal, **_accepted(corrector, found[other].value))
        return signal


def _parameters(stage: nn.Module) -> list[inspect.Parameter]:
    """Parameters of forward but the signal."""
    return list(inspect.signature(stage.forward).parameters.values())[1:]


def _accepted(stage: nn.Module, values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {p.name: values[p.name] for p in _parameters(stage) if p.name in values}


def _merged(found: dict[str, Estimate]) -> Estimate:
    """One estimate of all values, ok where all are."""
    parts = list(found.values())
    ok, quality = parts[0].ok, parts[0].quality.double()
    for part in parts[1:]:
        ok, quality = ok & part.ok, quality.minimum(part.quality.double())
    value, std = (
        {key: entry for part in parts for key, entry in getattr(part, table).items()} for table in ("value", "std")
    )
    info = {f"{name}.{key}": entry for name, part in found.items() for key, entry in part.info.items()}
    return Estimate(value, quality, ok, std, info)
