"""How echoes of scatterers next to each other overlap: the sparse couplings of a joint
least-squares step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.rotation.motion import Sampling
from torchsar.core import linear_phasor
from torchsar.focus.matched_fourier import matched_fourier

# scatterers further apart in Doppler do not couple; steps of the table per cell
_NEAR_CELLS, _TABLE = 64, 16


@dataclass(frozen=True)
class Pairs:
    """Scatterers close enough in Doppler to couple, each with itself among them: trial, first and
    second of each pair (pair,).

    products: for bases n and m, conj(s_p) s_q sum over pulses of b_n b_m conj(e_p) e_q of unit
    echoes e, (pair,), from tables over their distance.
    """

    trial: Tensor
    first: Tensor
    second: Tensor
    shape: torch.Size
    products: Mapping[tuple[int, int], Tensor]

    @staticmethod
    def find(sampling: Sampling, k: Tensor, amplitude: Tensor, cell: Tensor, bases: Tensor) -> Pairs:
        """Of scatterers (trial, scatterer) of this amplitude and Doppler cell; bases: (trial, base,
        pulse), zero in pulses that are not there.
        """
        apart = cell[:, :, None] - cell[:, None]
        live = amplitude != 0
        trial, first, second = ((apart.abs() < _NEAR_CELLS) & live[:, :, None] & live[:, None]).nonzero(as_tuple=True)
        place = apart[trial, first, second] * _TABLE + _NEAR_CELLS * _TABLE
        whole = place.floor().long()
        weight = amplitude[trial, first].conj() * amplitude[trial, second]
        index = [(n, m) for n in range(bases.shape[1]) for m in range(n, bases.shape[1])]
        table = _product_tables(sampling, k, bases, index)
        low, high = table[trial, whole], table[trial, whole + 1]
        values = ((low + (place - whole)[:, None] * (high - low)) * weight[:, None]).unbind(-1)
        products = {pair: value for (n, m), value in zip(index, values) for pair in {(n, m), (m, n)}}
        return Pairs(trial, first, second, cell.shape, products)

    def of(self, values: Tensor, side: int) -> Tensor:
        """A value (trial, scatterer) of the first (0) or second (1) of each pair."""
        return values[self.trial, self.second if side else self.first]

    def matrix(self, blocks: list[list[Tensor]]) -> Tensor:
        """Dense matrix of blocks of values of pairs, (trial, blocks * scatterer, blocks *
        scatterer).
        """
        count, n = self.shape[1], len(blocks)
        result = blocks[0][0].new_zeros(self.shape[0], n * count, n * count)
        for i, row in enumerate(blocks):
            for j, values in enumerate(row):
                result[self.trial, self.first + i * count, self.second + j * count] = values
        return result

    def per_scatterer(self, values: Tensor) -> Tensor:
        """Sums over the second of pairs, (pair, n) -> (trial, scatterer, n)."""
        flat = values.new_zeros(self.shape[0] * self.shape[1], values.shape[-1])
        return flat.index_add(0, self.trial * self.shape[1] + self.first, values).unflatten(0, self.shape)

    def per_trial(self, values: Tensor) -> Tensor:
        """Sums over pairs, (pair, n, m) -> (trial, n, m)."""
        return values.new_zeros(self.shape[0], *values.shape[1:]).index_add(0, self.trial, values)


def _product_tables(sampling: Sampling, k: Tensor, bases: Tensor, index: list[tuple[int, int]]) -> Tensor:
    """Sums over pulses of b_n b_m exp(2j pi c u) at steps of 1 / _TABLE cell c, (trial, step,
    product).
    """
    first, second = (torch.tensor(side, device=bases.device) for side in zip(*index))
    scale = bases.abs().amax(-1, keepdim=True).clamp_min(1e-300)
    unit = bases / scale
    products = (unit[:, first] * unit[:, second]).mT.to(torch.complex128)
    lines = 2 * _NEAR_CELLS * _TABLE + 2
    table = matched_fourier(products, k, sampling.prf_hz, oversampling=_TABLE, lines=lines, taps=6) * math.sqrt(
        sampling.pulses
    )
    return table[:, 1:] * (scale[:, first] * scale[:, second]).mT


def band_response(x: Tensor, cells: int) -> tuple[Tensor, Tensor, Tensor]:
    """Response of range cells to a scatterer x cells away, its band being the `cells` frequencies
    that FFTs make of so many samples, and its first two derivatives.

    x: float64, any shape. The sinc of the signal model, periodic in the window as compressed pulses
    are; complex128, unit peak.
    """
    cycles = (torch.arange(cells, dtype=torch.float64, device=x.device) - cells // 2) / cells
    turn = 2j * math.pi * cycles
    moments = torch.stack([torch.ones_like(turn), turn, turn.square()], -1) / cells
    return tuple((linear_phasor(x / cells, -(cells // 2), cells, torch.complex128) @ moments).unbind(-1))  # pyright: ignore[reportReturnType]
