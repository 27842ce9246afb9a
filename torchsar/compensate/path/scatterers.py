"""Prominent scatterers of a strip, and their echoes in the pulses that illuminate them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from torchsar.compensate.path.ground import slope
from torchsar.core import power_of, unit_phasor
from torchsar.focus import ImageGrid
from torchsar.optim.scalar import vertex
from torchsar.radar import LIGHT_M_S, AntennaPath


def prominent_places(image: Tensor, grid: ImageGrid, cells: tuple[float, float], most: int) -> Tensor:
    """Find isolated scatterers that are stronger than clutter.

    Args:
        image: Image, shape (azimuth, range), complex.
        grid: Its pixels.
        cells: Pixels of a resolution cell along either axis.
        most: Largest number of scatterers; the strongest ones are kept.

    Returns:
        Positions in metres, float64 (scatterer, 3), the strongest one first.
    """
    power = power_of(image)
    # The mean power of clutter is its median divided by ln 2 (exponential distribution). The median
    # of each range cell is used, but at least that of the whole image, because few pixels of a
    # range cell may have samples.
    clutter = power.median(0).values.clamp_min(power.median()) / math.log(2)

    def strongest(cells_near: tuple[int, int]) -> Tensor:
        half = [
            max(1, min(round(n * per), (size - 1) // 2))
            for n, per, size in zip(cells_near, cells, power.shape, strict=True)
        ]
        return max_pool2d(power[None], (2 * half[0] + 1, 2 * half[1] + 1), 1, (half[0], half[1]))[0]

    # A scatterer is the brightest pixel within the first distances, by choice. Within the second
    # ones it is not weaker than a hundredth of the brightest, of which it might be a side lobe.
    alone = (power == strongest((6, 2))) & (power > 0.01 * strongest((100, 2)))
    # Speckle of a million cells exceeds 14 times its mean in half of the images, and the chosen 20
    # times in one of 500.
    at = (alone & (power > 20.0 * clutter)).nonzero()
    at = at[power[at[:, 0], at[:, 1]].argsort(descending=True)[:most]]
    log = power.double().clamp_min(torch.finfo(torch.float64).tiny).log()
    index = torch.stack([_refined(log, at, dim) for dim in range(2)], -1)
    return grid.origin_m + grid.step_m * (index @ grid.axes)


def _refined(log: Tensor, at: Tensor, dim: int) -> Tensor:
    """Index of the maximum of the parabola through three pixels along one axis."""
    step = torch.eye(2, dtype=torch.int64, device=at.device)[dim]
    inside = (at[:, dim] > 0) & (at[:, dim] < log.shape[dim] - 1)
    near = (log[tuple((at + side * step * inside[:, None]).mT)] for side in (-1, 0, 1))
    return at[:, dim] + vertex(*near).clamp(-0.5, 0.5)


@dataclass(frozen=True, eq=False)
class Echoes:
    """Echoes of scatterers along a path, each compressed in range at its position.

    The pulses that illuminate a scatterer follow one another. The same number of pulses is kept for
    all scatterers, some of which may not illuminate it.

    Args:
        pulses: Numbers of the pulses, int64 (scatterer, seen).
        seen: True where the pulse sees the scatterer and holds samples, (scatterer, seen).
        path_m: Path over the scatterer less the reference in metres, float64 (scatterer, seen).
        slope: Change of half the path by the position of the antennas, which move together, float64
            (scatterer, seen, 3).
        samples: Echoes, complex128 (scatterer, seen). The echo of a scatterer at its place, seen
            from the recorded path, has the same phase at all pulses.
        frequency_hz: Frequencies in Hz, (frequency,).
        weights: Weights of the frequencies, whose sum is 1, (frequency,).
    """

    pulses: Tensor
    seen: Tensor
    path_m: Tensor
    slope: Tensor
    samples: Tensor
    frequency_hz: Tensor
    weights: Tensor

    @staticmethod
    def of(
        history: Tensor,
        frequency_hz: Tensor,
        weights: Tensor,
        antennas: AntennaPath,
        places_m: Tensor,
        lit: Callable[[Tensor], Tensor],
    ) -> Echoes:
        """Compress the echoes of scatterers.

        Args:
            history: Phase history, shape (pulse, frequency), complex.
            frequency_hz: Frequencies in Hz, float64 (frequency,).
            weights: Weights of the frequencies, whose sum is 1, float64 (frequency,).
            antennas: Path of the antennas.
            places_m: Positions of the scatterers in metres, float64 (scatterer, 3).
            lit: Function of positions that returns the pulses that see them, see `TilePlan`.

        Returns:
            The echoes.
        """
        ends = lit(places_m)
        length = int((ends[:, 1] - ends[:, 0]).amax())
        first = ends[:, :1].clamp(max=antennas.pulses - length)
        pulses = first + torch.arange(length, device=ends.device)
        seen = (pulses >= ends[:, :1]) & (pulses < ends[:, 1:]) & (history != 0).any(-1)[pulses]
        at = [place[pulses] for place in antennas.places]
        legs = [torch.linalg.vector_norm(place - places_m[:, None], dim=-1) for place in at]
        path = (2 if len(legs) == 1 else 1) * torch.stack(legs).sum(0) - antennas.reference_m[pulses]
        weighted = history * weights.to(history.real.dtype)
        # blocks of two million samples, by choice
        step = max(1, (1 << 21) // max(1, length * len(frequency_hz)))
        parts = [
            (weighted[number] * unit_phasor(way[..., None] / LIGHT_M_S * frequency_hz, history.dtype)).sum(-1)
            for way, number in zip(path.split(step), pulses.split(step), strict=True)
        ]
        samples = torch.cat(parts).to(torch.complex128) * seen
        return Echoes(pulses, seen, path, slope(at, places_m[:, None]), samples, frequency_hz, weights)

    @property
    def wave(self) -> float:
        """Derivative of the phase by half the path, in rad per metre, at the middle of the band."""
        return 4 * math.pi * float(self.weights @ self.frequency_hz) / LIGHT_M_S

    def crossed(self, model: Tensor) -> Tensor:
        """Return the part of each echo that the other scatterers contribute.

        Args:
            model: Echo of each scatterer alone at its own place, complex (scatterer, seen).

        Returns:
            Sum over the other scatterers at the same range, complex (scatterer, seen).
        """
        one, other, at, response = self._pairs
        found = torch.zeros_like(self.samples)
        return found.index_add_(0, one, model[other].gather(1, at) * response)

    @cached_property
    def _pairs(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pairs of scatterers at nearly the same range, and the response of one at the range of the
        other.

        Returns the numbers of both, the indices of the pulses of the first among those of the
        second, and the response there.
        """
        # pairs are considered up to path differences of four range cells, by choice
        reach, steps = 4.0 * LIGHT_M_S / float(self.frequency_hz[-1] - self.frequency_hz[0]), 1024
        first, middle = self.pulses[:, 0], self.path_m.mean(1)
        near = (middle[:, None] - middle).abs() < 2 * reach
        near &= (first[:, None] - first).abs() < self.pulses.shape[1]
        near.fill_diagonal_(False)
        one, other = near.nonzero(as_tuple=True)
        at = self.pulses[one] - first[other][:, None]
        both = (at >= 0) & (at < self.pulses.shape[1])
        at = at.clamp(0, self.pulses.shape[1] - 1)
        both &= self.seen[one] & self.seen[other].gather(1, at)
        off = self.path_m[one] - self.path_m[other].gather(1, at)
        carrier = float(self.weights @ self.frequency_hz)
        # response as a function of the path difference without the carrier, from a table
        grid = torch.linspace(0, 1, steps, dtype=torch.float64, device=off.device) * reach
        table = torch.cos(torch.outer(grid, self.frequency_hz - carrier) * (2 * math.pi / LIGHT_M_S)) @ self.weights
        place = (off / reach).abs() * (steps - 1)
        low = place.long().clamp(max=steps - 2)
        response = torch.where(place < steps - 1, torch.lerp(table[low], table[low + 1], place - low), 0.0) * both
        return one, other, at, response * unit_phasor(off * (carrier / LIGHT_M_S), torch.complex128)
