"""Ways in which the matched Fourier transform can compute its sum over pulses.

Each way is an object that holds its settings. Its method `build` makes the linear map from given
pulses to image lines.

Reference:
    Fessler and Sutton 2003 (gridding); Remote Sens. 2025, 17, 3447, Eqs. (9)-(10).
"""

from __future__ import annotations

from dataclasses import dataclass

from torchsar.core.nufft import Kernel
from torchsar.focus.warped_sums import PulsesToLines, Sum, compiled, explicit, gridded, resampled


@dataclass(frozen=True)
class Gridding:
    """Sum over pulses by a non-uniform FFT with a Kaiser-Bessel gridding kernel, the default.

    >>> import torch
    >>> from torchsar import focus
    >>> pulses, k = torch.ones(64, 1, dtype=torch.complex64), torch.tensor([1.0])
    >>> ways = focus.Gridding(taps=4), focus.ExplicitSum()
    >>> image, exact = (focus.matched_fourier(pulses, k, 100.0, transform=way) for way in ways)
    >>> bool((image - exact).norm() < 1e-3 * exact.norm())
    True

    Give the width `taps` or the relative error `eps`, not both. The default suits images in
    complex64. For searches that compare the entropy of images, 4 taps suffice: their error of the
    entropy is below 1.5e-4 nat.

    Args:
        taps: Width of the kernel in grid points, 2 to 16.
        eps: Relative error of the image, 1e-13 to 0.1; 1e-6 where neither is given. The narrowest
            kernel of an even width is chosen.
        oversampling: Grid points per image line, 1.25 to 2. None chooses 2 where `taps` is given;
            otherwise 1.5, the fastest, or 2 where 1.5 does not reach `eps`.

    Raises:
        ValueError: If both `taps` and `eps` are given, or one value lies outside its range.
    """

    taps: int | None = None
    eps: float | None = None
    oversampling: float | None = None

    def __post_init__(self) -> None:
        if self.taps is not None and self.eps is not None:
            raise ValueError(f"Gridding takes either taps or eps, not both, got taps={self.taps} and eps={self.eps}")
        _ = self.kernel

    @property
    def kernel(self) -> Kernel:
        """Kaiser-Bessel kernel of the given width or relative error."""
        if self.taps is not None:
            return Kernel(self.taps, 2.0 if self.oversampling is None else self.oversampling)
        # below 1e-6 the rounding of complex64 data begins to dominate
        eps, oversampling = 1e-6 if self.eps is None else self.eps, self.oversampling
        if oversampling is None:
            oversampling = 1.5 if eps > Kernel(16, 1.5).error else 2.0
        return Kernel.of(eps, oversampling, even=True)

    def build(self, of: PulsesToLines) -> Sum:
        """Build the linear map from pulses to image lines, which also has its adjoint.

        Args:
            of: Pulses and image lines of the transform.

        Returns:
            The map.
        """
        return gridded(of, self.kernel)


@dataclass(frozen=True)
class ExplicitSum:
    """Sum over pulses by direct evaluation: exact and slow, the reference for faster ways.

    >>> import torch
    >>> from torchsar import focus
    >>> pulses, k = torch.ones(64, 1, dtype=torch.complex64), torch.zeros(0)
    >>> image = focus.matched_fourier(pulses, k, 100.0, transform=focus.ExplicitSum())
    >>> image[62:67, 0].abs().round(decimals=3)
    tensor([0.0000, 5.0930, 8.0000, 5.0930, 0.0000])
    """

    def build(self, of: PulsesToLines) -> Sum:
        """Build the linear map from pulses to image lines, which also has its adjoint.

        Args:
            of: Pulses and image lines of the transform.

        Returns:
            The map.
        """
        return explicit(of)


@dataclass(frozen=True)
class Resampling:
    """Sum over pulses by interpolation to equal steps of rotation angle, then an FFT: a baseline.

    >>> import torch
    >>> from torchsar import focus
    >>> pulses, k = torch.exp(1.5j * torch.arange(64)[:, None]), torch.tensor([1.0])
    >>> exact = focus.matched_fourier(pulses, k, 100.0, transform=focus.ExplicitSum())
    >>> image = focus.matched_fourier(pulses, k, 100.0, transform=focus.Resampling("linear"))
    >>> round(float((image - exact).norm() / exact.norm()), 3)  # relative error
    0.199

    It loses accuracy towards the edge of the Doppler band: for targets whose Doppler reaches 93 %
    of half the pulse rate, the relative error of the image is 0.20 (linear) and 0.077 (spline).

    Args:
        interpolation: "linear", or "spline" for the not-a-knot cubic spline.

    Raises:
        ValueError: If `interpolation` is neither of the two.
    """

    interpolation: str = "spline"

    def __post_init__(self) -> None:
        if self.interpolation not in ("linear", "spline"):
            raise ValueError(
                f"interpolation {self.interpolation!r} of the pulses is not known; choose 'linear' or 'spline'"
            )

    def build(self, of: PulsesToLines) -> Sum:
        """Build the linear map from pulses to image lines, which also has its adjoint.

        Args:
            of: Pulses and image lines of the transform.

        Returns:
            The map.
        """
        return resampled(of, self.interpolation)


@dataclass(frozen=True)
class CompiledNufft:
    """Sum over pulses by the compiled library finufft, in float64 on the CPU.

    >>> from torchsar import focus, radar
    >>> ladar = radar.InverseRadar(carrier_hz=193.4e12, bandwidth_hz=150e9, prf_hz=2000.0)
    >>> focus.MatchedFourier(ladar, transform=focus.CompiledNufft(eps=1e-9)).transform
    CompiledNufft(eps=1e-09)

    It gives first derivatives only. Needs the extra `nufft`: pip install 'torchsar-lab[nufft]'.

    Args:
        eps: Relative error of the image; None for that of the default `Gridding`.
    """

    eps: float | None = None

    def build(self, of: PulsesToLines) -> Sum:
        """Build the linear map from pulses to image lines, which also has its adjoint.

        Args:
            of: Pulses and image lines of the transform.

        Returns:
            The map.

        Raises:
            ModuleNotFoundError: If finufft is not installed.
        """
        return compiled(of, Gridding().kernel.error if self.eps is None else self.eps)


# ways of computing the sum that `matched_fourier` accepts
Transform = Gridding | ExplicitSum | Resampling | CompiledNufft
