"""Result of an estimator: values, standard deviations, quality and reliability in each trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchsar.core.arguments import names_arguments
from torchsar.core.show import Shown, Summary, content, one_number


@names_arguments
@dataclass(frozen=True, repr=False)
class Estimate(Shown):
    """Estimated values with their predicted accuracy and their reliability in each trial.

    All tensors begin with the trial dimensions (...). A trial in which the estimation fails raises
    no error: `ok` is False there, and the values are finite. A Chain then passes on a neutral value
    in place of the estimated one, see `trusted`.

    Args:
        value: Estimated values by name. Names end in the unit, such as `doppler_hz` of shape (...,)
            or `phase_rad` of shape (..., pulse). Finite even where `ok` is False.
        quality: Quality from 0 (unusable) to 1, shape (...,); each estimator defines how it is
            measured.
        ok: Bool, shape (...,); False where the estimate is unreliable.
        std: Predicted standard deviations, with the names, shapes and units of the values; only for
            those values whose standard deviation theory predicts.
        info: Further tensors by name, for reports.
        neutral: Neutral values by name: what to assume where `ok` is False, such as no phase error
            or the nominal velocity. Numbers, or tensors that broadcast to the value. A stage fills
            it in, see `Stage`.

    Raises:
        TypeError: If `value` or `std` is not a mapping of tensors.
        ValueError: If `ok` is not a bool tensor with the shape of `quality`, or a standard
            deviation does not have the name and the shape of a value.
    """

    value: Mapping[str, Tensor]
    quality: Tensor
    ok: Tensor
    std: Mapping[str, Tensor] = field(default_factory=dict)
    info: Mapping[str, Tensor] = field(default_factory=dict)
    neutral: Mapping[str, Tensor | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.ok.dtype != torch.bool or self.ok.shape != self.quality.shape:
            raise ValueError(
                f"an Estimate needs a bool tensor `ok` of the shape of `quality`, got `ok` of {self.ok.dtype} with "
                f"shape {tuple(self.ok.shape)} and `quality` with shape {tuple(self.quality.shape)}"
            )
        for field_name, table in (("value", self.value), ("std", self.std)):
            if not isinstance(table, Mapping) or not all(isinstance(x, Tensor) for x in table.values()):
                got = (
                    {k: type(x).__name__ for k, x in table.items()}
                    if isinstance(table, Mapping)
                    else type(table).__name__
                )
                raise TypeError(f"an Estimate needs tensors by name in `{field_name}`, got {got}")
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

    def trusted(self, name: str) -> Tensor:
        """Return a value with the neutral one in its place where `ok` is False.

        Differentiable; the gradient is zero where `ok` is False.

        Args:
            name: Name of the value.

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
        return torch.where(self.ok[(...,) + (None,) * (value.ndim - self.ok.ndim)], value, neutral)

    @property
    def _verdict(self) -> str:
        """Number of trials in which the estimate is ok, as words, such as "ok in 3 of 4"."""
        count = one_number(self.ok.sum())
        return f"ok of shape {tuple(self.ok.shape)}" if count is None else f"ok in {count} of {self.ok.numel()}"

    def _summary(self) -> Summary:
        std = {name: f"standard deviation {content(value)}" for name, value in self.std.items()}
        values = [(name, content(value), std.get(name, "")) for name, value in self.value.items()]
        return Summary(f"{self._verdict}, {self.ok.device}", {"values": values})

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
        return Estimate(value, whole([part.quality for part in parts]), whole([part.ok for part in parts]), std, info)


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
