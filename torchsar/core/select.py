"""Selection by trial: broadcasting, gathering and the choice of the best candidate in a batch."""

from __future__ import annotations

import torch
from torch import Tensor


def numbers_on(device: torch.device | str | None, *numbers: float) -> Tensor:
    """Return a tensor of a few numbers without a copy from the host, which waits for the device.

    Args:
        device: Device of the result.
        *numbers: The numbers.

    Returns:
        The numbers, shape (number,), float64.
    """
    if torch.device(device or "cpu").type == "cpu" or not numbers:
        return torch.tensor(numbers, dtype=torch.float64, device=device)
    return torch.stack([torch.full((), number, dtype=torch.float64, device=device) for number in numbers])


def per_trial(value: Tensor | float, trailing: int, like: Tensor) -> Tensor:
    """Append dimensions of length one to values per trial, so that they broadcast against data.

    >>> import torch
    >>> from torchsar.core import per_trial
    >>> data = torch.ones(2, 4, 8)  # trials, pulses, range cells
    >>> (data * per_trial(torch.tensor([1.0, 3.0]), 2, data))[:, 0, 0]
    tensor([1., 3.], dtype=torch.float64)

    Args:
        value: Number, or one value per trial, shape (...,).
        trailing: Number of dimensions of the data after the trial dimensions.
        like: Tensor on whose device the result is placed.

    Returns:
        The values in float64, shape (..., 1, ..., 1) with `trailing` dimensions of length one at
        the end.
    """
    if isinstance(value, (int, float)):
        return torch.full((1,) * trailing, value, dtype=torch.float64, device=like.device)
    value = torch.as_tensor(value, dtype=torch.float64, device=like.device)
    return value[(...,) + (None,) * trailing]


def true_positions(mask: Tensor, count: int) -> Tensor:
    """Return the positions of the elements of a mask that are True, whose number is known.

    Unlike `torch.nonzero` it does not wait for the device.

    Args:
        mask: Mask, shape (n,), bool.
        count: Number of elements that are True.

    Returns:
        Their positions in rising order, shape (count,), int64.
    """
    return mask.to(torch.uint8).sort(descending=True, stable=True).indices[:count]


def take(x: Tensor, index: Tensor, dim: int = -1) -> Tensor:
    """Take the element at one index per trial along a dimension.

    >>> import torch
    >>> from torchsar.core import take
    >>> take(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), torch.tensor([0, 1]))  # one index per trial
    tensor([1., 4.])

    Args:
        x: Tensor with the dimension `dim`, any shape.
        index: Indices, int64, with the shape of the dimensions of x before `dim`.
        dim: Dimension to select from.

    Returns:
        Tensor with the shape of x without `dim`.
    """
    dim = dim % x.ndim
    shape = index.shape + (1,) * (x.ndim - index.ndim)
    expanded = index.reshape(shape).expand(*x.shape[:dim], 1, *x.shape[dim + 1 :])
    return x.gather(dim, expanded).squeeze(dim)


def best_of(costs: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
    """Choose the candidate of lowest cost in each trial.

    Args:
        costs: Cost of each candidate, shape (candidate, ...).
        candidates: Values of the candidates, shape (candidate, ...).

    Returns:
        The best candidate, shape (...,), and the difference between the second-lowest and the
        lowest cost, which is infinite if there is only one candidate.
    """
    order = costs.argsort(dim=0)
    value = take(candidates.movedim(0, -1), order[0])
    if costs.shape[0] < 2:
        return value, torch.full_like(costs[0], torch.inf)
    ranked = costs.gather(0, order[:2])
    return value, ranked[1] - ranked[0]
