"""Fixed-point iterations that sharpen the image by correcting the phase of every pulse.

Each iteration weights the cells of the image, transforms it back to pulses, and takes the phase of
each pulse relative to the result. The weights either follow from the image entropy, or make the
weighted image a Wiener estimate of the scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import or_one, rotate, safe_angle
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging
from torchsar.core import block_bytes_of, cis, host_value, power_of, true_positions

Weights = Callable[[Tensor, Tensor], Tensor]
# Relaxation factors of three successive iterations with the weights `Wiener` along pulses. With the
# factor 1, an iteration removes 0.2 to 1.2 of the components of a phase error, the least in dense
# scenes. With these factors, three iterations leave least of any such component (Chebyshev), and
# their order lets none grow much in between. With fewer pulses than 24 an iteration removes more
# than 1.3 of some components, up to 1.7 with 3 pulses, and the factors would not converge.
WIENER_FACTORS, LEAST_PULSES_OF_FACTORS = (0.88, 3.75, 1.43), 24


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
        relaxation: Factor applied to the phase step; several are taken in turn.
        tolerance_rad: Phase step in rad, rms over the pulses and with the smallest factor, below
            which the iterations of a trial end.
    """

    weights: Weights
    imaging: Imaging
    iterations: int
    relaxation: Tensor | float | tuple[float, ...]
    tolerance_rad: float

    def of(self, trials: Tensor) -> Run:
        """Settings for some of the trials, given by their indices."""
        floor = self.weights.floor if isinstance(self.weights, LogAbove) else None
        if not isinstance(floor, Tensor) or floor.ndim < 3 or len(floor) == 1:
            return self
        return replace(self, weights=LogAbove(floor[trials]))


def fixed_point(rows: Tensor, phase: Tensor, run: Run, done: int = 0) -> tuple[Tensor, Tensor]:
    """Sharpen the image by fixed-point iterations of the phase psi of every pulse.

    Each iteration is psi <- psi + relaxation * arg sum_n x conj(A^H (w A x)). Here x = rows exp(-j
    psi) are the corrected pulses, A is the image formation and A^H its adjoint, w are the real
    weights of the image cells, and the sum is over range cells n.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        phase: Phase to start from in rad, shape (trial, pulse).
        run: Settings of the iterations.
        done: Number of iterations made before.

    Returns:
        The phase in rad, shape (trial, pulse), and the number of iterations made here, shape
        (trial,).
    """
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    taken = torch.zeros_like(active, dtype=torch.int64)
    step_of = _step_of(rows, run)
    # On an accelerator, the decision to stop takes as long as a few iterations without effect. It
    # is therefore made after every fourth iteration only.
    every = 1 if rows.device.type == "cpu" else 4
    factors = run.relaxation if isinstance(run.relaxation, tuple) else (run.relaxation,)
    for number in range(done + 1, run.iterations + 1):
        step = step_of(phase)
        phase = torch.where(active[:, None], phase + factors[(number - 1) % len(factors)] * step, phase)
        taken = taken + active
        active = active & ((min(factors) * step).detach().square().mean(-1) > run.tolerance_rad**2)
        if number % every or run.iterations - number < every or not run.tolerance_rad:
            continue
        going = host_value(active.sum(), len(active))
        if not going:
            break
        divisible = isinstance(run.imaging, AlongPulses) and not isinstance(run.relaxation, Tensor)
        if 2 * going <= len(active) and divisible and not phase.requires_grad:
            some = true_positions(active, going)
            ended, more = fixed_point(rows[some], phase[some], run.of(some), number)
            return phase.index_copy(0, some, ended), taken.index_add(0, some, more)
    return phase, taken


def _step_of(rows: Tensor, run: Run) -> Callable[[Tensor], Tensor]:
    """Function that maps phases to the step arg sum_n x conj(A^H (w A x)) of `fixed_point`.

    If the weight of a cell depends on no other cell, and the image formation acts on each row
    alone, the rows are processed in slabs that fit into the cache. This takes a third of the time.
    The mean power of the image is then that of the rows (Parseval).
    """
    size, mean = rows.shape[-2], None
    if isinstance(run.imaging, AlongPulses) and isinstance(run.weights, LogAbove) and len(rows):
        mean = power_of(rows).mean((-2, -1), keepdim=True) / run.imaging.oversampling
        if not rows.requires_grad:
            of_row = len(rows) * rows.shape[-1] * rows.element_size() * run.imaging.oversampling
            size = max(1, block_bytes_of(rows.device) // (2 * of_row))
    slabs = [(slab, slab.conj().resolve_conj()) for slab in rows.split(size, -2)]

    def step(phase: Tensor) -> Tensor:
        turn, total = cis(-phase), torch.zeros_like(rows[:, 0])
        for slab, mirrored in slabs:
            image = run.imaging.image(slab * turn[..., None, :])
            model = run.imaging.adjoint(weighted(image, run.weights, mean))
            total = total + (mirrored * model if model.requires_grad else model.mul_(mirrored)).sum(-2)
        return -safe_angle(total * turn.conj())

    return step


def weighted(image: Tensor, weights: Weights, mean: Tensor | None = None) -> Tensor:
    """Multiply each cell of an image by a weight that depends on its power.

    Real and imaginary parts are multiplied separately, which on a CPU is three times as fast as a
    product of complex and real numbers.

    Args:
        image: Image, shape (..., range, Doppler), complex.
        weights: Function that is given the power of the cells and its mean over the image, and
            returns the real weights of the cells.
        mean: Mean power, shape (..., 1, 1), if it is not that of this image.

    Returns:
        The weighted image, same shape.
    """
    real, imag = image.real.contiguous(), image.imag.contiguous()
    power = torch.addcmul(real * real, imag, imag)
    mean = power.mean((-2, -1), keepdim=True) if mean is None else mean
    weight = weights(power, torch.where(mean > 0, mean, 1))
    if image.requires_grad:
        return torch.complex(real * weight, imag * weight)
    return torch.complex(real.mul_(weight), imag.mul_(weight))


@dataclass(frozen=True)
class LogAbove:
    """Weights ln(max(p, floor) / floor) of image cells, with p the power over the mean power.

    Above the floor the weight of a cell is the derivative of the image entropy with respect to the
    power of the cell, apart from sign, a common factor and an added constant. Below it the weight
    is zero.

    Args:
        floor: Floor as a multiple of the mean power of the image, a number or shape (trial, 1, 1).
    """

    floor: float | Tensor

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        return torch.log((power * (1 / (self.floor * mean))).clamp_min(1))


@dataclass(frozen=True)
class Wiener:
    """Weights (p / (p + N))^2 of image cells, minus the mean weight of their range cell.

    Here p is the power averaged over three neighbouring range cells with the weights 1/4, 1/2 and
    1/4. The first term makes a Wiener filter whose prior is the local power: it is small where a
    cell holds no more than the noise N, and near one where it holds much more. The subtracted mean
    corrects a bias: the phase of a pulse is updated by comparing the pulse with the weighted image,
    which contains the pulse itself, so that every update would be too short. Subtracting the mean
    removes this contribution to first order.

    N is a multiple of the mean power of the image, and at least a share of the power of a typical
    bright cell. With the multiple alone, side lobes of a few points would count as scene: the
    weights would be near one far beyond their main lobes, and errors of the phase that spread no
    farther would confirm themselves.

    Args:
        level: N as a multiple of the mean power.
        share: Least N as a share of the power of a typical bright cell, found by trial: 0.003 is
            too little for three points, and 0.03 leaves out weak scatterers of an aircraft.
    """

    level: float = 2.0
    share: float = 0.01

    def __call__(self, power: Tensor, mean: Tensor) -> Tensor:
        weight = self.of_scene(power, mean)
        return weight - weight.mean(-1, keepdim=True)

    def of_scene(self, power: Tensor, mean: Tensor) -> Tensor:
        """Return the first term, 0 to 1.

        Args:
            power: Power of the cells of images, shape (trial, range, Doppler).
            mean: Its mean, shape (trial, 1, 1).
        """
        return self.filter(power, torch.maximum(self.level * mean, self.share * bright(power)), -2)

    @staticmethod
    def filter(power: Tensor, noise: Tensor, range_dim: int) -> Tensor:
        """Return the first term, 0 to 1.

        Args:
            power: Power of the cells of an image, any shape.
            noise: N, above 0, broadcastable.
            range_dim: Dimension of the range, along which the power is averaged.
        """
        pairs = power + power.roll(1, range_dim)
        local = pairs + pairs.roll(-1, range_dim)
        share = local / (local + 4 * noise)
        return share * share


def bright(power: Tensor) -> Tensor:
    """Return the power of a typical bright cell: the mean power weighted with the power.

    Args:
        power: Power of the cells of images, shape (trial, range, Doppler).

    Returns:
        The power, shape (trial, 1, 1); 0 for an empty image.
    """
    return power.square().sum((-2, -1), keepdim=True) / or_one(power.sum((-2, -1), keepdim=True))


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


def side_lobes(present: Tensor) -> Tensor:
    """Compute the largest side lobe that missing pulses make.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        The side lobe relative to the main lobe at the Dopplers of an image without padding, shape
        (trial,), float64; 0 without missing pulses and where lobes repeat the whole scene.
    """
    response = torch.fft.rfft(present.to(torch.float64)).abs()
    lobes = response[:, 1:] / or_one(response[:, :1])
    # Side lobes as high as the main lobe repeat the whole image, for example if every other pulse
    # is missing. They do not change the sharpness and are left out.
    return torch.where(lobes < 0.98, lobes, 0).amax(-1)


def have_gaps(present: Tensor) -> Tensor:
    """Decide where missing pulses change the phases that sharpen an image, see `across_gaps`.

    Args:
        present: False where a pulse is missing, shape (trial, pulse).

    Returns:
        True where they do, shape (trial,).
    """
    # The limit is exceeded if a gap is a sixteenth of the record. With the limit 0.07 this was not
    # so, and the phase errors of 40 points were larger by a sixth.
    return side_lobes(present) > 0.06


def across_gaps(rows: Tensor, phase_rad: Tensor, iterations: int, tolerance_rad: float) -> Tensor:
    """Compare pulses with a Wiener estimate of the scene from all pulses, and fill in the missing
    ones.

    The image of a point has side lobes where pulses are missing. Phases that shift the parts of the
    record against each other in Doppler lower these lobes. Sharpness, and an estimate of the scene
    that contains the lobes, therefore lead to wrong phases. With a quarter of the record missing,
    they were wrong by 0.5 rad in nearly every scene, and both halves of the rows agreed. With the
    missing pulses taken from the estimated scene there are no such lobes.

    The weights, the steps and their factors are those of `autofocus`. The missing pulses are those
    of the last estimate.

    Args:
        rows: Pulses, shape (trial, range, pulse), complex; missing ones are all zeros.
        phase_rad: Phase to start from in rad, shape (trial, pulse).
        iterations: Largest number of iterations.
        tolerance_rad: Phase step in rad, rms over the pulses and with the smallest factor, below
            which the iterations of a trial end.

    Returns:
        The phase in rad, shape (trial, pulse).
    """
    present, along, scene = (rows != 0).any(-2), AlongPulses(2), Wiener()
    factors = WIENER_FACTORS if rows.shape[-1] >= LEAST_PULSES_OF_FACTORS else (1.0,)
    filled, phase = torch.zeros_like(rows), phase_rad
    active = torch.ones_like(phase[:, 0], dtype=torch.bool)
    # the first six iterations fill in missing pulses without changing phases
    for number in range(-6, iterations):
        pulses = torch.where(present[:, None], rotate(rows, phase), filled)
        image = along.image(pulses)
        power = power_of(image)
        mean = or_one(power.mean((-2, -1), keepdim=True))
        weight = scene.of_scene(power, mean)
        filled = along.adjoint(image * weight)
        if number < 0:
            continue
        others = filled - weight.mean(-1, keepdim=True) * pulses
        step = torch.where(present & active[:, None], safe_angle((others.conj() * pulses).sum(-2)), 0)
        phase = phase + factors[number % len(factors)] * step
        size = (min(factors) * step.detach()).square().sum(-1) / or_one(present.sum(-1))
        active = active & (size > tolerance_rad**2)
        # on an accelerator, the decision to stop takes as long as iterations without effect
        if phase.device.type == "cpu" and not host_value(active.sum(), 1):
            break
    return phase
