"""What an estimator returns: values, predicted deviations, quality and a verdict, per trial."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Estimate:
    """Result of an estimator; every tensor leads with the trial dims.

    value: unit-suffixed names to tensors, such as {"doppler_hz": (...,)} or {"phase_rad": (...,
    pulse)}; finite even where not ok. std: predicted standard deviation under the same names, where
    theory gives one. quality: (...,) in 0..1. ok: (...,) bool; False marks a trial whose value
    should not be trusted. info: further tensors for reports.
    """

    value: Mapping[str, Tensor]
    quality: Tensor
    ok: Tensor
    std: Mapping[str, Tensor] = field(default_factory=dict)
    info: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.ok.dtype != torch.bool or self.ok.shape != self.quality.shape:
            raise ValueError(
                f"an estimate needs a bool `ok` shaped like `quality`, got {self.ok.dtype} "
                f"{tuple(self.ok.shape)} and {tuple(self.quality.shape)}"
            )

    def __getitem__(self, name: str) -> Tensor:
        """The value of that name; its error names those there are."""
        if name not in self.value:
            raise KeyError(f"estimate holds {tuple(self.value)}, not {name!r}")
        return self.value[name]

    @staticmethod
    def joined(parts: Sequence[Estimate], trials: torch.Size) -> Estimate:
        """One estimate of all trials from those of blocks of them, whose one leading dim is the
        block's.
        """

        def whole(tensors: list[Tensor]) -> Tensor:
            return torch.cat(tensors).unflatten(0, trials) if trials else torch.cat(tensors)[0]

        def named(tables: list[Mapping[str, Tensor]]) -> dict[str, Tensor]:
            return {name: whole([table[name] for table in tables]) for name in tables[0]}

        value, std, info = (named([getattr(part, table) for part in parts]) for table in ("value", "std", "info"))
        return Estimate(value, whole([part.quality for part in parts]), whole([part.ok for part in parts]), std, info)


def settle(value: Tensor, fallback: Tensor | float) -> tuple[Tensor, Tensor]:
    """Replace non-finite entries by a fallback; also says where it was finite.

    Both shaped like value.
    """
    finite = torch.isfinite(value)
    return torch.where(finite, value, torch.as_tensor(fallback, dtype=value.dtype, device=value.device)), finite
