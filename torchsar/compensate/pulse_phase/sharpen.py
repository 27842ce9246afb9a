"""Fixed points that sharpen the image: entropy (EFP), and the phase of each pulse against a Wiener
estimate of the scene from the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, rotate, safe_angle, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.verdict import Found, estimated
from torchsar.core import Estimate, cis

Weights = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Run:
    """Fixed-point iterations with one kind of weights: weights(power, its mean) -> real weights of
    the cells.

    relaxation: share of the phase step that is taken. A trial ends after `iterations`, or once its
    step is below tolerance_rad (rms over its pulses).
    """

    weights: Weights
    imaging: Imaging
    iterations: int
    relaxation: float
    tolerance_rad: float


def fixed_point(rows: Tensor, phase: Tensor, run: Run) -> tuple[Tensor, Tensor]:
    """psi <- psi + relaxation * arg sum_n x conj(A^H (w A x)), x = rows exp(-j psi).

    Phase (trial, pulse) and iterations taken (trial,).
    """
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    taken = torch.zeros_like(active, dtype=torch.int64)
    mirrored = rows.conj().resolve_conj()
    for _ in range(run.iterations):
        step = run.relaxation * _phase_step(rows, mirrored, phase, run)
        phase = torch.where(active[:, None], phase + step, phase)
        taken = taken + active
        active = active & (step.detach().square().mean(-1) > run.tolerance_rad**2)
        if not bool(active.any()):
            break
    return phase, taken


def _phase_step(rows: Tensor, mirrored: Tensor, phase: Tensor, run: Run) -> Tensor:
    """arg sum_n x conj(model), with the turn of x taken out of the sum over rows.

    mirrored: the conjugate of rows.
    """
    image = run.imaging.image(rotate(rows, phase))
    model = run.imaging.adjoint(weighted(image, run.weights))
    products = mirrored * model if model.requires_grad else model.mul_(mirrored)
    return -safe_angle(products.sum(-2) * cis(phase))


def weighted(image: Tensor, weights: Weights) -> Tensor:
    """w(p / mean p) * image with p = |image|^2: real and imaginary parts apart, which on a CPU is
    three times as fast as complex by real.
    """
    real, imag = image.real.contiguous(), image.imag.contiguous()
    power = torch.addcmul(real * real, imag, imag)
    mean = power.mean((-2, -1), keepdim=True)
    weight = weights(power, torch.where(mean > 0, mean, 1))
    if image.requires_grad:
        return torch.complex(real * weight, imag * weight)
    return torch.complex(real.mul_(weight), imag.mul_(weight))


@dataclass(frozen=True)
class LogAbove:
    """ln(max(p, floor) / floor): the gradient of the entropy for cells above the floor (times the
    mean power; a number or (trial, 1, 1)), nothing below it.
    """

    floor: float | Tensor

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        return torch.log((power * (1 / (self.floor * mean))).clamp_min(1))


@dataclass(frozen=True)
class Wiener:
    """(p / (p + level * mean p))^2 of powers averaged over three range cells, less the mean of its
    row.

    Small where a cell holds no more than noise, constant where it holds much: a Wiener filter with
    the local power as its prior. Without its mean the filter leaves a pulse out of the scene that
    it is compared with, to first order, and steps need no relaxation.
    """

    level: float = 2.0

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        pairs = power + power.roll(1, -2)
        local = pairs + pairs.roll(-1, -2)
        share = local / (local + 4 * self.level * mean)
        weight = share * share
        return weight - weight.mean(-1, keepdim=True)


def entropy_fixed_point(
    data: Tensor,
    *,
    start: Tensor | None = None,
    floors: Sequence[tuple[float, int]] = ((5.0, 12), (2.0, 12)),
    relaxation: float = 1.8,
    tolerance_rad: float = 1e-3,
    imaging: Imaging | None = None,
) -> Estimate:
    """Entropy fixed point (brief 002, section 7), with value["phase_rad"] (..., pulse) to be
    removed. data: (..., pulse, range) complex.

    Image, weights ln(max(p, floor) / floor) of its cells (p over its mean), back to pulses, phase
    of each pulse against that: two transforms an iteration, no peaks, no windows. start: (...,
    pulse) rad, by default that of `sca`, with which the result is equivariant. floors: (floor,
    iterations) one after another; a trial passes on to the next once its steps are below
    tolerance_rad rms. relaxation: over 1 it helps past local minima, 2 or more need not converge.
    imaging: the image formation to sharpen, by default a transform along pulses; any object with
    `image` and `adjoint` of (..., pulse, range) profiles, such as `torchsar.focus.PolarOperator`.
    Differentiable. Raises TypeError or ValueError for samples that are not finite and complex, a
    start of another shape, floors that are not positive.
    """
    pulses = prepare(data, "entropy_fixed_point")
    if not floors or not all(floor > 0 and count >= 1 for floor, count in floors) or not 0 < relaxation < 2:
        raise ValueError(
            "entropy_fixed_point needs floors above 0 with one iteration or more each and a "
            f"relaxation in 0..2, got {list(floors)} and {relaxation}"
        )
    operator = AlongPulses() if imaging is None else Through(imaging)
    runs = [Run(LogAbove(floor), operator, count, relaxation, tolerance_rad) for floor, count in floors]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> Found:
        phase, taken = in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)
        return phase, taken, settled

    return estimated(pulses, starting_phase(start, pulses, "entropy_fixed_point"), find, at_rest=True)


def in_turn(rows: Tensor, phase: Tensor, runs: Sequence[Run]) -> tuple[Tensor, Tensor]:
    """One run after another: phase (trial, pulse) and iterations taken (trial,)."""
    total = torch.zeros_like(phase[:, 0], dtype=torch.int64)
    for run in runs:
        phase, taken = fixed_point(rows, phase, run)
        total = total + taken
    return phase, total


def settled(rows: Tensor, present: Tensor, phase: Tensor) -> Tensor:
    """Where the entropy takes a phase in four steps, by which other estimates are judged."""
    return fixed_point(rows, phase, Run(LogAbove(2.5), AlongPulses(), 4, 1.8, 0.0))[0]
