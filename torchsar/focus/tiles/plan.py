"""Plan of the images of one geometry by tiles."""

from __future__ import annotations

import copy
import functools
import itertools
import math
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from torchsar.core import checked_samples, is_hidden, is_traced, untraced
from torchsar.focus.backprojection import expanded_history
from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.tiles.choice import Choice
from torchsar.focus.tiles.direct import Direct, weighted_sum
from torchsar.focus.tiles.expansion import slopes
from torchsar.focus.tiles.scene import Lit, Weight
from torchsar.focus.tiles.sector import Sector, planned
from torchsar.radar.antenna_path import AntennaPath, refuse_unusable
from torchsar.radar.spotlight import frequency_step_hz


class TilePlan:
    """Images of one geometry, as exact as wanted, at several times the speed of the direct sum.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.5 * y, 100.0] for y in range(-20, 20)]).double()
    >>> given = (9.6e9 + 1e7 * torch.arange(16).double(), place_m, None, 2 * place_m.norm(dim=-1))
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> divmod(int(focus.TilePlan(*given, grid).image(torch.ones(40, 16) + 0j).abs().argmax()), 17)
    (8, 8)

    The image is the sum over pulses p and frequencies k

        I(x) = sum_p sum_k s[p, k] exp(+2j pi f_k (l_p(x) - l_ref,p) / c),

    where l_p(x) is the path from the transmitter over x to the receiver. The image is divided into
    tiles and the pulses into sub-apertures. Within a tile the path of each pulse is that of a plane
    wave, so that the polar-format algorithm applies, plus small terms that are expanded
    (`expansion`). Any path and spacing of the pulses is admitted. Antennas are at rest during a
    pulse; `compensate.correct_sweep_motion` makes it so for long sweeps. The sizes are chosen so
    that the predicted error is at most `error_db`; `choice` has them. Where no sizes are suitable,
    or the direct sum costs less, the pulses are summed directly; `direct` says so. The geometry is
    computed once, for any number of histories of complex64 or complex128.

    Leading dimensions of the positions are trials with paths of their own. Their mean is the
    nominal path, from which they may differ as motion errors do. The image is differentiable in
    the history, the positions, the reference and the heights of the pixels; memory for gradients is
    limited to that of the kept tables, or of some tiles at a time.

    Args:
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres, float64 (..., pulse, 3); None if both share
            an antenna, so that the path is twice its range.
        reference_m: Path to which the phases refer in metres (twice the reference range of a
            monostatic radar), float64 (..., pulse).
        grid: Pixels. The plan is fastest if one of its axes is that of the range.
        error_db: Largest rms error relative to the image of a history of white noise, in dB.
        lit: For a beam that lights a part of the image at a time: function of positions in metres,
            float64 (point, 3), that returns the first pulse that lights each point and the pulse
            after the last, int64 (point, 2), alike if there are none. Each pixel is the sum over
            the pulses that light it. None for all pulses.
        weight: Function of positions that returns the weights of all pulses in the sum of a pixel,
            finite, float64 (point, pulse), such as those of a beam with smooth edges. Within a tile
            they are interpolated, as exactly as wanted; the faster they change, the longer an image
            takes, longest with the hard edges of `lit` alone. None for equal ones.
        images: Number of images for which the plan is made. Where the direct sum takes less time
            for them than plan and tiles, or tiles do not reach the error, pulses are summed
            directly; `direct` says so. None for tiles in any case.

    Raises:
        TypeError: If frequencies or positions are not float64.
        ValueError: If shapes do not match, values are not finite, the frequencies do not rise in
            equal steps, `lit` or `weight` returns other shapes, no pulse lights any of 64 x 64
            pixels that are spread over the image, `error_db` is not -130 to -20 dB, `images` is
            None and tiles do not reach the error, or the geometry is not constant in a program that
            is traced, as by `torch.export`.

    Warns:
        UserWarning: If pulses are summed directly because tiles do not reach the error.
    """

    def __init__(
        self,
        frequency_hz: Tensor,
        transmitter_m: Tensor,
        receiver_m: Tensor | None,
        reference_m: Tensor,
        grid: ImageGrid,
        error_db: float = -70.0,
        lit: Lit | None = None,
        weight: Weight | None = None,
        images: float | None = 1.0,
    ) -> None:
        self.frequency_hz, self.grid, self.error_db = frequency_hz, grid, float(error_db)
        self.lit, self.weight, self._images = lit, weight, images
        # the kernels reach -130 dB, and the expansion to second order is not suitable for more than
        # -20 dB
        if not (-130 <= error_db <= -20 and (images is None or images > 0)):
            raise ValueError(
                f"error_db of an image by tiles must be -130 to -20 dB, and images positive or None, got {error_db:g} "
                f"dB and {images} images"
            )
        _refuse_traced(frequency_hz, transmitter_m, receiver_m, reference_m, grid.origin_m, grid.axes, grid.height_m)
        with untraced():
            refuse_unusable(frequency_hz=frequency_hz)
            frequency_step_hz(frequency_hz)
            places, reference_m = self._set_path(transmitter_m, receiver_m, reference_m)
            ends = [0, self.antennas.pulses]
            if lit is None:
                with torch.no_grad():
                    ends = sector_bounds([place.detach().mean(0) for place in places], grid)
            bounds, found = list(itertools.pairwise(ends)), []
            for first, last in bounds:
                given = [place[:, first:last] for place in places], reference_m[:, first:last], grid, self.error_db, lit
                some = None if weight is None else partial(_weights_between, weight, first, last)
                found.append(planned(frequency_hz, *given, some, 1 / len(bounds), images))
        self.bounds: list[tuple[int, int]] = []
        self.sectors: list[Sector | Direct] = []
        for one, (first, last) in zip(found, bounds, strict=True):
            if isinstance(one, Direct) and self.sectors and isinstance(self.sectors[-1], Direct):
                # adjacent pulses that are summed directly need their weights once
                first, _ = self.bounds.pop()
                self.sectors.pop()
                some = None if weight is None else partial(_weights_between, weight, first, last)
                one = one.of([place[:, first:last] for place in places], reference_m[:, first:last], some)
            self.bounds.append((first, last))
            self.sectors.append(one)

    @property
    def choice(self) -> Choice | None:
        """Sizes of the tiles. If there are several sectors, they are those with the largest
        predicted error; None if all pulses are summed directly.
        """
        choices = [sector.choice for sector in self.sectors if isinstance(sector, Sector)]
        return max(choices, key=lambda choice: choice.error_db, default=None)

    @property
    def direct(self) -> str:
        """How many pulses are summed directly, and why, in a sentence; empty if none are."""
        found = [
            (last - first, sector.why)
            for sector, (first, last) in zip(self.sectors, self.bounds, strict=True)
            if isinstance(sector, Direct)
        ]
        if not found:
            return ""
        return f"{sum(n for n, _ in found)} of {self.antennas.pulses} pulses are summed directly: {found[0][1]}"

    def __repr__(self) -> str:
        size = " x ".join(map(str, self.grid.counts))
        found = [f"{size} pixels at {self.error_db:g} dB, {self.antennas.pulses} pulses in {len(self.sectors)} sectors"]
        if self.choice is not None:
            found.append(f"tiles of {self.choice.width} x {self.choice.depth} pixels")
        return f"TilePlan({'; '.join([*found, *([self.direct] if self.direct else [])])})"

    def _set_path(
        self, transmitter_m: Tensor, receiver_m: Tensor | None, reference_m: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Positions (path, pulse, 3) of the antennas and reference paths (path, pulse)."""
        self.antennas = antennas = AntennaPath(transmitter_m, receiver_m, reference_m)
        size = *antennas.trials, antennas.pulses
        places = [place.expand(*size, 3).reshape(-1, *size[-1:], 3) for place in antennas.places]
        return places, reference_m.expand(size).reshape(-1, *size[-1:])

    def moved(self, transmitter_m: Tensor, receiver_m: Tensor | None, reference_m: Tensor) -> TilePlan:
        """Return the plan of a path that differs little, such as by a change of its motion errors.

        It shares what this plan has computed, if the path does not leave its margins and the
        predicted error is at most 2 dB above `error_db`; otherwise a new plan is made.

        Args:
            transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
            receiver_m: Positions of the receiver in metres; None if both share an antenna.
            reference_m: Path to which the phases refer in metres, float64 (..., pulse).

        Returns:
            Plan of the path.

        Raises:
            TypeError: If the positions are not float64.
            ValueError: If shapes do not match, values are not finite, or tiles of a plan for tiles
                in any case do not reach the error for this path.
        """
        _refuse_traced(transmitter_m, receiver_m, reference_m)
        plan = copy.copy(self)
        with untraced():
            places, reference_m = plan._set_path(transmitter_m, receiver_m, reference_m)
            if plan.antennas.pulses != self.antennas.pulses or len(places) != len(self.antennas.places):
                given = transmitter_m, receiver_m, plan.antennas.reference_m
                other = self.grid, self.error_db, self.lit, self.weight, self._images
                return TilePlan(self.frequency_hz, *given, *other)
            plan.sectors = [
                sector.moved([place[:, first:last] for place in places], reference_m[:, first:last])
                for sector, (first, last) in zip(self.sectors, self.bounds, strict=True)
            ]
        return plan

    def image(self, history: Tensor) -> Tensor:
        """Form the images of phase histories.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex; its leading dimensions
                broadcast with those of the positions.

        Returns:
            Image, shape (..., i, j), complex, of the precision of the history. A point of unit
            amplitude has the number of samples as peak.

        Raises:
            TypeError: If the history is not complex64 or complex128.
            ValueError: If its size is not that of the plan.
        """
        history = checked_samples(history, "TilePlan.image", "pulse, frequency", finite=False)
        history = expanded_history(history, self.antennas, self.frequency_hz, "TilePlan.image")
        lead, size = history.shape[:-2], history.shape[-2:]
        # trials with paths of their own come first, then those that have a path in common
        own = (*(1,) * (len(lead) - len(self.antennas.trials)), *self.antennas.trials)
        order = sorted(range(len(lead)), key=lambda d: own[d] != lead[d])
        paths = self.antennas.trials.numel()
        data = history.permute(*order, -2, -1).reshape(paths, -1, *size)
        pairs = zip(self.sectors, self.bounds, strict=True)
        parts = (sector.image(data[..., first:last, :]) for sector, (first, last) in pairs)
        image = functools.reduce(torch.add, parts)
        image = image.reshape(*(lead[d] for d in order), *self.grid.counts)
        return image.permute(*(order.index(d) for d in range(len(lead))), -2, -1)

    def exact(self, history: Tensor, pixels_m: Tensor, eps: float = 1e-10) -> Tensor:
        """Compute pixels by the direct sum over the pulses that `image` sums for each of them.

        Args:
            history: Phase history, shape (..., pulse, frequency), complex.
            pixels_m: Positions of pixels of the grid in metres, float64 (pixel, 3).
            eps: Relative error of the interpolation in range.

        Returns:
            Image, shape (..., pixel), complex.

        Raises:
            TypeError: If the history is not complex64 or complex128, or the pixels are not float64.
            ValueError: If its size is not that of the plan, or a position is not that of a pixel.
        """
        history = checked_samples(history, "TilePlan.exact", "pulse, frequency", finite=False)
        history = expanded_history(history, self.antennas, self.frequency_hz, "TilePlan.exact")
        grid = self.grid
        refuse_unusable(pixels_m=pixels_m)
        if pixels_m.ndim != 2 or pixels_m.shape[-1] != 3 or not len(pixels_m):
            raise ValueError(f"pixels_m must be positions of pixels (pixel, 3), got the shape {tuple(pixels_m.shape)}")
        at = ((pixels_m - grid.origin_m) @ grid.axes.mT / grid.step_m).round().long()
        if bool(((at < 0) | (at >= at.new_tensor(grid.counts))).any()):
            raise ValueError("pixels_m must be positions of pixels of the grid of the plan, got some outside of it")
        return weighted_sum(history, self.frequency_hz, self.antennas, pixels_m, self.lit, self.weight, eps)


def sector_bounds(places: Sequence[Tensor], grid: ImageGrid, most_rad: float = math.radians(45)) -> list[int]:
    """Divide a path into sectors, whose pulses see each point of the image within an angle.

    Args:
        places: Positions of one or two antennas, each float64 (pulse, 3).
        grid: Pixels.
        most_rad: Largest change of the direction in which the path to a point grows, in rad.

    Returns:
        First pulse of each sector, and the number of pulses.
    """
    rows, columns = (torch.linspace(0, n - 1, 3, dtype=torch.float64) * grid.step_m for n in grid.counts)
    points = torch.cartesian_prod(rows, columns).to(grid.origin_m) @ grid.axes + grid.origin_m
    _, a, b = slopes(places, points, grid.axes)
    turned = torch.remainder(torch.atan2(b, a).diff(dim=-1) + math.pi, 2 * math.pi) - math.pi
    angle, bounds = torch.nn.functional.pad(turned.cumsum(-1), (1, 0)), [0]
    extent = float((angle.amax(-1) - angle.amin(-1)).max())
    # sectors of about equal angles
    most = extent / max(1, math.ceil(extent / most_rad)) * (1 + 1e-9)
    while bounds[-1] < angle.shape[-1]:
        ahead = angle[:, bounds[-1] :]
        wide = ((ahead - ahead[:, :1]).abs() > most).any(0)
        bounds.append(bounds[-1] + int(wide.to(torch.int8).argmax()) if bool(wide.any()) else angle.shape[-1])
    return bounds


def _weights_between(weight: Weight, first: int, last: int, points: Tensor) -> Tensor:
    """Weights of the pulses of a sector."""
    return weight(points)[..., first:last]


def _refuse_traced(*known: Tensor | None) -> None:
    """Raise ValueError for tensors on which a plan depends and whose values cannot be read."""
    if any(v is not None and is_traced(v) for v in known):
        raise ValueError(
            "the sizes of tiles depend on the values of positions and frequencies, which must be constants of a traced "
            "program; let it depend on the history alone, or use backproject"
        )
    if any(v is not None and is_hidden(v) for v in known):
        raise RuntimeError(
            "torch.func.vmap cannot map plans of tiles, whose sizes depend on the values of positions and frequencies; "
            "give the paths as a leading dimension of the positions, or map over the history alone, or use backproject"
        )


def image_tiles(
    history: Tensor,
    frequency_hz: Tensor,
    transmitter_m: Tensor,
    receiver_m: Tensor | None,
    reference_m: Tensor,
    grid: ImageGrid,
    error_db: float = -70.0,
    lit: Lit | None = None,
    weight: Weight | None = None,
) -> Tensor:
    """Form the image of a phase history by tiles; see `TilePlan`, which serves several histories.

    >>> import torch
    >>> from torchsar import focus
    >>> place_m = torch.tensor([[-300.0, 0.5 * y, 100.0] for y in range(-20, 20)]).double()
    >>> given = (9.6e9 + 1e7 * torch.arange(16).double(), place_m, None, 2 * place_m.norm(dim=-1))
    >>> grid = focus.ImageGrid(torch.tensor([-4.0, -4.0, 0.0]).double(), torch.eye(2, 3).double(),
    ...     counts=(17, 17), step_m=0.5)
    >>> divmod(int(focus.image_tiles(torch.ones(40, 16) + 0j, *given, grid).abs().argmax()), 17)
    (8, 8)

    Args:
        history: Phase history, shape (..., pulse, frequency), complex.
        frequency_hz: Frequencies in Hz, rising in equal steps, float64 (frequency,).
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres; None if both share an antenna.
        reference_m: Path to which the phases refer in metres, float64 (..., pulse).
        grid: Pixels.
        error_db: Largest rms error relative to the image of a history of white noise, in dB.
        lit: Pulses that light each point, see `TilePlan`; None for all.
        weight: Weights of the pulses, see `TilePlan`; None for equal ones.

    Returns:
        Image, shape (..., i, j), complex.

    Raises:
        TypeError: If the history is not complex, or frequencies or positions are not float64.
        ValueError: If shapes do not match, values are not finite, the frequencies do not rise in
            equal steps, `lit` or `weight` returns other shapes, no pulse lights any of 64 x 64
            pixels that are spread over the image, or `error_db` is not -130 to -20 dB.
    """
    images = max(1.0, history.shape[:-2].numel() / max(1, reference_m.shape[:-1].numel()))
    plan = TilePlan(frequency_hz, transmitter_m, receiver_m, reference_m, grid, error_db, lit, weight, images)
    return plan.image(history)
