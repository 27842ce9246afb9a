"""Pulses of another radar in raw lines: parts of lines are marked by their energy, and filled."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchsar.core import Signal, Stage, checked_samples, differentiable, level_of, power_of
from torchsar.repair.fill import band_limited_fill


@torch.no_grad()
def hit_parts(raw: Tensor, parts: int = 32, threshold: float = 3.0) -> Tensor:
    """Mark parts of lines with more energy than the same part of the lines nearby has.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        parts: Number of parts of a line.
        threshold: Least power of a part over the median of 65 lines.

    Returns:
        True for the parts that are hit, shape (..., pulse, part), bool.
    """
    length = -(-raw.shape[-1] // parts)
    power = pad(power_of(raw / level_of(raw)), (0, -raw.shape[-1] % length)).unflatten(-1, (-1, length)).mean(-1)
    half = min(32, power.shape[-2] - 1)
    # lines at the ends are compared with as many lines inside
    around = torch.cat([power[..., 1 : half + 1, :].flip(-2), power, power[..., -half - 1 : -1, :].flip(-2)], -2)
    usual = around.unfold(-2, 2 * half + 1, 1).median(-1).values
    return power > threshold * usual


@differentiable("yes")
def remove_pulses(raw: Tensor, parts: int = 32, threshold: float = 3.0) -> Tensor:
    """Remove pulses of another radar: parts of lines that they hit are filled from other lines.

    >>> import torch
    >>> from torchsar import repair
    >>> raw = torch.randn(1, 256, dtype=torch.complex64).expand(64, -1).clone()  # Doppler zero
    >>> hit = raw.clone()
    >>> hit[10, 40:80] += 30
    >>> bool((repair.remove_pulses(hit) - raw).abs().square().mean() < 1e-3)
    True

    A part of a line is hit if it has clearly more energy than the median of the same part of the
    lines nearby, as a pulse that lasts less than a line makes it in less than half of the lines. A
    target of this power that is seen in fewer than 33 lines is taken for a pulse and removed too.
    Parts are filled as by `band_limited_fill`, which needs a Doppler band below the PRF.
    Interference that lasts whole lines is one for `subtract_interference`. Differentiable in the
    samples that are kept.

    Args:
        raw: Raw lines, shape (..., pulse, range), complex.
        parts: Number of parts of a line.
        threshold: Least power of a part over the median of 65 lines. Clutter reaches 2.5 in parts
            of 12 samples; in parts of 2 samples it exceeds 3 in one of 25 parts.

    Returns:
        Lines of the same shape; parts that are not hit are unchanged.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, a sample is not finite, or an option is not positive.
    """
    raw = checked_samples(raw, "remove_pulses", "pulse, range")
    if not (parts >= 1 and threshold > 1):
        raise ValueError(
            f"remove_pulses: parts must be 1 or more and threshold above 1, got parts {parts} and threshold {threshold}"
        )
    hit, n = hit_parts(raw, parts, threshold), raw.shape[-1]
    length = -(-n // parts)
    blocks = pad(raw, (0, -n % length)).unflatten(-1, (-1, length)).movedim(-2, -3)
    filled = band_limited_fill(blocks, hit.mT).movedim(-3, -2).flatten(-2)[..., :n]
    return torch.where(hit.repeat_interleave(length, -1)[..., :n], filled, raw)


class RemovePulses(Stage):
    """Stage that removes pulses of another radar; see `remove_pulses`.

    Args:
        parts: Number of parts of a line.
        threshold: Least power of a part over the median of the lines nearby.
    """

    def __init__(self, parts: int = 32, threshold: float = 3.0) -> None:
        super().__init__()
        self.parts, self.threshold = parts, threshold

    def forward(self, signal: Signal) -> Signal:
        """Fill the parts of lines that pulses hit.

        Args:
            signal: Raw lines, axes (pulse, range).

        Returns:
            The corrected signal.
        """
        return signal.with_data(remove_pulses(signal.data, self.parts, self.threshold))
