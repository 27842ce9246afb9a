"""Refusing samples that no stage can work on."""

from __future__ import annotations

import torch
from torch import Tensor


def refuse_non_finite(x: Tensor, what: str) -> None:
    """Raise ValueError, with the count and the first place, where x holds NaN or Inf.

    Costs one sum over clean data.
    """
    try:
        total = torch.view_as_real(x.detach()).sum() if x.is_complex() else x.detach().sum()
        if bool(torch.isfinite(total)):
            return
        bad = ~torch.isfinite(x.detach())
        count = int(bad.sum())
    except RuntimeError:  # inside vmap a value cannot be looked at
        return
    if count:
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(
            f"{what}: {count} of {x.numel()} samples are NaN or Inf, the first at index {first}; "
            "mark such lines as missing or repair the reader"
        )
