"""Linear image formation for autofocus: the forward operator and its adjoint."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Imaging(Protocol):
    """A linear operator from pulses to an image, with its adjoint; its scale has no effect.

    Autofocus functions accept any object with these two methods on profiles of shape (..., pulse,
    range), such as `torchsar.focus.PolarOperator`.
    """

    def image(self, rows: Tensor, /) -> Tensor:
        """Form the image of pulses.

        Args:
            rows: Pulses.

        Returns:
            The image.
        """
        ...

    def adjoint(self, image: Tensor, /) -> Tensor:
        """Apply the adjoint operator to an image.

        Args:
            image: The image.

        Returns:
            Pulses.
        """
        ...


class AlongPulses:
    """Fourier transform along pulses, each range cell separately.

    The image of a target whose scatterers do not migrate through range cells. With oversampling 1
    the operator is unitary.

    Args:
        oversampling: Factor by which the pulses are padded with zeros.
    """

    def __init__(self, oversampling: int = 1) -> None:
        self.oversampling = oversampling

    def image(self, rows: Tensor) -> Tensor:
        """Form the image.

        Args:
            rows: Pulses, shape (trial, range, pulse), complex.

        Returns:
            The image, shape (trial, range, Doppler), in FFT order.
        """
        return torch.fft.fft(rows, self.oversampling * rows.shape[-1], norm="ortho")

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint operator.

        Args:
            image: Image, shape (trial, range, Doppler), in FFT order.

        Returns:
            Pulses, shape (trial, range, pulse), complex.
        """
        whole = torch.fft.ifft(image, norm="ortho")
        return whole if self.oversampling == 1 else whole[..., : whole.shape[-1] // self.oversampling]


class Through:
    """Any linear image formation, adapted to pulses of shape (trial, range, pulse).

    Args:
        operator: Object with `image` and `adjoint` of profiles of shape (..., pulse, range), such
            as `torchsar.focus.PolarOperator`.

    Raises:
        TypeError: If the operator lacks one of the two methods.
    """

    def __init__(self, operator: Imaging) -> None:
        if not (hasattr(operator, "image") and hasattr(operator, "adjoint")):
            raise TypeError(
                "imaging must have `image` and `adjoint`, as torchsar.focus.PolarOperator, got "
                f"{type(operator).__name__}"
            )
        self.operator = operator

    def image(self, rows: Tensor) -> Tensor:
        """Form the image.

        Args:
            rows: Pulses, shape (trial, range, pulse), complex.

        Returns:
            The image of the operator.
        """
        return self.operator.image(rows.mT)

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint operator.

        Args:
            image: Image of the operator.

        Returns:
            Pulses, shape (trial, range, pulse), complex.
        """
        return self.operator.adjoint(image).mT
