"""Inner products of the echoes of neighbouring scatterers, for joint least-squares estimation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.rotation.motion import Sampling
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.transforms import Gridding

# Doppler cells beyond which the coupling of scatterers is neglected, found by trial: accuracy of a
# step against time
_NEAR_CELLS = 64
# added, relative, to what a scatterer tells about itself and the rotation: the curvature stays
# positive definite where scatterers nearly cancel each other, and one alone is damped by no more
_RIDGE = 1e-3
_TABLE = 16  # steps of the table per Doppler cell, enough for linear interpolation


@dataclass(frozen=True)
class Pairs:
    """Pairs of neighbouring scatterers, with the inner products of their echoes.

    A pair consists of two scatterers of one trial that lie less than 64 Doppler cells apart. Each
    scatterer also forms a pair with itself.

    Args:
        trial: Trial of each pair, shape (pair,).
        first: Index p of the first scatterer of each pair, shape (pair,).
        second: Index q of the second scatterer of each pair, shape (pair,).
        shape: Shape (trial, scatterer) of tensors with one value per scatterer.
        products: Inner products of the echoes over slow time, weighted with basis functions b_0,
            b_1, ... of slow time. The entry (n, m), shape (pair,), is the sum over pulses of b_n
            b_m conj(s_p e_p) s_q e_q, where s is the amplitude of a scatterer and e its echo of
            unit amplitude, and is 0.1 % larger for a scatterer with itself.
    """

    trial: Tensor
    first: Tensor
    second: Tensor
    shape: torch.Size
    products: Mapping[tuple[int, int], Tensor]

    @staticmethod
    def find(sampling: Sampling, k: Tensor, amplitude: Tensor, cell: Tensor, bases: Tensor) -> Pairs:
        """Find the pairs of scatterers less than 64 Doppler cells apart, and their inner products.

        Args:
            sampling: Sampling of the data.
            k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s,
                1/s^2, ..., shape (trial, order - 1).
            amplitude: Amplitudes, shape (trial, scatterer), complex; 0 where there is no scatterer.
            cell: Doppler of the scatterers in Doppler cells, shape (trial, scatterer).
            bases: Basis functions of slow time, shape (trial, base, pulse); zero in missing pulses.

        Returns:
            The pairs with their inner products.
        """
        separation = cell[:, :, None] - cell[:, None]
        used = amplitude != 0
        trial, first, second = ((separation.abs() < _NEAR_CELLS) & used[:, :, None] & used[:, None]).nonzero(
            as_tuple=True
        )
        position = separation[trial, first, second] * _TABLE + _NEAR_CELLS * _TABLE
        # a separation just below the limit rounds to the last entry
        whole = position.floor().long().clamp_max(2 * _NEAR_CELLS * _TABLE - 1)
        weight = amplitude[trial, first].conj() * amplitude[trial, second] * (1 + _RIDGE * (first == second))
        index = [(n, m) for n in range(bases.shape[1]) for m in range(n, bases.shape[1])]
        table = _product_tables(sampling, k, bases)
        low, high = table[trial, whole], table[trial, whole + 1]
        values = ((low + (position - whole)[:, None] * (high - low)) * weight[:, None]).unbind(-1)
        products = {pair: value for (n, m), value in zip(index, values) for pair in {(n, m), (m, n)}}
        return Pairs(trial, first, second, cell.shape, products)

    def of(self, values: Tensor, side: int) -> Tensor:
        """Select the value of the first or of the second scatterer of each pair.

        Args:
            values: One value per scatterer, shape (trial, scatterer).
            side: 0 for the first scatterer, 1 for the second.

        Returns:
            The values, shape (pair,).
        """
        return values[self.trial, self.second if side else self.first]

    def matrix(self, blocks: list[list[Tensor]]) -> Tensor:
        """Assemble a matrix of blocks, each of which has one entry for each pair of scatterers.

        Args:
            blocks: The blocks, as a list of n rows of n blocks. A block is given by the entries of
                its pairs, shape (pair,): that of a pair (p, q) stands in row p and column q of the
                block.

        Returns:
            The matrix, shape (trial, n * scatterer, n * scatterer); zero where two scatterers do
            not form a pair.
        """
        count, n = self.shape[1], len(blocks)
        result = blocks[0][0].new_zeros(self.shape[0], n * count, n * count)
        for i, row in enumerate(blocks):
            for j, values in enumerate(row):
                result[self.trial, self.first + i * count, self.second + j * count] = values
        return result

    def per_scatterer(self, values: Tensor) -> Tensor:
        """Sum values of pairs over all pairs with the same first scatterer.

        Args:
            values: Values per pair, shape (pair, n).

        Returns:
            The sums for each first scatterer, shape (trial, scatterer, n).
        """
        flat = values.new_zeros(self.shape[0] * self.shape[1], values.shape[-1])
        return flat.index_add(0, self.trial * self.shape[1] + self.first, values).unflatten(0, self.shape)

    def per_trial(self, values: Tensor) -> Tensor:
        """Sum values of pairs over all pairs of a trial.

        Args:
            values: Values per pair, shape (pair, n, m).

        Returns:
            The sums, shape (trial, n, m).
        """
        return values.new_zeros(self.shape[0], *values.shape[1:]).index_add(0, self.trial, values)


def _product_tables(sampling: Sampling, k: Tensor, bases: Tensor) -> Tensor:
    """Sums over pulses of b_n b_m exp(2j pi c u), m >= n, (trial, step, product).

    The steps are 1 / _TABLE of a Doppler cell c.
    """
    first, second = torch.triu_indices(bases.shape[1], bases.shape[1], device=bases.device)
    scale = bases.abs().amax(-1, keepdim=True).clamp_min(1e-300)
    unit = bases / scale
    products = (unit[:, first] * unit[:, second]).mT.to(torch.complex128)
    lines = 2 * _NEAR_CELLS * _TABLE + 2
    table = matched_fourier(
        products, k, sampling.prf_hz, lines=DopplerLines(_TABLE, lines), transform=Gridding(6)
    ) * math.sqrt(sampling.pulses)
    return table[:, 1:] * (scale[:, first] * scale[:, second]).mT
