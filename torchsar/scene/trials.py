"""Parameters that may differ between the trials of a batch: validation and broadcasting.

A constructor parameter annotated `Tensor | float` is a number, equal in all trials, or a tensor of
shape (...,) with one value per trial.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, per_trial

_Class = TypeVar("_Class")


def refuse_unless(sentence: str, value: Tensor | float, within: Callable[[Any], Any], advice: str = "") -> None:
    """Raise ValueError unless every entry of a parameter satisfies a condition.

    Args:
        sentence: Statement of what is expected; the message is "{sentence}, got {offending value};
            {advice}".
        value: Number, or one value per trial, shape (...,).
        within: Condition for a number or, entry by entry, for a tensor.
        advice: What to try instead, empty for no advice.

    Raises:
        ValueError: If an entry violates the condition, the message then holds the first such entry,
            or the value is no number.
    """
    if isinstance(value, float | int) and within(value) is True:
        return
    try:
        x = torch.as_tensor(value, dtype=torch.float64).detach()
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{sentence}, got {value!r}") from None
    good = within(x)
    if bool(good.all()):
        return
    got = f"{value}"
    if isinstance(value, Tensor):
        at = (~good).nonzero()[0].tolist()
        where = f" at index {at[0] if len(at) == 1 else tuple(at)}" if at else ""
        got = f"{float(x.expand(good.shape)[tuple(at)]):g}{where}"
    raise ValueError(f"{sentence}, got {got}" + (f"; {advice}" if advice else ""))


def refuse_unless_finite(what: str, value: Tensor | float | Sequence[Tensor | float], least: float = -math.inf) -> None:
    """Raise ValueError unless every entry of a parameter is finite and not below a limit.

    Args:
        what: Name of the parameter for the message.
        value: Number, one value per trial of shape (...,), or a sequence of such values.
        least: Smallest accepted value.

    Raises:
        ValueError: If an entry is not finite or below `least`.
    """
    if isinstance(value, list | tuple):
        if all(isinstance(entry, float | int) and math.isfinite(entry) and entry >= least for entry in value):
            return
        for entry in value:
            refuse_unless_finite(what, entry, least)
    else:
        bound = "" if least == -math.inf else f" of {least:g} or more"
        sentence = f"{what} must be a finite number{bound}, or one per trial"
        refuse_unless(sentence, value, lambda x: finite(x) & (x >= least))  # type: ignore[arg-type]


def refuse_unless_positive(what: str, value: Tensor | float) -> None:
    """Raise ValueError unless every entry of a parameter is positive and finite.

    Args:
        what: Name of the parameter for the message.
        value: Number, or one value per trial, shape (...,).

    Raises:
        ValueError: If an entry is not finite or not above 0.
    """
    refuse_unless(f"{what} must be a positive number", value, positive)


def finite_numbers(whose: str = "", **limits: float | str | None) -> Callable[[type[_Class]], type[_Class]]:
    """Let a dataclass refuse numbers that are not finite. Write the decorator below `@dataclass`.

    It examines all fields whose annotations name floats, before the `__post_init__` of the class.
    None is accepted only where the annotation of the field names it.

    Args:
        whose: What the class describes, such as "a ship", for messages.
        **limits: By name of a field, its smallest value, "positive" for a value above 0, or None
            for a field that the class examines itself.

    Returns:
        The decorator of the class.
    """

    def decorated(cls: type[_Class]) -> type[_Class]:
        own: Callable[[Any], None] | None = getattr(cls, "__post_init__", None)
        names = [name for name, hint in cls.__annotations__.items() if "float" in hint]

        def examine(self: Any) -> None:
            hints = {field.name: str(field.type) for field in fields(self)}
            for name in names:
                what = f"{name} of {whose}" if whose else f"{type(self).__name__}.{name}"
                if "None" in hints[name] and getattr(self, name) is None:
                    continue
                value, limit = getattr(self, name), limits.get(name, "")
                if hints[name].startswith("Sequence") and not (hasattr(value, "__len__") and getattr(value, "ndim", 1)):
                    raise ValueError(f"{what} must be a sequence of numbers, got {value!r}; put one number in brackets")
                if limit == "positive":
                    refuse_unless_positive(what, value)
                elif limit is not None:
                    refuse_unless_finite(what, value, -math.inf if isinstance(limit, str) else limit)
            if own is not None:
                own(self)

        setattr(cls, "__post_init__", examine)  # noqa: B010
        return cls

    return decorated


def finite(x: Any) -> Any:
    """Return whether a number, or each entry of a tensor, is finite.

    Args:
        x: Number or tensor of any shape.

    Returns:
        bool, or a bool tensor of the shape of x.
    """
    return abs(x) < math.inf


def positive(x: Any) -> Any:
    """Return whether a number, or each entry of a tensor, is positive and finite.

    Args:
        x: Number or tensor of any shape.

    Returns:
        bool, or a bool tensor of the shape of x.
    """
    return (x > 0) & (x < math.inf)


def with_dims(value: Tensor | float, dims: int, like: Tensor) -> Tensor | float:
    """Return a per-trial tensor in a form that broadcasts against data, and a number unchanged.

    Args:
        value: Number, or one value per trial, shape (...,).
        dims: Number of trailing dimensions of the data.
        like: Tensor that gives the device.

    Returns:
        The number itself, or float64 of shape (..., 1, ..., 1) with `dims` trailing dimensions of
        length one.
    """
    if isinstance(value, float | int):
        return value
    value = per_trial(value, 0, like)
    return value[(...,) + (None,) * dims] if value.ndim else value


def either(
    value: Tensor | float, of_number: Callable[[float], float], of_tensor: Callable[[Tensor], Tensor]
) -> Tensor | float:
    """Apply a function to a number, or its torch counterpart to a per-trial tensor.

    Args:
        value: Number, or one value per trial, shape (...,).
        of_number: Function of a number, such as `math.cos`.
        of_tensor: Function of a float64 tensor, such as `torch.cos`.

    Returns:
        A number, or a float64 tensor of shape (...,).
    """
    return of_tensor(value.to(torch.float64)) if isinstance(value, Tensor) else of_number(value)


def stacked(values: Sequence[Tensor | float] | Tensor, device: torch.device | str | None = None) -> Tensor:
    """Stack numbers and per-trial tensors along a new last dimension.

    Args:
        values: Numbers or tensors of shape (...,), one per entry. A single tensor of shape
            (..., entry) counts as already stacked; only its dtype and device are changed.
        device: Device of the result.

    Returns:
        Float64, shape (..., entry).
    """
    if isinstance(values, Tensor):
        return values.to(device, torch.float64)
    if all(isinstance(value, int | float) for value in values):
        return torch.tensor(list(values), dtype=torch.float64, device=device)
    entries = [torch.as_tensor(value, dtype=torch.float64, device=device) for value in values]
    return torch.stack(torch.broadcast_tensors(*entries), -1)


def refuse_other_trials(thing: object, draws: Draws, recording: Recording | None = None) -> None:
    """Raise ValueError if a per-trial parameter does not have one value for each trial.

    The number of trials is that of the recording, or that of the draws if the recording has no
    trials. If neither has trials, all per-trial parameters must have the same length. Parameters
    are found by their annotations in dataclasses, and in the sequences, mappings and dataclasses
    that these hold.

    Args:
        thing: Dataclass with parameters, such as a world or an impairment.
        draws: Random draws of the simulation.
        recording: Recording that an impairment is applied to, None for a world.

    Raises:
        ValueError: If a parameter has neither one value for all trials nor one for each trial.
    """
    drawn = () if draws.trials is None else (len(draws.trials),)
    trials = drawn if recording is None else tuple(recording.signal.trials) or drawn
    shapes = list(_per_trial_shapes(thing))
    for name, shape in shapes:
        if trials and shape and shape[-1] not in (1, trials[-1]):
            whose = "draws" if trials == drawn else "recording"
            raise ValueError(
                f"{name} must be a number or one for each of the {trials[-1]} trials of the {whose}, "
                f"got shape {tuple(shape)}"
            )
    if not trials and len({shape[-1] for _, shape in shapes if shape and shape[-1] != 1}) > 1:
        found = ", ".join(f"{name} {tuple(shape)}" for name, shape in shapes if shape)
        raise ValueError(f"parameters per trial must all have the same number of trials, got the shapes {found}")


def repeated(thing: Any, times: int, behind: int = 0) -> Any:
    """Return an object whose parameters per trial hold each of their entries several times.

    Use the result where each trial of a world is simulated as several rows of a batch, such as one
    row for each of its targets. Parameters are found by their annotations in dataclasses, and in
    the sequences, mappings and dataclasses that these hold.

    Args:
        thing: Dataclass with parameters, a sequence or mapping of such, or a tensor.
        times: Number of rows of each trial.
        behind: Number of the last dimensions of a tensor that are no trials.

    Returns:
        A copy of the object in which each per-trial tensor of shape (trial, ...) has become one of
        shape (trial * times, ...); the rows of a trial follow each other. If there is no per-trial
        tensor, the object itself.
    """
    if isinstance(thing, Tensor):
        return thing.repeat_interleave(times, 0) if thing.ndim > behind else thing
    if not any(shape for _, shape in _per_trial_shapes(thing)):
        return thing
    if isinstance(thing, Mapping):
        return {name: repeated(part, times) for name, part in thing.items()}
    if isinstance(thing, list | tuple):
        return type(thing)(repeated(part, times) for part in thing)
    held = {name: (getattr(thing, name), behind) for name, behind in _parameters(type(thing))}
    return replace(thing, **{name: repeated(value, times, behind) for name, (value, behind) in held.items()})


def _per_trial_shapes(value: object, name: str = "", behind: int = 0) -> Iterator[tuple[str, torch.Size]]:
    """Yield names and trial dimensions of the per-trial parameters of an object and of its parts.

    The last `behind` dimensions of a tensor are not trials.
    """
    if isinstance(value, Tensor):
        yield name, value.shape[: max(0, value.ndim - behind)]
    elif isinstance(value, list | tuple | Mapping):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _per_trial_shapes(part, name)
    elif is_dataclass(value) and not isinstance(value, type):
        for field, dims in _parameters(type(value)):
            yield from _per_trial_shapes(getattr(value, field), f"{field} of {type(value).__name__}", dims)


@cache
def _parameters(kind: type) -> tuple[tuple[str, int], ...]:
    """Fields of a dataclass, each with the number of its last dimensions that are not trials."""
    # A tensor has only trial dimensions if the annotation is `Tensor | float`. With any other
    # annotation, such as `Sequence[Tensor | float] | Tensor`, it has one more dimension. `Any` (an
    # image) is not checked.
    annotations = [(field.name, str(field.type).replace("torch.", "")) for field in fields(kind)]
    return tuple((name, 0 if text.startswith("Tensor | float") else 1) for name, text in annotations if text != "Any")
