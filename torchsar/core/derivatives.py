"""Declarations of the derivatives that functions have, and a warning of missing derivatives."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.utils import _pytree as pytree

Differentiable = Literal["yes", "where ok", "no"]
Function = TypeVar("Function", bound=Callable[..., Any])


class DerivativeWarning(UserWarning):
    """Warning that a stage or function has no derivatives although a derivative is requested.

    Its results are constants.

    >>> import warnings, torch
    >>> from torchsar.core import DerivativeWarning
    >>> from torchsar.compensate import align_envelopes
    >>> pulses = torch.ones(4, 8, dtype=torch.complex64, requires_grad=True)
    >>> with warnings.catch_warnings(record=True) as shown:
    ...     warnings.simplefilter("always")  # "error" raises an error instead
    ...     found = align_envelopes(pulses)
    >>> shown[0].category.__name__
    'DerivativeWarning'

    Python shows the warning of a stage or function once.
    """


def differentiable(kind: Differentiable) -> Callable[[Function], Function]:
    """Declare, as a decorator, which derivatives the results of a function have.

    Functions that are not decorated have derivatives ("yes"). Those of an estimator exist in trials
    in which it is reliable ("where ok"); elsewhere they are finite. A function without derivatives
    ("no") computes with constants, and gives a `DerivativeWarning` if an argument has a gradient.

    Args:
        kind: "yes", "where ok" or "no".

    Returns:
        The decorator; the function has `kind` as its attribute `differentiable`.
    """

    def declared(function: Function) -> Function:
        @functools.wraps(function)
        def constant(*args: Any, **kwargs: Any) -> Any:
            with without_derivatives(function.__name__, (args, kwargs)) as (args, kwargs):
                return function(*args, **kwargs)

        made: Any = constant if kind == "no" else function
        made.differentiable = kind
        return made

    return declared


@contextmanager
def without_derivatives(name: str, given: Any) -> Iterator[Any]:
    """Within the block, compute with constants, and warn if a derivative is requested.

    Args:
        name: Name of the stage or function for the warning.
        given: Its arguments, a tree of tensors.

    Yields:
        The arguments, without derivatives.
    """
    if is_differentiated(given):
        warnings.warn(
            f"{name} has no derivatives: what it returns is constant, although a derivative by its input is asked for; "
            "detach the input if that is meant, or choose a stage whose `differentiable` is not 'no'",
            DerivativeWarning,
            stacklevel=4,
        )
        given = pytree.tree_map_only(Tensor, Tensor.detach, given)
    with torch.no_grad():
        yield given


def is_differentiated(*given: Any) -> bool:
    """Find out whether a derivative with respect to one of these tensors is requested.

    Args:
        given: Trees of tensors, such as signals, and objects with tensors as attributes.

    Returns:
        True if a tensor requires a gradient (reverse mode) or has a tangent (forward mode).
    """
    leaves = [part for x in pytree.tree_leaves(given) for part in (x, *getattr(x, "__dict__", {}).values())]
    tensors = [x for x in leaves if isinstance(x, Tensor)]
    return any(
        (torch.is_grad_enabled() and x.requires_grad) or forward_ad.unpack_dual(x).tangent is not None for x in tensors
    )
