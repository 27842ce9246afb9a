"""Result of an estimator: values, standard deviations, quality and outcome in each trial, a code
that says what was seen, and what to try.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import torch
from torch import Tensor

from torchsar.core.show import Shown, Summary, content, one_number


class Outcome(IntEnum):
    """Outcome of an estimate in a trial.

    >>> from torchsar import Outcome
    >>> print(Outcome.NOISE.message)
    nothing rises above the noise: raise the SNR, or use more pulses or range cells
    >>> Outcome.HOMOGENEOUS.is_doubtful, Outcome.NOISE.is_failed
    (True, True)

    An estimate is reliable (`Estimate.ok`) with `OK`, and taken for reliable with `NOT_ASSESSED`.
    Codes from 10 on are doubtful: the value is used, and named. Codes from 30 on are failures: a
    neutral value takes the place of the estimated one. Of several reasons the one with the greatest
    code is reported.
    """

    OK = 0
    NOT_ASSESSED = 1
    INEXACT = 10
    PARTS_DISAGREE = 11
    HOMOGENEOUS = 12
    SPARSE = 13
    DISPLACED = 14
    MISFIT = 15
    AMBIGUOUS = 16
    OUTSIDE_SEARCH = 17
    NOT_CONVERGED = 18
    TOO_FEW = 19
    IN_DOUBT = 20
    UNSPECIFIED = 21
    UNBALANCED = 22
    AT_REST = 23
    NOISE = 30
    SINGULAR = 31
    EMPTY = 32
    ERROR = 33
    ABSENT = 34

    @property
    def message(self) -> str:
        """What was seen, and what to try, as one sentence."""
        return _MESSAGES[self]

    @property
    def label(self) -> str:
        """Name in lower case with spaces, as reports show it."""
        return self.name.lower().replace("_", " ")

    @property
    def is_ok(self) -> bool:
        """True for a reliable estimate, and for one that was not assessed."""
        return self < DOUBTFUL

    @property
    def is_doubtful(self) -> bool:
        """True for an estimate that may be wrong, but is used."""
        return DOUBTFUL <= self < FAILED

    @property
    def is_failed(self) -> bool:
        """True for an estimate that is not used."""
        return self >= FAILED

    def like(self, x: Tensor) -> Tensor:
        """Return this code for every element of a tensor, int64."""
        return torch.full(x.shape, int(self), dtype=torch.int64, device=x.device)

    @staticmethod
    def of(ok: Tensor, otherwise: Outcome) -> Tensor:
        """Return codes: OK where a bool tensor is True, and another outcome elsewhere, int64."""
        return worst((otherwise, ~ok))


# Lowest codes of the doubtful and of the failed outcomes. They are plain numbers, because
# torch.compile cannot compare a tensor with an enum.
DOUBTFUL, FAILED = int(Outcome.INEXACT), int(Outcome.NOISE)
_MESSAGES = {
    Outcome.OK: "the estimate is reliable",
    Outcome.NOT_ASSESSED: "not assessed (assess=False)",
    Outcome.INEXACT: "the predicted deviation is too large for use: raise the SNR, or use more data",
    Outcome.PARTS_DISAGREE: (
        "parts of the data ask for different values: there are several motions, or the echo is too weak"
    ),
    Outcome.HOMOGENEOUS: (
        "with these phases the scene looks like homogeneous clutter: try link_phases, scene='clutter', or autofocus"
    ),
    Outcome.SPARSE: "the scene looks like separate points, not like homogeneous clutter: try autofocus",
    Outcome.DISPLACED: "the range profiles are displaced from pulse to pulse: align them first (align_envelopes)",
    Outcome.MISFIT: "the data do not follow the model of the method: choose a method with fewer assumptions",
    Outcome.AMBIGUOUS: "another value explains the data as well: restrict the search, or give a value known a priori",
    Outcome.OUTSIDE_SEARCH: "the search ended at its limit: widen the search",
    Outcome.NOT_CONVERGED: "the iterations did not converge: allow more of them, or start nearer to the solution",
    Outcome.TOO_FEW: "too few pulses, range cells or scatterers to judge the estimate: use more data",
    Outcome.IN_DOUBT: "an estimate on which this one depends is doubtful",
    Outcome.UNSPECIFIED: "not reliable, for a reason that was not given",
    Outcome.UNBALANCED: "the channels differ in phase, gain or delay: balance them first (estimate_balance)",
    Outcome.AT_REST: (
        "a constant, a tone or ground at rest holds the energy: subtract it first (remove_constant, remove_tones)"
    ),
    Outcome.NOISE: "nothing rises above the noise: raise the SNR, or use more pulses or range cells",
    Outcome.SINGULAR: "the data do not determine the values: use more of them, or fewer unknowns",
    Outcome.EMPTY: "there are no samples other than zero",
    Outcome.ERROR: "the method stopped with an error, which the log names",
    Outcome.ABSENT: "no further target was found: this place of the list is empty",
}


def worst(*reasons: tuple[Outcome, Tensor]) -> Tensor:
    """Return the outcome with the greatest code of those that apply, OK where none does.

    >>> import torch
    >>> from torchsar.core import Outcome, worst
    >>> noise, inexact = torch.tensor([True, False]), torch.tensor([True, True])
    >>> worst((Outcome.NOISE, noise), (Outcome.INEXACT, inexact))
    tensor([30, 10])

    Args:
        reasons: Pairs of an outcome and a bool tensor that is True where it applies.

    Returns:
        The codes, int64, in the common shape of the tensors.
    """
    codes = [outcome.like(applies) * applies for outcome, applies in reasons]
    result = codes[0]
    for code in codes[1:]:
        result = torch.maximum(result, code)
    return result


def counts(outcome: Tensor) -> dict[Outcome, int]:
    """Count the trials of each outcome that occurs.

    >>> import torch
    >>> from torchsar.core import counts
    >>> {code.name: n for code, n in counts(torch.tensor([0, 0, 30])).items()}
    {'OK': 2, 'NOISE': 1}

    Args:
        outcome: Codes of any shape.

    Returns:
        Numbers of trials by outcome, in rising order of the codes.
    """
    found, numbers = torch.unique(outcome.detach().cpu(), return_counts=True)
    return {Outcome(int(code)): int(number) for code, number in zip(found, numbers, strict=True)}


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
            those values whose standard deviation theory predicts. Derivatives belong to the values:
            `std`, `factor` and `quality` are constant for them.
        quality: Quality from 0 (unusable) to 1, shape (...,); each estimator defines how it is
            measured. By default 1 where the estimate is ok, and 0 elsewhere.
        outcome: Code of an `Outcome` in each trial, shape (...,), integer; where there are several
            targets, one for each. By default that of an estimate that was not assessed, which needs
            the shape of `quality`, or values of shape (...,).
        info: Further tensors by name, for reports.
        neutral: Neutral values by name: what to assume where the estimate failed, such as no phase
            error or the nominal velocity. Numbers, or tensors that broadcast to the value. A stage
            fills it in, see `Stage`.
        factor: Correlated errors: for values by name a tensor of shape (*value.shape, component).
            The errors of all these values are the products with common independent components of
            unit variance, so that F F^T is their covariance. Values without it have independent
            errors of the size `std`. See `Chain.spread`.

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
    factor: Mapping[str, Tensor] = field(default_factory=dict)

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
        for field_name, table in (("std", self.std), ("factor", self.factor)):
            object.__setattr__(self, field_name, {name: x.detach() for name, x in table.items()})
        object.__setattr__(self, "quality", self.quality.detach())
        for name, x in self.std.items():
            if name not in self.value or x.shape != self.value[name].shape:
                raise ValueError(
                    f"the standard deviation {name!r} of an Estimate has the shape {tuple(x.shape)}; give one with the "
                    f"name and the shape of a value: { {k: tuple(v.shape) for k, v in self.value.items()} }"
                )
        for name, x in self.factor.items():
            if name not in self.std or x.shape[:-1] != self.std[name].shape:
                raise ValueError(
                    f"the factor {name!r} of an Estimate has the shape {tuple(x.shape)}; give it for a value with a "
                    f"standard deviation, with its shape and one more dimension: "
                    f"{ {k: (*v.shape, 'component') for k, v in self.std.items()} }"
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
        """Number of trials of each outcome other than OK.

        Empty where the codes cannot be read, as inside `torch.func.vmap`.
        """
        known = self.outcome.numel() and one_number(self.outcome.sum()) is not None
        return {code: n for code, n in counts(self.outcome).items() if code != Outcome.OK} if known else {}

    @property
    def _verdict(self) -> str:
        """Describe in words in how many trials the estimate is ok, and the reasons in the others.

        An example is "ok in 3 of 4 (noise: 1)".
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

        value, std, info, factor = (
            named([getattr(part, table) for part in parts]) for table in ("value", "std", "info", "factor")
        )
        quality, outcome = (whole([getattr(part, name) for part in parts]) for name in ("quality", "outcome"))
        return Estimate(value, std, quality, outcome, info, factor=factor)


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
