"""Frequency response of a receiver channel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording

Curve = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class ChannelResponse:
    """Impairment: every range spectrum is multiplied by amplitude(u) exp(j phase(u)).

    u is the range frequency over half the pulse bandwidth. The functions are evaluated within -1..1
    only; outside the band their values at its edges hold. Constant and linear parts of the phase
    are applied as well, although no processor can distinguish them from a phase and a shift of the
    scene. The truth holds `phase_rad` and `amplitude` at 1025 points of -1..1.

    Args:
        phase_rad: Function of u, shape (n,), float64, that returns the phase in radians, shape (n,)
            or (..., n); None for zero.
        amplitude: Function of u that returns the positive amplitude, in the same form; None for
            one.

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
        phase, amplitude = self.curves(torch.linspace(-1, 1, 1025, dtype=torch.float64, device=data.device))
        return replace(recording, signal=recording.signal.with_data(impaired)), {
            "phase_rad": phase,
            "amplitude": amplitude,
        }

    def curves(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return phase and amplitude.

        Args:
            u: Normalised frequency within -1..1, shape (n,), float64.

        Returns:
            Phase in radians and amplitude, shape (n,) or (..., n) each.

        Raises:
            ValueError: If an amplitude is not positive.
        """
        phase = torch.zeros_like(u) if self.phase_rad is None else self.phase_rad(u)
        amplitude = torch.ones_like(u) if self.amplitude is None else self.amplitude(u)
        if not bool((amplitude > 0).all()):
            raise ValueError(
                "the amplitude response must be positive over the whole band; a band that is cut off "
                "belongs to the pulse"
            )
        phase, amplitude = torch.broadcast_tensors(phase, amplitude)
        return phase, amplitude
