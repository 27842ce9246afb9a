"""Straight track at constant speed, the nominal path of a strip."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.radar.antenna_path import refuse_unusable


@dataclass(frozen=True, eq=False)
class StraightTrack:
    """Straight line with pulses at even steps.

    >>> import torch
    >>> from torchsar import radar
    >>> position_m = torch.tensor([[0.0, 0.0, 9.0], [3.0, 4.0, 9.0], [6.0, 8.0, 9.0]]).double()
    >>> track = radar.StraightTrack.fitted(position_m)
    >>> round(track.step_m, 3), track.along_m(position_m).round(decimals=3).tolist()
    (5.0, [-5.0, 0.0, 5.0])

    Args:
        origin_m: A position on the line in metres, float64 (3,); coordinates along the track are
            zero there.
        along: Direction of flight, a unit vector, float64 (3,).
        step_m: Distance between pulses in metres.
    """

    origin_m: Tensor
    along: Tensor
    step_m: float

    @staticmethod
    def fitted(position_m: Tensor) -> StraightTrack:
        """Fit the straight track at constant speed with the least mean square distance to a path.

        Differentiable in the positions, but for the step.

        Args:
            position_m: Positions of an antenna at its pulses in metres, float64 (pulse, 3).

        Returns:
            Track whose origin is the mean position.

        Raises:
            TypeError: If the positions are not float64.
            ValueError: If there are fewer than two positions, the antenna does not advance, or
                values are not finite.
        """
        refuse_unusable(position_m=position_m)
        if position_m.ndim != 2 or position_m.shape[-1] != 3 or len(position_m) < 2:
            raise ValueError(
                "a straight track is fitted to two or more positions of shape (pulse, 3), got "
                f"{tuple(position_m.shape)}"
            )
        number = torch.arange(len(position_m), dtype=torch.float64, device=position_m.device)
        number = number - number.mean()
        step = (number[:, None] * position_m).sum(0) / number.square().sum()
        length = torch.linalg.vector_norm(step)
        if not float(length.detach()) > 0:
            raise ValueError("the antenna does not advance along a line; a straight track needs one that moves")
        return StraightTrack(position_m.mean(0), step / length, float(length.detach()))

    def along_m(self, points_m: Tensor) -> Tensor:
        """Return the coordinate along the track, float64 (...,).

        Args:
            points_m: Points in metres, float64 (..., 3).
        """
        return (points_m - self.origin_m) @ self.along

    def abeam_m(self, position_m: Tensor, middle_m: Tensor) -> Tensor:
        """Return the points of the level line through a point along the track that lie abeam.

        Args:
            position_m: Positions of an antenna in metres, float64 (..., 3).
            middle_m: The point in metres, such as the middle of a strip, float64 (3,).

        Returns:
            Positions in metres, float64 (..., 3).
        """
        level = self.along * self.along.new_tensor([1.0, 1.0, 0.0])
        level = level / torch.linalg.vector_norm(level).clamp_min(torch.finfo(level.dtype).tiny)
        return middle_m + ((position_m - middle_m) @ level)[..., None] * level

    def across_m(self, points_m: Tensor) -> Tensor:
        """Return the part of the vectors from the track to points that is perpendicular to it.

        Args:
            points_m: Points in metres, float64 (..., 3).

        Returns:
            Vectors in metres, float64 (..., 3); their lengths are the closest ranges.
        """
        return points_m - self.origin_m - self.along_m(points_m)[..., None] * self.along
