"""How many pulse rates the Doppler of a moving point exceeds its samples by, from its walk through
range: what the channels cannot say.

One ambiguity is lambda PRF of slant-range velocity, which walks through lambda PRF T metres of
range: far more than a range cell. The number with which the migration is taken out gathers the
point in one line. Source: brief 001, Velocity (unambiguous interval).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Estimate, Signal, Stage, best_of
from torchsar.multichannel.migration import Frame, Keystone, Migration, correct_migration
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.radar import BistaticRadar

_TINY = torch.finfo(torch.float64).tiny


def walk_ambiguity(
    data: Tensor, frame: Frame, reference: PointMotion, most: int = 2, migration: Migration | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The number of -most..most with which the strongest point of each trial stands still.

    data: (..., channel, pulse, range), range compressed, transmit range removed.

    Returns (ambiguity, contrast, line), each (...,): the whole number, float64; how far, in
    deviations of what noise does, its strongest line stands above that of the next best number; the
    index of its line. Judged by the energy of the strongest line, so that neither phase nor
    aliasing matter.
    """
    numbers = torch.arange(-most, most + 1, dtype=torch.float64, device=data.device)
    energies = torch.stack(
        [
            _line_energy(correct_migration(data, frame, reference, migration or Keystone(whole_swath=False), number))
            for number in numbers
        ]
    )
    strongest, line = energies.max(-1)
    best, margin = best_of(-strongest, numbers[(...,) + (None,) * (strongest.ndim - 1)].expand(strongest.shape))
    deviation = _typical_deviation(energies[most])
    return best, margin / deviation, line.gather(0, (best + most).long()[None])[0]


def _line_energy(data: Tensor) -> Tensor:
    return data.abs().to(torch.float64).square().sum((-3, -2))


def _typical_deviation(energy: Tensor) -> Tensor:
    """Deviation of the energies of lines (..., range) that hold noise alone, by their median."""
    middle = energy.median(-1, keepdim=True).values
    return (1.4826 * (energy - middle).abs().median(-1).values).clamp_min(1e-12 * middle[..., 0]).clamp_min(_TINY)


class WalkAmbiguity(Stage):
    """`walk_ambiguity` as an estimator of `ambiguity`, what `CorrectMigration` takes.

    most: pulse rates to either side; range_m: of the reference, None for the radar's.

    ok: the best number stands out by five deviations of noise. With a wrong number a point keeps
    the walk of so many pulse rates.
    """

    works_on = ("channel", "pulse", "range")
    provides = ("ambiguity",)

    def __init__(self, radar: BistaticRadar, most: int = 2, range_m: float | None = None) -> None:
        super().__init__()
        if most < 1:
            raise ValueError(f"a search for the ambiguity number needs most of 1 or more, got {most}")
        self.radar, self.most, self.range_m = radar, most, range_m

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Estimate:
        reference = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        number, contrast, line = walk_ambiguity(signal.data, Frame.of(self.radar, signal), reference, self.most)
        return Estimate(
            {"ambiguity": number},
            contrast / (5 + contrast),
            contrast > 5,
            info={"line": line.to(torch.float64), "contrast": contrast},
        )
