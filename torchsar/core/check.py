"""Check that samples are finite."""

from __future__ import annotations

import torch
from torch import Tensor


def refuse_non_finite(
    x: Tensor, what: str, advice: str = "set missing samples to zero, or correct the code that reads the data"
) -> None:
    """Raise ValueError if samples are NaN or infinite.

    For valid data the check takes the time of one sum over the samples. It has no effect inside
    torch.vmap, where values cannot be read.

    Args:
        x: Samples of any shape, real or complex.
        what: Name of the samples for the message.
        advice: What to do about such samples, for the message.

    Raises:
        ValueError: If a sample is NaN or infinite; the message has the number of such samples and
            the index of the first.
    """
    try:
        total = torch.view_as_real(x.detach()).sum() if x.is_complex() else x.detach().sum()
        if bool(torch.isfinite(total)):
            return
        bad = ~torch.isfinite(x.detach())
        count = int(bad.sum())
    except RuntimeError:  # inside vmap values cannot be read
        return
    if count:
        first = tuple(int(i) for i in bad.nonzero()[0])
        raise ValueError(f"{what}: {count} of {x.numel()} samples are NaN or Inf, the first at index {first}; {advice}")
