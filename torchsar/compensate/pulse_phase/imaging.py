"""Linear image formation as an autofocus sees it: forward, adjoint, and how a phase per pulse
enters.
"""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor


class Imaging(Protocol):
    """A linear operator from pulses (trial, range, pulse) to an image, with its adjoint.

    Scale is of no account.
    """

    def image(self, rows: Tensor, /) -> Tensor: ...

    def adjoint(self, image: Tensor, /) -> Tensor: ...


class AlongPulses:
    """Fourier transform along pulses, each range cell for itself: the image of a target that turns
    by little.

    oversampling: zero-padding of the transform. Image: (trial, range, Doppler) in FFT order; with
    oversampling 1 the operator is unitary.
    """

    def __init__(self, oversampling: int = 1) -> None:
        self.oversampling = oversampling

    def image(self, rows: Tensor) -> Tensor:
        return torch.fft.fft(rows, self.oversampling * rows.shape[-1], norm="ortho")

    def adjoint(self, image: Tensor) -> Tensor:
        whole = torch.fft.ifft(image, norm="ortho")
        return whole if self.oversampling == 1 else whole[..., : whole.shape[-1] // self.oversampling]


class Through:
    """Any linear image formation of (..., pulse, range) profiles, such as
    `torchsar.focus.PolarOperator`, given as an object with image and adjoint.
    """

    def __init__(self, operator: Imaging) -> None:
        if not (hasattr(operator, "image") and hasattr(operator, "adjoint")):
            raise TypeError(
                "imaging must have `image` and `adjoint`, as torchsar.focus.PolarOperator, got "
                f"{type(operator).__name__}"
            )
        self.operator = operator

    def image(self, rows: Tensor) -> Tensor:
        return self.operator.image(rows.mT)

    def adjoint(self, image: Tensor) -> Tensor:
        return self.operator.adjoint(image).mT
