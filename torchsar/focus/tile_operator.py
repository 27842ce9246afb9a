"""Image formation by tiles as a linear operator on range profiles, with its adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.focus.tiles import TilePlan
from torchsar.radar.spotlight import frequency_samples


class TileOperator:
    """The image of range profiles by the tiles of a plan, and its adjoint, for autofocus.

    Args:
        plan: Plan of one path that all trials share.

    Raises:
        ValueError: If the plan has paths of single trials.
    """

    def __init__(self, plan: TilePlan) -> None:
        if plan.antennas.trials.numel() != 1:
            raise ValueError(
                "an operator needs a path that all trials share, got one for each of "
                f"{tuple(plan.antennas.trials)}; make one operator for each path"
            )
        self.plan = plan
        self._graph: tuple[Tensor, Tensor] | None = None

    def image(self, rows: Tensor) -> Tensor:
        """Form the image of range profiles.

        Args:
            rows: Range profiles, the unitary centred inverse FFT of a phase history, shape (trial,
                pulse, range), complex.

        Returns:
            Image, shape (trial, i, j).
        """
        return self.plan.image(frequency_samples(rows))

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint of `image`, by automatic differentiation.

        The graph of the last number of trials is kept: it does not depend on the image.

        Args:
            image: Image, shape (trial, i, j), complex.

        Returns:
            Range profiles, shape (trial, pulse, range).
        """
        size = (image.shape[0], self.plan.antennas.pulses, len(self.plan.frequency_hz))
        if self._graph is None or (self._graph[0].shape, self._graph[0].dtype) != (size, image.dtype):
            with torch.enable_grad():
                rows = image.detach().new_zeros(size).requires_grad_()
                self._graph = rows, self.image(rows)
        rows, of_rows = self._graph
        return torch.autograd.grad(of_rows, rows, image.detach(), retain_graph=True)[0]
