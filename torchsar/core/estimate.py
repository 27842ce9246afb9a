"""Result of an estimator: values, standard deviations, quality and outcome in each trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchsar.core.outcome import DOUBTFUL, FAILED, Outcome, counts
from torchsar.core.show import Shown, Summary, content, one_number


@dataclass(frozen=True, repr=False)
class Estimate(Shown):
    """Estimated values with their predicted accuracy and their outcome in each trial.

    >>> import torch, torchsar
    >>> doppler = torch.tensor([24.9, 3.0])
    >>> noisy = torch.tensor([torchsar.Outcome.OK, torchsar.Outcome.NOISE])
    >>> found = torchsar.Estimate({"doppler_hz": doppler}, outcome=noisy, neutral={"doppler_hz": 0})
    >>> found.ok, found.trusted("doppler_hz")
    (tensor([ True, False]), tensor([24.9000,  0.0000]))

    All tensors begin with the trial dimensions (...). A trial in which the estimation fails raises
    no error: its outcome says so, and the values are finite. A Chain uses doubtful values, and
    neutral ones in place of failed ones, see `trusted`.

    Args:
        value: Estimated values by name. Names end in the unit, such as `doppler_hz` of shape (...,)
            or `phase_rad` of shape (..., pulse). Finite in all trials.
        std: Predicted standard deviations, with the names, shapes and units of the values; only for
            those values whose standard deviation theory predicts.
        quality: Quality from 0 (unusable) to 1, shape (...,); each estimator defines how it is
            measured. By default 1 where the estimate is ok, and 0 elsewhere.
        outcome: Code of an `Outcome` in each trial, shape (...,), integer; where there are several
            targets, one for each. By default that of an estimate that was not assessed, which needs
            the shape of `quality`, or values of shape (...,).
        info: Further tensors by name, for reports.
        neutral: Neutral values by name: what to assume where the estimate failed, such as no phase
            error or the nominal velocity. Numbers, or tensors that broadcast to the value. A stage
            fills it in, see `Stage`.

    Raises:
        TypeError: If `value` or `std` is not a mapping of tensors.
        ValueError: If `outcome` is not an integer tensor with the shape of `quality`, or a standard
            deviation does not have the name and the shape of a value.
    """

    value: Mapping[str, Tensor]
    std: Mapping[str, Tensor] = field(default_factory=dict)
    quality: Tensor = None  # pyright: ignore[reportAssignmentType]
    outcome: Tensor = None  # pyright: ignore[reportAssignmentType]
    info: Mapping[str, Tensor] = field(default_factory=dict)
    neutral: Mapping[str, Tensor | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for field_name, table in (("value", self.value), ("std", self.std)):
            if not isinstance(table, Mapping) or not all(isinstance(x, Tensor) for x in table.values()):
                got = (
                    {k: type(x).__name__ for k, x in table.items()}
                    if isinstance(table, Mapping)
                    else type(table).__name__
                )
                raise TypeError(f"an Estimate needs tensors by name in `{field_name}`, got {got}")
        if self.outcome is None:
            like = next(iter(self.value.values())) if self.quality is None else self.quality
            object.__setattr__(self, "outcome", Outcome.NOT_ASSESSED.like(like))
        if self.quality is None:
            object.__setattr__(self, "quality", self.ok.to(torch.get_default_dtype()))
        integer = not (
            self.outcome.is_floating_point() or self.outcome.is_complex() or self.outcome.dtype == torch.bool
        )
        if not integer or self.outcome.shape != self.quality.shape:
            raise ValueError(
                "an Estimate needs a tensor of integers `outcome` (codes of torchsar.Outcome) of the shape of "
                f"`quality`, got `outcome` of {self.outcome.dtype} with shape {tuple(self.outcome.shape)} and "
                f"`quality` with shape {tuple(self.quality.shape)}; Outcome.of(ok, otherwise) makes it from bools"
            )
        for name, x in self.std.items():
            if name not in self.value or x.shape != self.value[name].shape:
                raise ValueError(
                    f"the standard deviation {name!r} of an Estimate has the shape {tuple(x.shape)}; give one with the "
                    f"name and the shape of a value: { {k: tuple(v.shape) for k, v in self.value.items()} }"
                )

    def __getitem__(self, name: str) -> Tensor:
        """Return the value of a name; raise KeyError with the names that exist if there is none."""
        if name not in self.value:
            raise KeyError(f"estimate holds {tuple(self.value)}, not {name!r}")
        return self.value[name]

    @property
    def ok(self) -> Tensor:
        """True where the estimate is reliable or was not assessed, bool, shape (...,)."""
        return self.outcome < DOUBTFUL

    @property
    def failed(self) -> Tensor:
        """True where nothing was found and the neutral value is used, bool, shape (...,)."""
        return self.outcome >= FAILED

    @property
    def doubtful(self) -> Tensor:
        """True where the value may be wrong and is used all the same, bool, shape (...,)."""
        return ~(self.ok | self.failed)

    def trusted(self, name: str, in_doubt: str = "apply") -> Tensor:
        """Return a value with the neutral one in its place where the estimate failed.

        Differentiable; the gradient is zero where the neutral value is used.

        Args:
            name: Name of the value.
            in_doubt: "apply" uses doubtful values, "neutral" only those that are ok.

        Returns:
            Tensor of the shape and dtype of the value. It is the value itself if there is no
            neutral value of this name.

        Raises:
            KeyError: If there is no value of this name.
        """
        value = self[name]
        if name not in self.neutral:
            return value
        neutral = self.neutral[name]
        if isinstance(neutral, (int, float)):
            neutral = torch.full((), neutral, dtype=value.dtype, device=value.device)
        neutral = torch.as_tensor(neutral, dtype=value.dtype, device=value.device)
        unused = self.unused(in_doubt)
        return torch.where(unused[(...,) + (None,) * (value.ndim - unused.ndim)], neutral, value)

    def unused(self, in_doubt: str = "apply") -> Tensor:
        """Return where the neutral value is used, bool, shape (...,); see `trusted`."""
        return self.failed if in_doubt == "apply" else ~self.ok

    @property
    def reasons(self) -> dict[Outcome, int]:
        """Number of trials of each outcome other than OK; empty where the codes cannot be read, as
        within `torch.func.vmap`.
        """
        known = self.outcome.numel() and one_number(self.outcome.sum()) is not None
        return {code: n for code, n in counts(self.outcome).items() if code != Outcome.OK} if known else {}

    @property
    def _verdict(self) -> str:
        """Number of trials in which the estimate is ok, and the reasons where it is not, as words,
        such as "ok in 3 of 4 (noise: 1)".
        """
        count, total, reasons = one_number(self.ok.sum()), self.outcome.numel(), self.reasons
        if count is None:
            return f"outcome of shape {tuple(self.outcome.shape)}"
        if reasons == {Outcome.NOT_ASSESSED: total}:
            return "not assessed"
        named = ", ".join(f"{code.label}: {n}" for code, n in reasons.items())
        return f"ok in {count} of {total}{f' ({named})' if named else ''}"

    def _summary(self) -> Summary:
        std = {name: f"standard deviation {content(value)}" for name, value in self.std.items()}
        values = [(name, content(value), std.get(name, "")) for name, value in self.value.items()]
        total = self.outcome.numel()
        reasons = [(code.label, f"{n} of {total}", code.message) for code, n in self.reasons.items() if not code.is_ok]
        return Summary(f"{self._verdict}, {self.outcome.device}", {"values": values, "reasons": reasons})

    @staticmethod
    def joined(parts: Sequence[Estimate], trials: torch.Size) -> Estimate:
        """Join the estimates of consecutive blocks of trials.

        Args:
            parts: Estimates with equal names; each tensor has one leading dimension, the trials of
                its block.
            trials: Trial dimensions of the result; empty for a single trial without that dimension.

        Returns:
            One estimate of all trials, in the order of the blocks.
        """

        def whole(tensors: list[Tensor]) -> Tensor:
            return torch.cat(tensors).unflatten(0, trials) if trials else torch.cat(tensors)[0]

        def named(tables: list[Mapping[str, Tensor]]) -> dict[str, Tensor]:
            return {name: whole([table[name] for table in tables]) for name in tables[0]}

        value, std, info = (named([getattr(part, table) for part in parts]) for table in ("value", "std", "info"))
        quality, outcome = (whole([getattr(part, name) for part in parts]) for name in ("quality", "outcome"))
        return Estimate(value, std, quality, outcome, info)


def settle(value: Tensor, fallback: Tensor | float) -> tuple[Tensor, Tensor]:
    """Replace values that are not finite by a fallback.

    Args:
        value: Values of any shape, float.
        fallback: Replacement, a number or a tensor that broadcasts to the shape of `value`.

    Returns:
        The values with the replacements, and a bool mask that is True where the value was finite;
        both have the shape of `value`.
    """
    finite = torch.isfinite(value)
    if isinstance(fallback, Tensor):
        fallback = fallback.to(value)
    return torch.where(finite, value, fallback), finite
