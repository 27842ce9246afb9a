"""Sums of the pulses of a path at each pixel, where tiles do not suit."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchsar.core import block_bytes_of, is_plain, over_blocks, untraced
from torchsar.focus.backprojection import direct_sum
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.scene import Lit, Weight, lit_pulses, pulse_weights
from torchsar.radar.antenna_path import AntennaPath


def weighted_sum(
    history: Tensor,
    frequency_hz: Tensor,
    antennas: AntennaPath,
    pixels_m: Tensor,
    lit: Lit | None,
    weight: Weight | None,
    eps: float,
) -> Tensor:
    """Sum a phase history over the pulses that light each pixel, with their weights.

    Args:
        history: Phase history, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        antennas: Path of the antennas.
        pixels_m: Positions in metres, float64 (pixel, 3).
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.
        eps: Relative error of the interpolation in range.

    Returns:
        Image, shape (..., pixel), complex.
    """
    first, last, weights = 0, antennas.pulses, None
    if lit is not None or weight is not None:
        with torch.no_grad():
            ends = lit_pulses(pixels_m, antennas.pulses, lit)
            ends = ends[ends[:, 1] > ends[:, 0]]
            if not len(ends):
                return history.new_zeros(*history.shape[:-2], len(pixels_m))
            first, last = int(ends[:, 0].min()), int(ends[:, 1].max())
            weights = pulse_weights(pixels_m, antennas.pulses, lit, weight).mT[first:last]

    def path(pulses: slice, some: slice) -> tuple[Tensor, Tensor | None]:
        here = slice(first + pulses.start, first + pulses.stop)
        return antennas.path_m(pixels_m[some], here), None if weights is None else weights[pulses, some]

    given = history[..., first:last, :], frequency_hz, path, len(pixels_m)
    return direct_sum(*given, eps=eps, block_bytes=block_bytes_of(history.device))


class Direct:
    """Sums of the pulses of a path, each at every pixel.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        places: Positions of one or two antennas, each float64 (path, pulse, 3).
        reference_m: Path to which the phases refer in metres, float64 (path, pulse).
        grid: Pixels.
        error_db: Largest error relative to the image of white noise, in dB.
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.
        why: Reason why there are no tiles.
    """

    def __init__(
        self,
        frequency_hz: Tensor,
        places: Sequence[Tensor],
        reference_m: Tensor,
        grid: ImageGrid,
        error_db: float,
        lit: Lit | None,
        weight: Weight | None,
        why: str,
    ) -> None:
        self.frequency_hz, self.grid, self.lit, self.weight, self.why = frequency_hz, grid, lit, weight, why
        # the interpolation adds little to the rounding of the sum
        self._eps = max(1e-12, 10 ** (error_db / 20) / 4)
        self._antennas = _antennas(places, reference_m)

    def of(self, places: Sequence[Tensor], reference_m: Tensor, weight: Weight | None) -> Direct:
        """Return the sums of other pulses.

        Args:
            places: Positions of one or two antennas, each float64 (path, pulse, 3).
            reference_m: Path to which the phases refer in metres, float64 (path, pulse).
            weight: Weights of these pulses, see `TilePlan`; None for equal ones.
        """
        other = copy.copy(self)
        other.weight, other._antennas = weight, _antennas(places, reference_m)
        return other

    def moved(self, places: Sequence[Tensor], reference_m: Tensor) -> Direct:
        """Return the sums of another path.

        Args:
            places: Positions of one or two antennas, each float64 (path, pulse, 3).
            reference_m: Path to which the phases refer in metres, float64 (path, pulse).
        """
        return self.of(places, reference_m, self.weight)

    def image(self, data: Tensor) -> Tensor:
        """Form the images of histories (path, trial, pulse, frequency), (path * trial, i, j)."""
        grid, side = self.grid, 64
        # patches of pixels, which few pulses light more than one of their pixels
        rows, columns = ([slice(i, min(i + side, n)) for i in range(0, n, side)] for n in grid.counts)
        given = [data, *self._antennas.places, self._antennas.reference_m]
        given = given if grid.height_m is None else [*given, grid.height_m]
        grad = torch.is_grad_enabled() and any(v.requires_grad for v in given)
        if grad or not all(map(is_plain, given)):
            # torch.func takes no checkpoints
            part = partial(checkpoint, self._part, use_reentrant=False) if all(map(is_plain, given)) else self._part
            found = [torch.cat([part(data, i, j) for j in columns], -1) for i in rows]
            return torch.cat(found, -2).flatten(0, 1)
        image = data.new_empty(*data.shape[:2], *grid.counts)

        def work(patch: tuple[slice, slice]) -> None:
            image[..., patch[0], patch[1]] = self._part(data, *patch)

        over_blocks(work, itertools.product(rows, columns), data)
        return image.flatten(0, 1)

    def _part(self, data: Tensor, rows: slice, columns: slice) -> Tensor:
        """Pixels of a patch, (path, trial, i, j)."""
        with untraced():
            pixels = self.grid.pixels_m(rows, columns)
        image = weighted_sum(
            data, self.frequency_hz, self._antennas, pixels.reshape(-1, 3), self.lit, self.weight, self._eps
        )
        return image.unflatten(-1, pixels.shape[:-1])


def _antennas(places: Sequence[Tensor], reference_m: Tensor) -> AntennaPath:
    """Path of one or two antennas for the histories of several trials each, (path, 1, pulse)."""
    every = [place[:, None] for place in places]
    return AntennaPath(every[0], every[1] if len(every) > 1 else None, reference_m[:, None])
