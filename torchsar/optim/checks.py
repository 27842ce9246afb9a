"""Checks of arguments and objectives, and a norm, shared by the gradient methods."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def check_start(start: Tensor) -> None:
    """Check that the first point of a search is a real tensor of shape (..., n) for n unknowns.

    Args:
        start: First point of the search.

    Raises:
        TypeError: If `start` is neither float32 nor float64.
        ValueError: If `start` has no dimension, or its last dimension, the unknowns, is empty.
    """
    if start.dtype not in (torch.float32, torch.float64):
        raise TypeError(
            f"start must be a tensor of float32 or float64, got {start.dtype}; give complex unknowns "
            "as their real and imaginary parts"
        )
    if start.ndim == 0 or start.shape[-1] == 0:
        raise ValueError(
            "start must have the shape (..., n), with n >= 1 unknowns in the last dimension, got "
            f"shape {tuple(start.shape)}"
        )


def check_limits(method: str, **limits: float) -> None:
    """Check that limits such as the number of steps are positive.

    Args:
        method: Name of the optimiser, for the message.
        **limits: Values by the names of their parameters.

    Raises:
        ValueError: If a value is not positive.
    """
    for name, value in limits.items():
        if not value > 0:
            raise ValueError(f"{method}: {name} is {value}; choose a positive number")


def check_tolerances(method: str, gradient_tolerance: float, value_tolerance: float) -> None:
    """Check that both relative tolerances are at least 0.

    Args:
        method: Name of the optimiser, for the message.
        gradient_tolerance: Relative tolerance of the gradient norm.
        value_tolerance: Relative tolerance of the cost.

    Raises:
        ValueError: If a tolerance is negative or not a number.
    """
    if not (gradient_tolerance >= 0 and value_tolerance >= 0):
        raise ValueError(
            f"{method}: gradient_tolerance and value_tolerance must be relative tolerances of at least 0, "
            f"such as 1e-6, got {gradient_tolerance} and {value_tolerance}"
        )


def check_cost(cost: Any, x: Tensor) -> None:
    """Check that an objective returned one real cost per trial.

    Args:
        cost: Value that the objective returned.
        x: Point at which it was called, shape (..., n).

    Raises:
        ValueError: If the cost is not a real tensor of shape (...,).
    """
    if not isinstance(cost, Tensor) or cost.shape != x.shape[:-1] or not cost.is_floating_point():
        raise ValueError(
            f"the objective returned {described(cost)} for x of shape {tuple(x.shape)}; return one "
            f"real cost per trial, shape {tuple(x.shape[:-1])}"
        )


def described(value: Any) -> str:
    """Describe a value for messages: dtype and shape of a tensor, or the type of another value.

    Args:
        value: Any value.

    Returns:
        A few words for a message.
    """
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else type(value).__name__


def norm(x: Tensor) -> Tensor:
    """Compute the Euclidean norm of each trial over its unknowns.

    Args:
        x: Values, shape (..., n).

    Returns:
        Norms, shape (...,).
    """
    return torch.linalg.vector_norm(x, dim=-1)
