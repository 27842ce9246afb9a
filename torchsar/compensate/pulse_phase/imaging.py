"""Linear image formation for autofocus: operators from pulses to an image, and their adjoints."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Imaging(Protocol):
    """A linear image formation for autofocus: an operator from pulses to an image, and its adjoint.

    Autofocus functions accept any object with the methods `image` and `adjoint` for profiles of
    shape (..., pulse, range), such as `torchsar.focus.PolarOperator`. A constant factor in the
    operator has no effect.
    """

    def image(self, rows: Tensor, /) -> Tensor:
        """Form the image of range-compressed pulses.

        Args:
            rows: Pulses, complex, in the layout of the operator, such as (..., pulse, range).

        Returns:
            The image, complex, in the layout of the operator.
        """
        ...

    def adjoint(self, image: Tensor, /) -> Tensor:
        """Apply the adjoint of the image formation, which maps an image to pulses.

        Args:
            image: Image, complex, in the layout in which `image` returns it.

        Returns:
            Pulses, complex, in the layout in which `image` takes them.
        """
        ...


class AlongPulses:
    """Image formation by a Fourier transform along pulses, of each range cell separately.

    It suits a target whose scatterers do not migrate through range cells. With oversampling 1 the
    operator is unitary.

    Args:
        oversampling: Factor by which the pulses are padded with zeros.
    """

    def __init__(self, oversampling: int = 1) -> None:
        self.oversampling = oversampling

    def image(self, rows: Tensor) -> Tensor:
        """Form the image by a Fourier transform along pulses.

        Args:
            rows: Pulses, shape (trial, range, pulse), complex.

        Returns:
            The image, shape (trial, range, Doppler), complex, with Doppler in FFT order.
        """
        return torch.fft.fft(rows, self.oversampling * rows.shape[-1], norm="ortho")

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint of the Fourier transform along pulses, which maps an image to pulses.

        Args:
            image: Image, shape (trial, range, Doppler), complex, with Doppler in FFT order.

        Returns:
            Pulses, shape (trial, range, pulse), complex.
        """
        whole = torch.fft.ifft(image, norm="ortho")
        return whole if self.oversampling == 1 else whole[..., : whole.shape[-1] // self.oversampling]


class Through:
    """Adapter that lets an image formation for pulses (..., pulse, range) take (..., range, pulse).

    Args:
        operator: Object with the methods `image` and `adjoint` for profiles of shape (..., pulse,
            range), such as `torchsar.focus.PolarOperator`.

    Raises:
        TypeError: If the operator lacks one of the two methods.
    """

    def __init__(self, operator: Imaging) -> None:
        if not (hasattr(operator, "image") and hasattr(operator, "adjoint")):
            raise TypeError(
                "imaging must have the methods `image` and `adjoint`, as torchsar.focus.PolarOperator has, "
                f"got {type(operator).__name__}"
            )
        self.operator = operator

    def image(self, rows: Tensor) -> Tensor:
        """Form the image of pulses with the wrapped operator.

        Args:
            rows: Pulses, shape (trial, range, pulse), complex.

        Returns:
            The image, as the operator returns it.
        """
        return self.operator.image(rows.mT)

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the adjoint of the wrapped operator, which maps an image to pulses.

        Args:
            image: Image, as the operator returns it.

        Returns:
            Pulses, shape (trial, range, pulse), complex.
        """
        return self.operator.adjoint(image).mT
