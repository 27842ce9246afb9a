"""Periodic sampling jitter of a converter, and its pilot record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, linear_phasor, unit_phasor
from torchsar.echo.recorded import noise, with_samples
from torchsar.scene.trials import finite_numbers, refuse_other_trials, stacked, with_dims


def sample_unevenly(x: Tensor, offset_samples: Tensor) -> Tensor:
    """Take sample n of every line at the instant n + e[n mod M], with the M offsets e.

    Args:
        x: Lines, shape (..., pulse, range), complex, taken as band-limited and periodic.
        offset_samples: Offsets e in samples, shape (M,) or (..., M).

    Returns:
        Unevenly sampled lines of the shape of x.
    """
    n, m = x.shape[-1], offset_samples.shape[-1]
    spectrum = torch.fft.fft(x)
    y = torch.empty_like(x)
    for i in range(min(m, n)):
        turns = offset_samples[..., i].to(torch.float64) / n
        shift = torch.fft.ifftshift(linear_phasor(turns, -(n // 2), n, x.dtype), dim=-1)
        y[..., i::m] = torch.fft.ifft(spectrum * shift[..., None, :])[..., i::m]
    return y


@dataclass(frozen=True)
@finite_numbers()
class PeriodicJitter:
    """Impairment: sample n of every line is taken at the instant n + e[n mod M], with M offsets e.

    >>> from torchsar import Draws, echo, radar, scene
    >>> strip = radar.StripmapRadar(3e9, radar.LinearFM(40e6, 5e-7), 50e6, 400.0, 120.0, 4000.0)
    >>> world = scene.StripmapWorld(scene.Points([0.0], [0.0]))
    >>> errors = {"jitter": echo.PeriodicJitter(offset_samples=[0.0, 0.1])}
    >>> recording, truth = echo.simulate(strip, world, 8, 64, Draws(1), errors)
    >>> recording.aux["pilot"].shape, truth.values["jitter.offset_samples"]
    (torch.Size([4096]), tensor([0.0000, 0.1000], dtype=torch.float64))

    A pilot tone through the same converter is recorded as aux `pilot`, shape (..., pilot_samples).
    Its phase is random, so that it shows only the differences between the offsets; an offset that
    is common to all samples cannot be estimated from it. Where positions in images are compared,
    therefore choose offsets of mean zero, or e_0 = 0 if the estimator sets its first offset to
    zero. The truth holds `offset_samples`, shape (..., M), and `pilot_cycles`.

    Args:
        offset_samples: Offsets e_0 to e_{M-1} in samples: numbers or values per trial, or one
            tensor of shape (..., M).
        pilot_cycles: Frequency of the pilot tone in cycles per sample.
        pilot_samples: Length of the pilot record, 0 for none, fixed for all trials.
        pilot_snr_db: Power of the pilot tone over the noise variance in decibels, None for no
            noise.

    Raises:
        ValueError: If there is no offset, the length is negative or a number is not finite; when
            applied, if sample instants coincide or cross.
    """

    offset_samples: Sequence[Tensor | float] | Tensor
    pilot_cycles: Tensor | float = 0.2137
    pilot_samples: int = 4096
    pilot_snr_db: Tensor | float | None = 60.0

    def __post_init__(self) -> None:
        if not len(self.offset_samples) or self.pilot_samples < 0:
            raise ValueError(
                "jitter needs at least one entry of offset_samples and a value of pilot_samples of 0 or more, "
                f"got offset_samples={self.offset_samples} and pilot_samples={self.pilot_samples}"
            )

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, dict[str, Tensor]]:
        refuse_other_trials(self, draws, recording)
        data = recording.signal.data
        offsets = stacked(self.offset_samples, data.device)
        instants = torch.arange(offsets.shape[-1], device=data.device) + offsets
        if not bool((torch.cat([instants, instants[..., :1] + offsets.shape[-1]], -1).diff(dim=-1) > 0).all()):
            raise ValueError(
                f"jitter offsets {offsets.tolist()} make sample instants coincide or cross; keep "
                "neighbouring offsets less than one sample apart"
            )
        pilot = {"pilot": self.pilot(offsets, draws, data)} if self.pilot_samples else {}
        return with_samples(recording, sample_unevenly(data, offsets), **pilot), {
            "offset_samples": offsets,
            "pilot_cycles": torch.as_tensor(self.pilot_cycles, dtype=torch.float64),
        }

    def pilot(self, offsets: Tensor, draws: Draws, like: Tensor) -> Tensor:
        """Return the pilot tone as sampled with the jitter.

        Args:
            offsets: Offsets of the M sampling instants in samples, shape (..., M), float64.
            draws: Random draws.
            like: Tensor that gives dtype and device.

        Returns:
            Tone, shape (..., pilot_samples), complex.
        """
        index = torch.arange(self.pilot_samples, device=like.device)
        turns = with_dims(self.pilot_cycles, 1, offsets) * (index + offsets[..., index % offsets.shape[-1]])
        tone = unit_phasor(turns + draws.uniform("pilot.phase", device=like.device)[..., None], like.dtype)
        if self.pilot_snr_db is None:
            return tone
        std = torch.as_tensor(
            10 ** (-with_dims(self.pilot_snr_db, 0, offsets) / 20), dtype=torch.float64, device=like.device
        )
        return tone + noise(draws, "pilot.noise", (self.pilot_samples,), std, like.dtype, like.device)
