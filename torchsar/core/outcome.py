"""Outcomes of estimates: a code per trial that says what was seen, and what to try."""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor


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
    NOISE = 30
    SINGULAR = 31
    EMPTY = 32
    ERROR = 33

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


# first codes of their kind; plain numbers, since torch.compile compares no tensor with an enum
DOUBTFUL, FAILED = int(Outcome.INEXACT), int(Outcome.NOISE)
_MESSAGES = {
    Outcome.OK: "the estimate is reliable",
    Outcome.NOT_ASSESSED: "not assessed (assess=False)",
    Outcome.INEXACT: "the predicted deviation is too large for use: raise the SNR, or use more data",
    Outcome.PARTS_DISAGREE: (
        "parts of the data ask for different values: there are several motions, or the echo is too weak"
    ),
    Outcome.HOMOGENEOUS: "the scene looks like homogeneous clutter: try link_phases, or scene='clutter'",
    Outcome.SPARSE: "the scene looks like separate points, not like homogeneous clutter: try autofocus",
    Outcome.DISPLACED: "the range profiles are displaced from pulse to pulse: align them first (align_envelopes)",
    Outcome.MISFIT: "the data do not follow the model of the method: choose a method with fewer assumptions",
    Outcome.AMBIGUOUS: "another value explains the data as well: restrict the search, or give a value known a priori",
    Outcome.OUTSIDE_SEARCH: "the search ended at its limit: widen the search",
    Outcome.NOT_CONVERGED: "the iterations did not converge: allow more of them, or start nearer to the solution",
    Outcome.TOO_FEW: "too few pulses, range cells or scatterers to judge the estimate: use more data",
    Outcome.IN_DOUBT: "an estimate on which this one depends is doubtful",
    Outcome.UNSPECIFIED: "not reliable, for a reason that was not given",
    Outcome.NOISE: "nothing rises above the noise: raise the SNR, or use more pulses or range cells",
    Outcome.SINGULAR: "the data do not determine the values: use more of them, or fewer unknowns",
    Outcome.EMPTY: "there are no samples other than zero",
    Outcome.ERROR: "the method stopped with an error, which the log names",
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
