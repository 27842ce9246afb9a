"""Test if a part of the pulses gets sharper with phases of its own than noise would.

A part is a block of neighbouring range cells, or the energy that the phases leave unfocused. This
detects a second motion, and a scene that is weaker than an echo at rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, pair_phase, rotate
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.sharpness import sharpness_beyond_speckle, sharpness_of_noise
from torchsar.core import power_of


def gain_of_parts(rows: Tensor, present: Tensor, phase: Tensor) -> Tensor:
    """Compute how much sharper blocks of neighbouring range cells get with phases of their own.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phases of all range cells in rad, shape (trial, pulse).

    Returns:
        The largest gain of three blocks in units of the sharpness that autofocus makes of noise in
        as many range cells, shape (trial,), float64.
    """
    # three blocks separate correct trials best from those with a second motion
    blocks = [_strongest(block, power_of(block)) for block in rows.tensor_split(3, -2) if block.shape[-2]]
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    return torch.stack([zero, *(_gain(block, present, phase, 12)[0] for block in blocks)]).amax(0)


def gain_of_rest(rows: Tensor, present: Tensor, phase: Tensor) -> Tensor:
    """Compute how much sharper the unfocused part of an image gets with phases of its own.

    The unfocused part is what remains of the image after its brightest cells are removed. If the
    phases are correct, it is noise or the weak part of an extended scene. If the phases follow a
    constant, a tone or ground at rest, these are focused to a line within a twelfth of the Doppler
    band, and the scene remains.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False where a pulse holds only zeros, shape (trial, pulse).
        phase: Phases of the pulses in rad, shape (trial, pulse).

    Returns:
        The gain in units of the sharpness that autofocus makes of noise in as many range cells,
        shape (trial,), float64. It is 0 where most of the bright energy is not in such a line. It
        is also 0 where the phases of the remaining part are as linear as the given phases: the
        remaining part is then at rest, or both parts move.
    """
    # tapered, so that no side lobes of a strong echo remain
    taper = torch.hann_window(rows.shape[-1], periodic=False, dtype=rows.real.dtype, device=rows.device)
    image = torch.fft.fft(rotate(rows, phase) * taper, norm="ortho")
    power = power_of(image)
    # some of the rows are enough to estimate the level of noise
    some = power[:, :: max(1, rows.shape[-2] // 64)]
    limit = torch.full_like(some[:, :1, :1], torch.inf)
    for _ in range(6):
        low = some < limit
        limit = 6 * (some * low).sum((-2, -1), keepdim=True) / low.sum((-2, -1), keepdim=True).clamp_min(1)
    left = power < limit  # a cell of noise exceeds the limit with probability exp(-6)
    # neighbours are removed too, because the main lobe of the taper is four cells wide
    left = left & left.roll(1, -1) & left.roll(-1, -1)
    bright, width = (power * ~left).sum(-2), min(rows.shape[-1], max(8, round(0.08 * rows.shape[-1])))
    near = torch.cat([bright, bright[:, :width]], -1).cumsum(-1)
    line = (near[:, width:] - near[:, :-width]).amax(-1) > 0.5 * near[:, bright.shape[-1] - 1]
    rest = _strongest(image * left, power * left)
    rest = rotate(torch.fft.ifft(rest, norm="ortho"), -phase) * present[:, None]
    gain, own = _gain(rest, present, phase, 6)
    found, of_rest = (_straightness(at, present) for at in (phase, own))
    # the margin is needed because white phases hardly differ in this measure
    moves = 1 - found.square() < 0.9 * (1 - of_rest.square())
    return torch.where(line & moves, gain, 0)


def _strongest(rows: Tensor, power: Tensor) -> Tensor:
    """Select at most 48 rows (trial, range, pulse) with the most energy."""
    index = power.sum(-1).topk(min(48, rows.shape[-2]), -1).indices
    return rows.gather(-2, index[..., None].expand(-1, -1, rows.shape[-1]))


def _gain(rows: Tensor, present: Tensor, phase: Tensor, iterations: int) -> tuple[Tensor, Tensor]:
    """Gain in sharpness (trial,) of pulses with phases of their own, and these phases."""
    run = Run(LogAbove(2.5), AlongPulses(), iterations, 1.8, 0.0)
    own = fixed_point(rows, pair_phase(rows, present), run)[0]
    images = (torch.fft.fft(rotate(rows, at), norm="ortho") for at in (own, phase))
    (alone, count, _), (common, _, _) = (sharpness_beyond_speckle(image) for image in images)
    return (alone - common) / sharpness_of_noise(count.clamp_min(1)), own


def _straightness(phase: Tensor, present: Tensor) -> Tensor:
    """Largest magnitude of the spectrum of exp(j phase), (trial,); 1 for a linear phase."""
    phasor = torch.polar(present.to(phase.dtype), phase)
    return torch.fft.fft(phasor, 2 * phase.shape[-1]).abs().amax(-1) / or_one(present.sum(-1))
