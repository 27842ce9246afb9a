"""Whether an estimated phase can be believed: how sharp the image became beyond what noise allows,
and how well halves of the rows agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import Pulses, rotate
from torchsar.core import Estimate, block_bytes_of, over_blocks
from torchsar.metrics.phase import phase_rmse

# entropy that the exponential distribution of a speckle cell's power lacks
SPECKLE_NATS = 1 - 0.5772156649015329
LEAST_STREHL = 0.8
_MARGIN = 1.5
_LEAST_ROWS = 1.5
_ROUNDS = 6
_FAR_RAD = 0.1

Again = Callable[[Tensor, Tensor, Tensor], Tensor]
Found = tuple[Tensor, Tensor, Again]
Find = Callable[[Tensor, Tensor, Tensor | None], Found]


def sharpness_beyond_speckle(image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Entropy (nats) that an image (..., range, Doppler) lacks against speckle of the same row
    energies, (...,).

    An image whose rows are circular noise has 0 before any phase is fitted to it. Also returns over
    how many rows its energy is spread, and over how many rows the sharpness is (1 where one bright
    row makes all of it).
    """
    real, imag = image.real.contiguous(), image.imag.contiguous()
    power = real * real + imag * imag
    row = power.sum(-1)
    tiny = torch.finfo(power.dtype).tiny
    # entropy of a row: ln(sum p) - sum p ln p / sum p
    entropy = torch.log(row.clamp_min(tiny)) - (power * torch.log(power.clamp_min(tiny))).sum(-1) / _or_one(row)
    row, entropy = row.to(torch.float64), entropy.to(torch.float64)
    share = row / _or_one(row.sum(-1, keepdim=True))
    lack = share * torch.where(row > 0, math.log(image.shape[-1]) - SPECKLE_NATS - entropy, 0)
    sharp = lack.sum(-1)
    return sharp, 1 / _or_one(share.square().sum(-1)), sharp.square() / _or_one(lack.square().sum(-1))


def sharpness_of_noise(rows: Tensor) -> Tensor:
    """The same lack of entropy (nats) that the sharpest image of pure noise reaches, for an
    effective number of rows.

    Measured with the entropy fixed point on circular noise of 4 to 1024 rows and 64 to 1600 pulses
    (0.94, 0.29, 0.10, 0.045, 0.019 nats at 4, 16, 64, 256, 1024 rows; the number of pulses hardly
    matters); this fit is within 15 %.
    """
    return 0.62 / torch.sqrt(rows) + 2.1 / rows


def occupied_band(rows: Tensor) -> Tensor:
    """Share of the range band that rows (trial, range, pulse) fill, (trial,): 1 / 4 of them are
    independent in noise that is sampled four times too finely.
    """
    spectrum = torch.fft.fft(rows, dim=-2)
    density = (spectrum.real.square() + spectrum.imag.square()).mean(-1, dtype=torch.float64)
    return torch.where(density.sum(-1) > 0, density.mean(-1).square() / _or_one(density.square().mean(-1)), 1)


def estimated(pulses: Pulses, start: Tensor | None, find: Find, at_rest: bool = False) -> Estimate:
    """Find a phase and judge it, by blocks of trials that stay in the cache (all at once where
    gradients are wanted).

    find(rows, present, start): phase (trial, pulse), iterations taken (trial,), and `again`: what a
    method finds from some of the rows beginning with a phase. It is run on two halves of the rows,
    dealt out by their energy, whose noise is independent (less so where range is sampled finer than
    the band asks for, which `occupied_band` makes up for): half of the difference of both, and how
    far it moves away on all rows (nothing where the phase is at_rest under it), make the predicted
    deviation. ok: the image is 1.5 times sharper than noise can be made, more than one row carries
    it, and the deviation promises a Strehl ratio of 0.8. quality: that ratio, times the share of
    the sharpness that noise does not explain. A pulse without samples has no phase of its own and
    is marked in info["present"].
    """
    rows, present = pulses.rows, pulses.present
    if not len(rows) or pulses.n < 3:
        return _gathered(pulses, [_nothing(rows)])
    if len(rows) == 1 or (rows.requires_grad and torch.is_grad_enabled()):
        return _gathered(pulses, [_judged(rows, present, start, find, at_rest)])
    height = max(1, block_bytes_of(rows.device) // (rows[0].numel() * rows.element_size()))
    parts = [slice(first, first + height) for first in range(0, len(rows), height)]
    done: dict[int, tuple[Tensor, ...]] = {}

    def work(part: slice) -> None:
        done[part.start] = _judged(rows[part], present[part], None if start is None else start[part], find, at_rest)

    with torch.no_grad():
        over_blocks(work, parts, rows)
    return _gathered(pulses, [done[part.start] for part in parts])


def _judged(rows: Tensor, present: Tensor, start: Tensor | None, find: Find, at_rest: bool) -> tuple[Tensor, ...]:
    """Phase, iterations, sharpness, rows of the energy and of the sharpness, deviation of every
    trial.
    """
    phase, taken, again = find(rows, present, start)
    with torch.no_grad():
        sharp, effective, telling = sharpness_beyond_speckle(torch.fft.fft(rotate(rows, phase), norm="ortho"))
        occupied = occupied_band(rows)
        deviation = _disagreement(rows, present, phase, again) / occupied.sqrt()
        if not at_rest:
            deviation = torch.hypot(deviation, _drift(rows, present, phase, again))
    return phase, taken, sharp, effective * occupied, telling, deviation


def _nothing(rows: Tensor) -> tuple[Tensor, ...]:
    """What `_judged` would return where no phase can be found: too few pulses, or no trials."""
    zero = torch.zeros(len(rows), dtype=torch.float64, device=rows.device)
    return rows[:, 0].real * 0, zero.long(), zero, zero, zero, zero + math.pi / math.sqrt(3)


def _gathered(pulses: Pulses, parts: Sequence[tuple[Tensor, ...]]) -> Estimate:
    phase, taken, sharp, effective, telling, deviation = (torch.cat(pieces) for pieces in zip(*parts, strict=True))
    present, shape = pulses.present, pulses.trials
    noise = sharpness_of_noise(effective.clamp_min(1))
    learnable = present.sum(-1) >= 3
    promised = torch.exp(-deviation.square())
    quality = torch.where(learnable, promised * (1 - (noise / sharp.clamp_min(1e-12)).clamp(0, 1)), 0)
    ok = learnable & (sharp > _MARGIN * noise) & (telling > _LEAST_ROWS) & (promised > LEAST_STREHL)
    phase = torch.where(learnable[:, None], phase, 0)
    info = {
        "iterations": taken,
        "sharpness_nats": sharp,
        "noise_sharpness_nats": noise,
        "effective_rows": effective,
        "telling_rows": telling,
    }
    std = deviation[:, None].expand(-1, pulses.n).to(phase.dtype)
    return Estimate(
        value={"phase_rad": phase.reshape(*shape, pulses.n)},
        std={"phase_rad": std.reshape(*shape, pulses.n)},
        quality=quality.reshape(shape).to(phase.dtype),
        ok=ok.reshape(shape),
        info={
            "present": present.reshape(*shape, pulses.n),
            **{name: value.reshape(shape) for name, value in info.items()},
        },
    )


def _disagreement(rows: Tensor, present: Tensor, phase: Tensor, again: Again) -> Tensor:
    """Half of the rms difference (rad) between the phases from two halves of the rows, (trial,); pi
    / sqrt(3) where there is but one.
    """
    if rows.shape[-2] < 2:
        return torch.full(rows.shape[:1], math.pi / math.sqrt(3), dtype=torch.float64, device=rows.device)
    order = (rows.real.square() + rows.imag.square()).sum(-1).argsort(-1, descending=True)
    halves = (order[:, part::2].sort(-1).values for part in (0, 1))
    one, other = (
        again(rows.gather(1, half[..., None].expand(-1, -1, rows.shape[-1])), present, phase) for half in halves
    )
    return phase_rmse(one, other, present) / 2


def _drift(rows: Tensor, present: Tensor, phase: Tensor, again: Again) -> Tensor:
    """How far (rad rms) `again` moves a phase on all rows, (trial,): once, then on while it goes
    far and the phase might still pass as good.

    Dense targets move slowly: PGA on 256 scatterers a row errs by 0.8 rad, of which the first round
    shows 0.3.
    """
    place, total = phase, torch.zeros(len(phase), dtype=torch.float64, device=phase.device)
    going = torch.ones_like(total, dtype=torch.bool)
    for _ in range(_ROUNDS):
        reached = again(rows, present, place)
        step = phase_rmse(reached, place, present)
        total = torch.where(going, phase_rmse(reached, phase, present), total)
        going = going & (step > _FAR_RAD) & (torch.exp(-total.square()) > LEAST_STREHL)
        if not bool(going.any()):
            break
        place = reached
    return total


def _or_one(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 1)
