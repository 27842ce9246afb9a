"""Fixed-point iterations that sharpen the image by correcting the phase of every pulse.

Each iteration weights the cells of the image, transforms it back to pulses, and takes the phase of
each pulse relative to the result. The weights either follow from the image entropy, or make the
weighted image a Wiener estimate of the scene.
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
from torchsar.core import Estimate, cis, host_value

Weights = Callable[[Tensor, Tensor], Tensor]
# iterations on an accelerator between two decisions whether to stop, by choice
_LOOK = 4


@dataclass(frozen=True)
class Run:
    """Settings of fixed-point iterations with one kind of weights.

    The iterations of a trial end after `iterations`, or once the phase step is below
    `tolerance_rad`.

    Args:
        weights: Function that is given the power of the image cells, shape (trial, range, Doppler),
            and its mean, shape (trial, 1, 1), and returns the real weights of the cells.
        imaging: Image formation.
        iterations: Largest number of iterations.
        relaxation: Factor applied to the phase step.
        tolerance_rad: Phase step in rad, rms over the pulses, below which the iterations of a trial
            end.
    """

    weights: Weights
    imaging: Imaging
    iterations: int
    relaxation: Tensor | float
    tolerance_rad: float


def fixed_point(rows: Tensor, phase: Tensor, run: Run) -> tuple[Tensor, Tensor]:
    """Sharpen the image by fixed-point iterations of the phase psi of every pulse.

    Each iteration is psi <- psi + relaxation * arg sum_n x conj(A^H (w A x)). Here x = rows exp(-j
    psi) are the corrected pulses, A is the image formation and A^H its adjoint, w are the real
    weights of the image cells, and the sum is over range cells n.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase to start from in rad, shape (trial, pulse).
        run: Settings of the iterations.

    Returns:
        The phase in rad, shape (trial, pulse), and the number of iterations, shape (trial,).
    """
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    taken = torch.zeros_like(active, dtype=torch.int64)
    mirrored = rows.conj().resolve_conj()
    # on an accelerator waiting for the decision costs as much as iterations that change nothing
    every = 1 if rows.device.type == "cpu" else _LOOK
    for number in range(1, run.iterations + 1):
        step = run.relaxation * _phase_step(rows, mirrored, phase, run)
        phase = torch.where(active[:, None], phase + step, phase)
        taken = taken + active
        active = active & (step.detach().square().mean(-1) > run.tolerance_rad**2)
        if number % every == 0 and not host_value(active.any(), True):
            break
    return phase, taken


def _phase_step(rows: Tensor, mirrored: Tensor, phase: Tensor, run: Run) -> Tensor:
    """arg sum_n x conj(model); exp(-j psi) of x is applied after the sum over rows.

    mirrored: the conjugate of rows.
    """
    image = run.imaging.image(rotate(rows, phase))
    model = run.imaging.adjoint(weighted(image, run.weights))
    products = mirrored * model if model.requires_grad else model.mul_(mirrored)
    return -safe_angle(products.sum(-2) * cis(phase))


def weighted(image: Tensor, weights: Weights) -> Tensor:
    """Multiply each cell of an image by a weight that depends on its power.

    Real and imaginary parts are multiplied separately, which on a CPU is three times as fast as a
    product of complex and real numbers.

    Args:
        image: Image, shape (..., range, Doppler), complex.
        weights: Function that is given the power of the cells and its mean over the image, and
            returns the real weights of the cells.

    Returns:
        The weighted image, same shape.
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
    """Weights ln(max(p, floor) / floor) of image cells, with p the power over the mean power.

    Above the floor the weight of a cell is the derivative of the image entropy by the power of the
    cell, apart from sign, a common factor and an added constant; below it the weight is zero.

    Args:
        floor: Floor as a multiple of the mean power of the image, a number or shape (trial, 1, 1).
    """

    floor: float | Tensor

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        return torch.log((power * (1 / (self.floor * mean))).clamp_min(1))


@dataclass(frozen=True)
class Wiener:
    """Weights (p / (p + level * m))^2 of image cells, minus the mean weight of their range cell.

    Here p is the power averaged over three neighbouring range cells with the weights 1/4, 1/2 and
    1/4, and m is the mean power of the image. The first term makes a Wiener filter whose prior is
    the local power: it is small where a cell holds no more than noise, and near one where it holds
    much more. The subtracted mean corrects a bias: the phase of a pulse is updated by comparing the
    pulse with the weighted image, which contains the pulse itself, so that every update would be
    too short. Subtracting the mean removes this contribution to first order.

    Args:
        level: Noise level as a multiple of the mean power.
    """

    level: float = 2.0

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        weight = self.filter(power, mean, -2)
        return weight - weight.mean(-1, keepdim=True)

    def filter(self, power: Tensor, mean: Tensor, range_dim: int) -> Tensor:
        """Return the first term, 0 to 1.

        Args:
            power: Power of the cells of an image, any shape.
            mean: Mean power of the image, broadcastable.
            range_dim: Dimension of the range, along which the power is averaged.
        """
        pairs = power + power.roll(1, range_dim)
        local = pairs + pairs.roll(-1, range_dim)
        share = local / (local + 4 * self.level * mean)
        return share * share


def entropy_fixed_point(
    data: Tensor,
    *,
    start: Tensor | None = None,
    floors: Sequence[tuple[Tensor | float, int]] = ((5.0, 12), (2.0, 12)),
    relaxation: Tensor | float = 1.8,
    tolerance_rad: float = 1e-3,
    imaging: Imaging | None = None,
) -> Estimate:
    """Estimate the phase of each pulse by a fixed-point iteration that lowers the image entropy.

    Each iteration forms the image and weights its cells with ln(max(p, floor) / floor), where p is
    the power of a cell over the mean power. It transforms the weighted image back to pulses and
    takes the phase of each pulse relative to the result. An iteration takes two transforms and,
    unlike PGA, needs no peaks and no windows. Differentiable, also in the floors and the
    relaxation, which may be tensors of one number.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`). With this default the size of the phase errors
            has no effect on the result.
        floors: Pairs (floor, largest number of iterations), used one after another. A floor is a
            multiple of the mean power. A trial proceeds to the next pair once its phase steps are
            below `tolerance_rad`.
        relaxation: Factor applied to the phase step. Above 1 it helps to pass local minima; at 2 or
            more the iteration need not converge.
        tolerance_rad: Phase step in rad, rms over the pulses, below which a trial ends its
            iterations with a floor.
        imaging: Image formation whose image is sharpened, by default a Fourier transform along
            pulses; any object with the methods `image` and `adjoint` for profiles of shape (...,
            pulse, range), such as `torchsar.focus.PolarOperator`.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, with its standard deviation. `ok` is False
        unless the image is 1.5 times as sharp as autofocus can make pure noise, more than one range
        cell or a single point makes the sharpness, and the Strehl ratio predicted from the standard
        deviation exceeds 0.8. Sharpness is the amount by which the image entropy lies below that of
        speckle.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, or a floor, an iteration count or the relaxation is invalid.
    """
    pulses = prepare(data, "entropy_fixed_point")
    if not floors or not all(floor > 0 and count >= 1 for floor, count in floors) or not 0 < relaxation < 2:
        raise ValueError(
            "entropy_fixed_point: floors must be pairs of a floor above 0 and a number of iterations of 1 or more, "
            f"and relaxation must lie between 0 and 2, got floors {list(floors)} and relaxation {relaxation}"
        )
    operator = AlongPulses() if imaging is None else Through(imaging)
    runs = [Run(LogAbove(floor), operator, count, relaxation, tolerance_rad) for floor, count in floors]

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> Found:
        phase, taken = in_turn(rows, pair_phase(rows, present) if begin is None else begin, runs)
        return phase, taken, settled

    begin = starting_phase(start, pulses, "entropy_fixed_point")
    tuned = (relaxation, *(floor for floor, _ in floors))
    return estimated(pulses, begin, find, at_rest=True, compare=imaging is None, tuned=tuned)


def in_turn(rows: Tensor, phase: Tensor, runs: Sequence[Run]) -> tuple[Tensor, Tensor]:
    """Run several kinds of fixed-point iterations one after another.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase to start from in rad, shape (trial, pulse).
        runs: Settings, in order.

    Returns:
        The phase in rad, shape (trial, pulse), and the number of iterations, shape (trial,).
    """
    total = torch.zeros_like(phase[:, 0], dtype=torch.int64)
    for run in runs:
        phase, taken = fixed_point(rows, phase, run)
        total = total + taken
    return phase, total


def settled(rows: Tensor, present: Tensor, phase: Tensor) -> Tensor:
    """Continue the estimation of a phase by four iterations of the entropy fixed point.

    Autofocus methods use it to predict their accuracy, from the change of their result when it is
    continued on all or on half of the range cells.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        present: False for pulses without samples, shape (trial, pulse), bool; not used.
        phase: Phase to start from in rad, shape (trial, pulse).

    Returns:
        The phase in rad, shape (trial, pulse).
    """
    return fixed_point(rows, phase, Run(LogAbove(2.5), AlongPulses(), 4, 1.8, 0.0))[0]
