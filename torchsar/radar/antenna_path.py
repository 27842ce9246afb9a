"""Where transmitter and receiver were: their positions at every pulse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchsar.core import refuse_non_finite


@dataclass(frozen=True, eq=False)
class AntennaPath:
    """Positions of transmitter and receiver at every pulse, and the paths to which phases refer.

    >>> import torch
    >>> from torchsar import radar
    >>> position_m = torch.tensor([[-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]).double()
    >>> path = radar.AntennaPath(position_m, None, reference_m=torch.full((3,), 8.0).double())
    >>> path.path_m(torch.tensor([[0.0, 4.0, 0.0]]))[:, 0].tolist()
    [2.0, 0.0, 2.0]

    The echo of a point at x has the path l = |transmitter - x| + |x - receiver| and, at the
    frequency f, the phase -2 pi f (l - reference) / c. Leading dimensions are trials with paths of
    their own; those of the three tensors broadcast.

    Args:
        transmitter_m: Positions of the transmitter in metres, float64 (..., pulse, 3).
        receiver_m: Positions of the receiver in metres, float64 (..., pulse, 3); None if both share
            an antenna, so that the path is twice its range.
        reference_m: Path to which the phases refer in metres (twice the reference range of a
            monostatic radar), float64 (..., pulse).

    Raises:
        TypeError: If a tensor is not float64.
        ValueError: If there is no pulse, the shapes do not match, or a value is not finite.
    """

    transmitter_m: Tensor
    receiver_m: Tensor | None
    reference_m: Tensor

    def __post_init__(self) -> None:
        given = {"transmitter_m": self.transmitter_m, "receiver_m": self.receiver_m, "reference_m": self.reference_m}
        given = {name: value for name, value in given.items() if value is not None}
        refuse_unusable(**given)
        shapes = [place.shape[:-1] for place in self.places] + [self.reference_m.shape]
        lead = broadcast([shape[:-1] for shape in shapes])
        pulses = {tuple(shape[-1:]) for shape in shapes}
        if (
            lead is None
            or len(pulses) > 1
            or 0 in (*lead, *pulses.pop())
            or any(v.shape[-1:] != (3,) for v in self.places)
        ):
            raise ValueError(
                "an antenna path needs positions of shape (..., pulse, 3) and reference_m of shape (..., pulse), with "
                "leading dimensions that broadcast, got "
                + ", ".join(f"{name} {tuple(value.shape)}" for name, value in given.items())
            )

    @staticmethod
    def recorded(aux: Mapping[str, Tensor]) -> AntennaPath:
        """Return the path in the side data of a recording, see `side_data`.

        Args:
            aux: Side data by name.

        Returns:
            The path.
        """
        return AntennaPath(aux["transmitter_m"], aux.get("receiver_m"), aux["path_reference_m"])

    @property
    def places(self) -> tuple[Tensor, ...]:
        """Positions of each antenna in metres, one tensor if both share it."""
        return (self.transmitter_m,) if self.receiver_m is None else (self.transmitter_m, self.receiver_m)

    @property
    def trials(self) -> torch.Size:
        """Leading dimensions."""
        # torch.broadcast_shapes imports sympy at its first call, which takes half a second
        shapes = self.reference_m.shape[:-1], *(place.shape[:-2] for place in self.places)
        return torch.Size(np.broadcast_shapes(*shapes))

    @property
    def pulses(self) -> int:
        """Number of pulses."""
        return self.reference_m.shape[-1]

    def of_trial(self, index: tuple[int, ...], trials: Sequence[int] | None = None) -> AntennaPath:
        """Return the path of one trial, without leading dimensions.

        Args:
            index: Number of the trial in each leading dimension.
            trials: Leading dimensions to which those of the path broadcast; None for those of the
                path.

        Returns:
            The path.
        """
        lead = self.trials if trials is None else trials

        def of(x: Tensor, behind: int) -> Tensor:
            return x.expand(*lead, *x.shape[x.ndim - behind :])[index]

        receiver = None if self.receiver_m is None else of(self.receiver_m, 2)
        return AntennaPath(of(self.transmitter_m, 2), receiver, of(self.reference_m, 1))

    def side_data(self) -> dict[str, Tensor]:
        """Return the side data of a recording (`Recording.aux`) that describe the path.

        Returns:
            `transmitter_m`, `receiver_m` unless both share an antenna, and `path_reference_m`, the
            three fields of the path, for the stages `TileImage`, `OmegaKImage` and `DirectImage`.
            If they share an antenna also `position_m` and `reference_m`, half the reference path,
            for `PolarFormat` and `SpotlightBackprojection`.
        """
        shared = {"transmitter_m": self.transmitter_m, "path_reference_m": self.reference_m}
        if self.receiver_m is not None:
            return {**shared, "receiver_m": self.receiver_m}
        return {**shared, "position_m": self.transmitter_m, "reference_m": self.reference_m / 2}

    def path_m(self, points_m: Tensor, pulses: slice = slice(None)) -> Tensor:
        """Return the path over points less the reference path, float64 (..., pulse, point).

        Args:
            points_m: Positions of the points in metres, float64 (point, 3).
            pulses: Slice of the pulses.

        Returns:
            Path in metres.
        """
        legs = [torch.linalg.vector_norm(place[..., pulses, None, :] - points_m, dim=-1) for place in self.places]
        return (2 * legs[0] if len(legs) == 1 else legs[0] + legs[1]) - self.reference_m[..., pulses, None]


def broadcast(shapes: Sequence[torch.Size]) -> torch.Size | None:
    """Broadcast shapes.

    Args:
        shapes: The shapes.

    Returns:
        Their common shape, None if there is none.
    """
    try:
        return torch.Size(np.broadcast_shapes(*shapes))
    except ValueError:
        return None


def refuse_unusable(**values: Tensor) -> None:
    """Raise an error for positions or frequencies that are not finite float64 tensors.

    Args:
        **values: Tensors by name.

    Raises:
        TypeError: If one of them is not a float64 tensor; the message has its name.
        ValueError: If one of them has NaN or infinite values.
    """
    for name, value in values.items():
        if not isinstance(value, Tensor) or value.dtype != torch.float64:
            kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
            raise TypeError(
                f"{name} must be a float64 tensor, got {kind}; float32 resolves only 0.06 m at a range of 700 km"
            )
        refuse_non_finite(value, name, "interpolate the gaps of the record", "values")
