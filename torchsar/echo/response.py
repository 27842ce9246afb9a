"""Frequency response of a receiver channel."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, per_trial
from torchsar.echo.recorded import with_samples

Curve = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class ChannelResponse:
    """Impairment: every range spectrum is multiplied by amplitude(u) exp(j phase(u)).

    >>> import torch
    >>> from torchsar import echo
    >>> response = echo.ChannelResponse(phase_rad=lambda u: 2 * u.square())
    >>> phase, amplitude = response.curves(torch.tensor([-1.0, -0.5, 0.0]))
    >>> phase, amplitude
    (tensor([2.0000, 0.5000, 0.0000]), tensor([1., 1., 1.]))

    u is the range frequency divided by half the pulse bandwidth, so that the band is -1..1. Outside
    the band the response has its value at the nearer band edge. Constant and linear parts of the
    phase are applied as well, although no processor can distinguish them from a phase and a shift
    of the scene. The true values are `phase_rad` and `amplitude` at 1025 equally spaced points of
    -1..1.

    Args:
        phase_rad: Function that takes u, shape (n,), float64, and returns the phase in radians,
            shape (n,) or (..., n); None for a phase of 0.
        amplitude: Function that takes u, shape (n,), float64, and returns the positive amplitude,
            shape (n,) or (..., n); None for an amplitude of 1.

    Raises:
        ValueError: When applied, if the amplitude is not positive.
    """

    phase_rad: Curve | None = None
    amplitude: Curve | None = None

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        data, radar = recording.signal.data, recording.radar
        n = data.shape[-1]
        u = torch.fft.fftfreq(n, dtype=torch.float64, device=data.device) * (
            2 * radar.sampling_hz / radar.pulse.bandwidth_hz
        )
        phase, amplitude = self.curves(u.clamp(-1, 1))
        response = torch.polar(amplitude, phase).to(data.dtype)
        impaired = torch.fft.ifft(torch.fft.fft(data) * response[..., None, :])
        phase, amplitude = self.curves(_band(data.device))
        return with_samples(recording, impaired), {"phase_rad": phase, "amplitude": amplitude}

    def curves(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return phase and amplitude of the response.

        Args:
            u: Range frequency divided by half the pulse bandwidth, within -1..1, shape (n,),
                float64.

        Returns:
            Phase in radians and amplitude, shape (n,) or (..., n) each.

        Raises:
            ValueError: If an amplitude is not positive.
        """
        phase = torch.zeros_like(u) if self.phase_rad is None else self.phase_rad(u)
        amplitude = torch.ones_like(u) if self.amplitude is None else self.amplitude(u)
        if not bool((amplitude > 0).all()):
            raise ValueError(
                "amplitude of a channel response must be positive over the whole band, got "
                f"{float(amplitude.detach().min()):.4g}; to cut off a part of the band, reduce the bandwidth of the "
                "pulse"
            )
        phase, amplitude = torch.broadcast_tensors(phase, amplitude)
        return phase, amplitude


def smooth_response(
    quadratic_rad: Tensor | float = 0.0,
    cubic_rad: Tensor | float = 0.0,
    ripple_rad: Tensor | float = 0.0,
    ripple_cycles: Tensor | float = 3.0,
    slope_db: Tensor | float = 0.0,
    amplitude_ripple_db: Tensor | float = 0.0,
) -> ChannelResponse:
    """Build a channel response whose phase and gain vary smoothly over the band.

    >>> import torch
    >>> from torchsar import echo
    >>> response = echo.smooth_response(slope_db=20.0)
    >>> _, amplitude = response.curves(torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64))
    >>> amplitude.round(decimals=2)
    tensor([0.3200, 1.0000, 3.1600], dtype=torch.float64)

    With the range frequency u = -1..1 over the band, the phase in radians is
    quadratic_rad u^2 + cubic_rad u^3 + ripple_rad sin(pi ripple_cycles u), and the gain in dB is
    slope_db u / 2 + amplitude_ripple_db cos(pi ripple_cycles u). The constant and the linear part
    of this phase are removed: they are a phase and a shift of the whole scene, which no processor
    can distinguish from those of the scene itself. Every parameter is a number or a tensor of shape
    (trial,).

    Args:
        quadratic_rad: Quadratic phase at the band edge in radians.
        cubic_rad: Cubic phase at the band edge in radians.
        ripple_rad: Amplitude of the phase ripple in radians.
        ripple_cycles: Cycles of the ripples over the band.
        slope_db: Gain difference of the band edges in dB.
        amplitude_ripple_db: Amplitude of the gain ripple in dB.

    Returns:
        The impairment that multiplies every range spectrum by this response.
    """

    def curve(u: Tensor) -> Tensor:
        quadratic, cubic, ripple, cycles = (
            per_trial(v, 1, u) for v in (quadratic_rad, cubic_rad, ripple_rad, ripple_cycles)
        )
        return quadratic * u.square() + cubic * u**3 + ripple * torch.sin(math.pi * cycles * u)

    def phase(u: Tensor) -> Tensor:
        grid = _band(u.device)
        whole = curve(grid)
        slope = (whole * grid).sum(-1, keepdim=True) / grid.square().sum()
        return curve(u) - whole.mean(-1, keepdim=True) - u * slope

    def amplitude(u: Tensor) -> Tensor:
        slope, ripple, cycles = (per_trial(v, 1, u) for v in (slope_db, amplitude_ripple_db, ripple_cycles))
        return 10 ** ((slope * u / 2 + ripple * torch.cos(math.pi * cycles * u)) / 20)

    return ChannelResponse(phase, amplitude)


def _band(device: torch.device) -> Tensor:
    """Normalised frequencies -1..1 over the band, (1025,), as in `torchsar.repair`."""
    return torch.linspace(-1, 1, 1025, dtype=torch.float64, device=device)
