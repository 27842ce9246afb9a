"""Beam whose echoes are processed, with smooth edges, and the pulses that illuminate a point within
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real

import numpy as np
import torch
from torch import Tensor

from torchsar.focus.frame_geometry import BAND_EDGE, raised_cosine_band
from torchsar.radar import StraightTrack


@dataclass(frozen=True)
class ProcessedBeam:
    """Angles ahead of broadside that are processed, with raised-cosine edges.

    >>> import torch
    >>> from torchsar import focus
    >>> beam = focus.ProcessedBeam(width_deg=6.0)
    >>> beam.weight(torch.tensor([0.0, 1.5, 3.0, 4.5]).deg2rad().sin()).round(decimals=3)
    tensor([1.0000, 1.0000, 0.5000, 0.0000])

    Args:
        width_deg: Width between half weights in degrees.
        squint_deg: Angle of the middle ahead of broadside in degrees.

    Raises:
        ValueError: If a number is not finite, the width is not positive, or an edge lies 80 degrees
            or more from broadside, or its slope as far as the track.
    """

    width_deg: float
    squint_deg: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.width_deg, self.squint_deg)
        if (
            not all(isinstance(x, Real) for x in numbers)
            or not (self.width_deg > 0 and abs(self.squint_deg) + self.width_deg / 2 < 80)
            or max(map(abs, self.ends)) >= 1
        ):
            raise ValueError(
                "a processed beam needs a positive width_deg, edges less than 80 degrees from broadside, and slopes of "
                "the edges that do not reach the track; a narrower one will do. Got "
                f"width_deg={self.width_deg}, squint_deg={self.squint_deg}"
            )

    @property
    def edges(self) -> tuple[float, float]:
        """Sines of the angles at half weight."""
        low, high = (math.sin(math.radians(self.squint_deg + side * self.width_deg / 2)) for side in (-1, 1))
        return low, high

    @property
    def middle(self) -> float:
        """Mean of the sines of both edges."""
        return sum(self.edges) / 2

    @property
    def band(self) -> float:
        """Difference of the sines of both edges."""
        return self.edges[1] - self.edges[0]

    @property
    def ends(self) -> tuple[float, float]:
        """Least and largest sine of an angle with a weight."""
        half = (1 + BAND_EDGE) * self.band / 2
        return self.middle - half, self.middle + half

    def weight(self, sine: Tensor) -> Tensor:
        """Return the weight of a line of sight, 0 to 1, in the shape of the argument.

        Args:
            sine: Sine of its angle ahead of broadside, any shape.
        """
        return raised_cosine_band((sine - self.middle) / self.band)

    def lit_pulses(self, position_m: Tensor, points_m: Tensor) -> Tensor:
        """Return the pulses that see points at an angle with a weight.

        Angles are those from the straight track of the antenna (`StraightTrack`), in the plane of
        the track and the point.

        Args:
            position_m: Positions of the antenna in metres, float64 (pulse, 3).
            points_m: Points in metres, float64 (point, 3).

        Returns:
            First pulse that sees each point and the pulse after the last, int64 (point, 2); alike
            where none sees it.

        Raises:
            TypeError: If the positions are not float64.
            ValueError: If there are fewer than two positions, the antenna does not advance, or
                values are not finite.
        """
        track = StraightTrack.fitted(position_m)
        pulse, along = track.along_m(position_m), track.along_m(points_m)
        closest = torch.linalg.vector_norm(track.across_m(points_m), dim=-1)
        low, high = (along - closest * math.tan(math.asin(sine)) for sine in reversed(self.ends))
        # if the antenna turns back, it may pass a coordinate several times
        first = torch.searchsorted(pulse.cummax(0).values, low)
        last = torch.searchsorted(pulse.flip(0).cummin(0).values.flip(0), high, right=True)
        return torch.stack([first, torch.maximum(first, last)], -1)

    def pulse_weights(self, position_m: Tensor, points_m: Tensor) -> Tensor:
        """Return the weights with which pulses see points.

        Angles are those of `lit_pulses`.

        Args:
            position_m: Positions of the antenna in metres, float64 (pulse, 3).
            points_m: Points in metres, float64 (point, 3).

        Returns:
            Weights, 0 to 1, float64 (point, pulse).

        Raises:
            TypeError: If the positions are not float64.
            ValueError: If there are fewer than two positions, the antenna does not advance, or
                values are not finite.
        """
        track = StraightTrack.fitted(position_m)
        ahead = track.along_m(points_m)[:, None] - track.along_m(position_m)
        closest = torch.linalg.vector_norm(track.across_m(points_m), dim=-1)
        return self.weight(ahead / torch.hypot(ahead, closest[:, None]))

    def quadrature(self, angles: int = 24) -> tuple[Tensor, Tensor]:
        """Return sines of angles, and their shares of the power of an image of white noise.

        The share of a pulse is its squared weight. Pulses are even along the track, and have the
        density (1 - s^2)^(-3/2) over the sine s.

        Args:
            angles: Number of angles.

        Returns:
            Sines and shares, whose sum is 1, float64 (angle,).
        """
        node, weight = map(torch.from_numpy, np.polynomial.legendre.leggauss(angles))
        sine = self.middle + node * (self.ends[1] - self.middle)
        share = weight * self.weight(sine).square() * (1 - sine.square()) ** -1.5
        return sine, share / share.sum()
