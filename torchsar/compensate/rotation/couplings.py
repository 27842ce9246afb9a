"""Range responses of scatterers, and inner products of the echoes of neighbouring ones.

The band of the pulses is flat and fills the sampled band. Two responses are then possible, and they
agree near their peak. Where a pulse of finite length is compressed as a whole, the response is a
sinc, whose side lobes leave the range window. Where the window is a Fourier transform of as many
samples as it has cells, the side lobes return at the other end of the window. Cropped windows lie
between the two. The response of a recording is therefore described as a mixture of the two, and
the share of the periodic one is found from the data.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.rotation.motion import Sampling
from torchsar.core import cis
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.transforms import Gridding

# _NEAR_CELLS: Doppler separation beyond which the coupling of scatterers is neglected, a compromise
# between the accuracy of a step and time found by trial.
# _TABLE: steps of the table per Doppler cell, enough for linear interpolation.
_NEAR_CELLS, _TABLE = 64, 16


@dataclass(frozen=True)
class Neighbours:
    """Pairs of scatterers of one trial that are neighbours in Doppler, or may become so.

    They lie less than 69 Doppler cells apart. Each scatterer also forms a pair with itself.

    Args:
        trial: Trial of each pair, shape (pair,).
        first: Index p of the first scatterer of each pair, shape (pair,).
        second: Index q of the second scatterer of each pair, shape (pair,).
        shape: Shape (trial, scatterer) of tensors with one value per scatterer.
    """

    trial: Tensor
    first: Tensor
    second: Tensor
    shape: torch.Size

    @staticmethod
    def find(amplitude: Tensor, cell: Tensor) -> Neighbours:
        """Find the pairs. The host waits for the device once.

        Args:
            amplitude: Amplitudes, shape (trial, scatterer), complex; 0 where there is no scatterer.
            cell: Doppler of the scatterers in Doppler cells, shape (trial, scatterer).

        Returns:
            The pairs. The last columns without a scatterer in any trial, but not the first column,
            are left out of `shape`.
        """
        used, n = amplitude != 0, cell.shape[1]
        # Pairs up to 5 cells farther apart are included, because they may come closer in later
        # steps. In each of seven steps a scatterer moves by at most 0.3 cells.
        near = (cell[:, :, None] - cell[:, None]).abs() < _NEAR_CELLS + 5
        near = (near & used[:, :, None] & used[:, None]).flatten()
        number = torch.arange(1, n + 1, device=cell.device)
        pairs, width = torch.stack([near.sum(), (used * number).amax()]).tolist() if len(near) else (0, 0)
        # indices where `near` is true; all other indices are written to one additional entry, which
        # is dropped
        place = torch.where(near, near.cumsum(0) - 1, pairs)
        every = torch.arange(len(near), device=cell.device)
        index = every.new_empty(pairs + 1).scatter_(0, place, every)[:pairs]
        return Neighbours(
            index // (n * n), index // n % n, index % n, torch.Size([cell.shape[0], min(n, max(1, width))])
        )

    def per_scatterer(self, values: Tensor) -> Tensor:
        """Sum values of pairs over all pairs with the same first scatterer.

        Args:
            values: Values per pair, shape (pair, n).

        Returns:
            The sums for each first scatterer, shape (trial, scatterer, n).
        """
        flat = values.new_zeros(self.shape[0] * self.shape[1], values.shape[-1])
        return flat.index_add(0, self.trial * self.shape[1] + self.first, values).unflatten(0, self.shape)


def envelopes(share: Tensor, row: Tensor, cells: int) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the responses to scatterers in all range cells.

    Args:
        share: Share of the periodic response, from 0 to 1, shape (trial,), float64; the rest is
            that of a sinc.
        row: Range of the scatterers in range cells, shape (trial, scatterer), float64.
        cells: Number of range cells of the window.

    Returns:
        The response in each range cell, of unit peak, its derivative with respect to the range of
        the scatterer in cells, and that with respect to the share; shape (trial, scatterer, range)
        each, complex128.
    """
    cell = torch.arange(cells, dtype=row.dtype, device=row.device)
    x = cell - row[..., None]
    sinc, near = torch.sinc(x), x.abs() < 1e-4
    # near the peak the slope follows from its series: the error of either form is below 1e-10
    slope = torch.where(near, math.pi**2 / 3 * x, (sinc - torch.cos(math.pi * x)) / torch.where(near, 1, x))
    # the periodic response is the mean of the exponentials of as many FFT frequencies as there are
    # samples
    frequency = 2 * math.pi * (cell - cells // 2) / cells
    phasor, lines = cis(row[..., None] * -frequency) / cells, cis(torch.outer(frequency, cell))
    periodic = phasor @ lines
    difference = periodic - sinc
    weight = share[:, None, None]
    of_periodic = (phasor * (-1j * frequency)) @ lines
    return sinc + weight * difference, slope + weight * (of_periodic - slope), difference


def inner_products(
    near: Neighbours, sampling: Sampling, k: Tensor, amplitude: Tensor, cell: Tensor, bases: Tensor
) -> Mapping[tuple[int, int], Tensor]:
    """Compute the inner products of the echoes of neighbouring scatterers over slow time.

    They are weighted with basis functions b_0, b_1, ... of slow time.

    Args:
        near: The pairs of scatterers.
        sampling: Sampling of the data.
        k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s, 1/s^2,
            ..., shape (trial, order - 1).
        amplitude: Amplitudes, shape (trial, scatterer), complex; 0 where there is no scatterer.
        cell: Doppler of the scatterers in Doppler cells, shape (trial, scatterer).
        bases: Basis functions of slow time, shape (trial, base, pulse); zero in missing pulses.

    Returns:
        For each key (n, m), the sum over pulses of b_n b_m conj(s_p e_p) s_q e_q for each pair (p,
        q), shape (pair,). Here s is the amplitude of a scatterer and e its echo of unit amplitude.
        It is 0.1 % larger for a scatterer with itself, and 0 where two scatterers lie 64 Doppler
        cells or more apart.
    """
    separation = cell[near.trial, near.first] - cell[near.trial, near.second]
    coupled = separation.abs() < _NEAR_CELLS
    position = torch.where(coupled, separation, 0) * _TABLE + _NEAR_CELLS * _TABLE
    # a separation just below the limit may be rounded to an index beyond the last entry
    whole = position.floor().long().clamp_max(2 * _NEAR_CELLS * _TABLE - 1)
    weight = amplitude[near.trial, near.first].conj() * amplitude[near.trial, near.second]
    # The product of a scatterer with itself is increased by 0.1 %. The curvature then remains
    # positive definite where scatterers nearly cancel, and the step of a single scatterer is
    # reduced by 0.1 % only.
    weight = torch.where(coupled, weight * (1 + 1e-3 * (near.first == near.second)), 0)
    index = [(n, m) for n in range(bases.shape[1]) for m in range(n, bases.shape[1])]
    # sums over pulses of b_n b_m exp(2j pi c u), m >= n, at steps of 1 / _TABLE of a Doppler cell c
    first, second = torch.triu_indices(bases.shape[1], bases.shape[1], device=bases.device)
    scale = bases.abs().amax(-1, keepdim=True).clamp_min(1e-300)
    unit = bases / scale
    products = (unit[:, first] * unit[:, second]).mT.to(torch.complex128)
    lines = DopplerLines(_TABLE, 2 * _NEAR_CELLS * _TABLE + 2)
    table = matched_fourier(products, k, sampling.prf_hz, lines=lines, transform=Gridding(6))[:, 1:]
    table = table * math.sqrt(sampling.pulses) * (scale[:, first] * scale[:, second]).mT
    low, high = table[near.trial, whole], table[near.trial, whole + 1]
    values = ((low + (position - whole)[:, None] * (high - low)) * weight[:, None]).unbind(-1)
    return {pair: value for (n, m), value in zip(index, values) for pair in {(n, m), (m, n)}}
