"""A channel whose phase and gain depend on range frequency."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Draws, Recording

Curve = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class ChannelResponse:
    """Every range spectrum is multiplied by amplitude(u) exp(j phase(u)), u = f / (pulse bandwidth
    / 2).

    phase_rad, amplitude: functions of a float64 tensor u (n,), giving (n,) or one row per trial
    (..., n); None leaves that part alone. They are asked for u within -1..1 only: outside the band
    the edge values hold. A constant or linear part of the phase is applied as given, though no
    processor can tell it from a phase and a shift of the scene.
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
        """Phase and amplitude at u, float64, of one shape.

        The truth holds them on 1025 points of -1..1.
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
