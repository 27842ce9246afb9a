"""Base class of all processing stages."""

from __future__ import annotations

import functools
import inspect
import textwrap
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core.derivatives import Differentiable, without_derivatives
from torchsar.core.estimate import Estimate
from torchsar.core.host import check_value, checked_samples, gathered_checks, refuse_non_finite_values
from torchsar.core.kinds import fitted
from torchsar.core.show import argument
from torchsar.core.signal import Signal


class Stage(nn.Module):
    """Base class of a processing stage, which checks axes and samples before `forward` runs.

    >>> import torch
    >>> from torchsar import Axis, Signal, Stage
    >>> class Attenuate(Stage):
    ...     works_on = ("range",)
    ...     def forward(self, signal, gain_db=-20.0):
    ...         return signal.with_data(signal.data * 10 ** (gain_db / 20))
    >>> line = Signal(torch.ones(2, dtype=torch.complex64), (Axis("range", 2, 0.0, 1.0, "m"),))
    >>> Attenuate()(line).data.abs()
    tensor([0.1000, 0.1000])

    `stage(signal, **values)` returns a Signal, an Estimate (the signal is then unchanged), or a
    pair of both. A Chain can connect keyword parameters of `forward` to values that earlier stages
    estimate. A subclass holds its constants as buffers and its tunable values as nn.Parameters (see
    `hold`), and sets the following attributes:

    - `works_on`: names of the trailing axes that it needs.
    - `also_on`: further tuples of axes that it accepts.
    - `provides`: names of the values in its Estimate.
    - `neutral`: for each of them the number to assume in trials in which the estimate failed: one
      without effect (a phase of 0, a gain of 1), or a nominal one. If there is none, a sentence
      that says why; the estimated value is then used in all trials.
    - `takes_real`: True if it also accepts the real samples of a one-channel detector.
    - `fixed`: names of values on whose numbers the plan of the computation depends. torch.compile
      makes constants of them, and the program raises RuntimeError if they change.
    - `differentiable`: "yes"; "where ok", for an estimator whose value has derivatives in trials in
      which it is reliable; or "no": it computes with constants, and gives a `DerivativeWarning` if
      its input has a gradient.
    - `takes_empty`: False if it refuses a batch without trials. Otherwise the result is empty, or a
      function that it calls refuses the batch.

    If a constructor fails with an error of Python, a note of the error names its parameters and the
    arguments given.

    If a value that the stage provides is also one of the arguments of the call, such as a start or
    a value known a priori, this argument is the neutral value.

    Raises:
        TypeError: On a call, if the argument is not a Signal, or if the samples are neither
            complex64 or complex128 nor, with `takes_real`, float32 or float64.
        ValueError: On a call, if the axes do not fit, the signal has no samples, or a sample or a
            value is not finite; of many stages, also if it has no trials.
    """

    works_on: tuple[str, ...] = ("pulse", "range")
    also_on: tuple[tuple[str, ...], ...] = ()
    provides: tuple[str, ...] = ()
    neutral: Mapping[str, Tensor | float | str] = MappingProxyType({})
    takes_real: bool = False
    takes_empty: bool = True
    fixed: tuple[str, ...] = ()
    differentiable: Differentiable = "yes"

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            cls.__init__ = _explained(cls.__init__)

    @classmethod
    def of(cls, function: Callable[..., Any], **attributes: Any) -> type[Stage]:
        """Make a stage of a function of samples.

        >>> import torch
        >>> from torchsar import Axis, Chain, Signal, Stage, use
        >>> def scale(data, factor, power=1.0):
        ...     return data * factor**power
        >>> Scale = Stage.of(scale, works_on=("range",))
        >>> line = Signal(torch.ones(2, dtype=torch.complex64), (Axis("range", 2, 0.0, 1.0, "m"),))
        >>> Scale(power=2.0)(line, factor=torch.tensor(3.0)).data.real
        tensor([9., 9.])
        >>> louder = Chain(louder=use(Scale(), factor="given.f"))
        >>> louder(line, {"given.f": torch.tensor(2.0)}).data.real
        tensor([2., 2.])

        The first parameter of the function takes the samples. Parameters with a default, and those
        that are annotated as no tensor, such as a radar, are those of the constructor; the others
        are values of the call, which a chain connects by `use`, as it can those not given to the
        constructor. A tensor that the function returns holds the new samples; an Estimate may
        follow it.

        Args:
            function: Function of samples, shape (..., and the axes), which returns samples, an
                Estimate, or both.
            **attributes: Attributes of the stage, such as `works_on` and `provides`.

        Returns:
            The class of the stage; its name is that of the function without underscores.
        """
        known = inspect.signature(function)
        accepted = list(known.parameters.values())[1:]

        def forward(self: Any, signal: Signal, *args: Any, **values: Any) -> Any:
            held = {name: getattr(self, name) for name in self.constants}
            found = function(signal.data, *args, **{**held, **values})
            data, *rest = found if isinstance(found, tuple) else (found,)
            made = signal.with_data(data.contiguous()) if isinstance(data, Tensor) else data
            return (made, *rest) if rest else made

        def fixed(p: inspect.Parameter) -> bool:
            return p.default is not p.empty or (p.annotation is not p.empty and "Tensor" not in str(p.annotation))

        constructor = inspect.Signature([p for p in accepted if fixed(p)])

        def init(self: Any, *args: Any, **constants: Any) -> None:
            super(made, self).__init__()
            self.constants = constructor.bind(*args, **constants).arguments
            self.connects = [p for p in accepted if p.name not in self.constants]
            for name, value in self.constants.items():
                held = isinstance(value, Tensor) and not isinstance(value, nn.Parameter)
                (self.register_buffer if held else functools.partial(setattr, self))(name, value)

        init.__annotations__, init.__wrapped__ = function.__annotations__, function  # pyright: ignore
        called = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("self", "signal")]
        returned = Signal if known.return_annotation in (Tensor, "Tensor", "torch.Tensor") else known.return_annotation
        forward.__annotations__["return"] = returned
        forward.__signature__ = inspect.Signature([*called, *accepted], return_annotation=returned)  # pyright: ignore
        init.__signature__ = inspect.Signature([called[0], *constructor.parameters.values()])  # pyright: ignore
        about = f"Stage of `{function.__name__}`.\n\n{inspect.getdoc(function) or ''}"
        attributes = {"differentiable": getattr(function, "differentiable", "yes"), **attributes}
        attributes |= {"__init__": init, "forward": forward, "__signature__": constructor}
        attributes |= {"__doc__": about, "__module__": function.__module__}
        made = type("".join(map(str.capitalize, function.__name__.split("_"))), (cls,), attributes)
        return made

    def __call__(self, signal: Signal, *args: Any, **values: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():
            # local import: it loads torch._dynamo, which takes seconds
            from torchsar.core.compiled import call_as_one

            return call_as_one(self, (signal, *args), values)
        with gathered_checks():
            return self._called(signal, *args, **values)

    def _called(self, signal: Signal, *args: Any, **values: Any) -> Any:
        """Check the arguments of a call and run `forward`."""
        name = type(self).__name__
        if not isinstance(signal, Signal):
            wrap = "wrap the tensor: Signal(data, radar.raw_axes(lines, samples))"
            hint = "pass its signal: recording.signal" if hasattr(signal, "signal") else wrap
            raise TypeError(
                f"{name} works on a Signal with the axes {self.works_on}, got {type(signal).__name__}; {hint}"
            )
        if signal.names not in (self.works_on, *self.also_on):
            raise ValueError(
                f"{name} works on the axes {' or '.join(map(str, (self.works_on, *self.also_on)))}, got {signal.names}"
            )
        data = checked_samples(signal.data, name, ", ".join(signal.names), real=self.takes_real, empty=self.takes_empty)
        refuse_non_finite_values(name, **{f"argument {i}": value for i, value in enumerate(args, 2)}, **values)
        given: Any = (signal if data is signal.data else signal.with_data(data), *args), values
        constant = self.differentiable == "no"
        with without_derivatives(name, given) if constant else nullcontext(given) as (args, values):
            result = super().__call__(*args, **values)
        if isinstance(result, Estimate):
            return self._with_neutral(self._checked(result, signal.trials), values)
        if isinstance(result, tuple) and isinstance(result[-1], Estimate):
            return (*result[:-1], self._with_neutral(self._checked(result[-1], signal.trials), values))
        return result

    def _checked(self, estimate: Estimate, trials: torch.Size) -> Estimate:
        """Return an estimate after a check of its names, its trials and its quality."""
        name, shape, n = type(self).__name__, estimate.outcome.shape, len(trials)
        if self.provides and not set(self.provides) & set(estimate.value):
            raise ValueError(f"{name} provides {self.provides}, but its Estimate has only {list(estimate.value)}")
        if trials not in [shape[first : first + n] for first in range(len(shape) - n + 1)]:
            raise ValueError(
                f"{name} estimates for the trials {tuple(trials)} of the signal, but the outcome of its Estimate has "
                f"the shape {tuple(shape)}; reduce over the dimensions of the samples only"
            )

        def refuse(least: float, largest: float) -> None:
            if least < 0 or largest > 1:
                raise ValueError(f"{name}: the quality of an Estimate lies from 0 to 1, got {least:g} to {largest:g}")

        # a wait for the device, which estimators of torchsar need not cause
        if estimate.quality.numel() and not type(self).__module__.startswith("torchsar."):
            check_value(torch.stack([estimate.quality.min(), estimate.quality.max()]), refuse)
        return estimate

    def _with_neutral(self, estimate: Estimate, given: Mapping[str, Any]) -> Estimate:
        """Add the neutral values of the stage to an estimate, one for each value that has one."""
        numbers = {key: value for key, value in self.neutral.items() if not isinstance(value, str)}
        known = {key: value for key, value in given.items() if value is not None}
        neutral = {**numbers, **known, **estimate.neutral}
        return replace(estimate, neutral={key: neutral[key] for key in estimate.value if key in neutral})

    def __repr__(self) -> str:
        of = self.extra_repr() if "_given" in vars(self) else ""
        return f"{type(self).__name__}({vars(self).get('_given', '')}){of and f' of {of}'}"

    def hold(self, name: str, value: Tensor | float) -> None:
        """Register a value of the stage as its attribute, tunable or constant.

        Args:
            name: Name of the attribute.
            value: nn.Parameter, which stays tunable, or a number or tensor, which becomes a
                constant float64 buffer.
        """
        if isinstance(value, nn.Parameter):
            self.register_parameter(name, value)
        else:
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))


def _explained(init: Callable[..., None]) -> Callable[..., None]:
    """Wrap the constructor of a stage so that its errors have a note with parameters and
    arguments, and that its representation shows the arguments.
    """

    @functools.wraps(init)
    def explained(self: Any, *args: Any, **kwargs: Any) -> None:
        if type(self).__init__ is explained:
            (_, *fit), kwargs = fitted(init, type(self).__name__, (self, *args), kwargs)
            args = tuple(fit)
        try:
            init(self, *args, **kwargs)
        except (TypeError, AttributeError) as error:
            if "before Module.__init__() call" in str(error):  # in the words of torch
                raise TypeError(f"{type(self).__name__}.__init__ must call super().__init__() first") from error
            # no note from a base class, which is called with other arguments
            if type(self).__init__ is explained:
                given = textwrap.shorten(f"{args} and {kwargs}", 200)
                error.add_note(f"{type(self).__name__}{inspect.signature(type(self))} was given {given}")
            raise
        if "_modules" not in vars(self):
            raise TypeError(f"{type(self).__name__}.__init__ must call super().__init__() first")
        if type(self).__init__ is explained:
            names = list(inspect.signature(type(self)).parameters)
            given = {**dict(zip(names, args)), **kwargs}
            self._given = ", ".join(f"{name}={argument(value)}" for name, value in given.items())

    return explained
