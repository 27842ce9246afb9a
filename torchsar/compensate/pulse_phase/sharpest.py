"""Autofocus by gradient descent: the phases of the pulses that minimise a cost of the image.

Such a cost is, for example, the entropy of the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import (
    Pulses,
    find_phases,
    on_the_circle,
    pair_phase,
    prepare,
    rotate,
    starting_phase,
)
from torchsar.compensate.pulse_phase.fixed_point import LogAbove, Run, fixed_point
from torchsar.compensate.pulse_phase.imaging import AlongPulses, Imaging, Through
from torchsar.compensate.pulse_phase.stages import _PhaseEstimatorFromStart
from torchsar.core import Estimate, centred_ifft, cis, differentiable
from torchsar.metrics.image import contrast, entropy
from torchsar.optim import adam, lbfgs

Cost = Callable[[Tensor], Tensor]
Named = Literal["power_entropy", "amplitude_entropy", "contrast"]
Method = Literal["lbfgs", "adam"]
# function of the phase (trial, pulse) that returns the cost (trial,) and its gradient (trial,
# pulse)
_PhaseCost = Callable[[Tensor], tuple[Tensor, Tensor]]


@differentiable("no")
def sharpest_phase(
    data: Tensor,
    *,
    objective: Named | Cost = "power_entropy",
    mask: Tensor | None = None,
    start: Tensor | None = None,
    basis: Tensor | None = None,
    method: Method = "lbfgs",
    steps: int | None = None,
    tolerance: float = 1e-3,
    imaging: Imaging | None = None,
    assess: bool = True,
) -> Estimate:
    """Find the phase of each pulse that minimises a cost of the image, by gradient descent.

    >>> import torch
    >>> from torchsar.compensate import sharpest_phase
    >>> point = torch.zeros(32, 8, dtype=torch.complex64)  # pulses, range cells
    >>> point[:, 3] = torch.exp(2j * torch.rand(32))
    >>> sharpest_phase(point, objective="contrast", assess=False)["phase_rad"].shape
    torch.Size([32])

    Each trial descends separately into a minimum near its start.

    Prefer the power entropy. On a simulated target of many scatterers, at an SNR per sample of 0 dB
    or more, its minimum is the same from any start. The error is then 0.066 rad at 0 dB and 0.032
    rad at 20 dB; that of `autofocus` is 0.053 rad and 0.018 rad. The contrast follows a few bright
    cells away from the true phase. The amplitude entropy follows the many cells of noise unless a
    mask excludes them.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        objective: "power_entropy", "amplitude_entropy" or "contrast" (maximised), see
            `torchsar.metrics`; or a differentiable function that is given images of shape (trial,
            azimuth, range), not necessarily of all trials, of data divided by their level
            (`torchsar.core.level_of`), and returns one cost per image, shape (trial,).
        mask: Weights of the pixels, shape (azimuth, range) or (..., azimuth, range).
        start: Phase to start from in rad, shape (..., pulse); by default that of the spatial
            correlation algorithm (function `sca`).
        basis: Real functions of slow time, shape (coefficient, pulse) or (..., coefficient, pulse),
            such as `torchsar.core.legendre(u, 5).mT[2:]`. The phase is then a weighted sum of these
            functions, and the descent starts from their least-squares fit to the start.
        method: "lbfgs", or "adam" for rough costs.
        steps: Largest number of steps, by default 100 for "lbfgs" and 500 for "adam".
        tolerance: The descent of a trial ends when the norm of the gradient falls to this fraction
            of that at the start. It also ends when the cost hardly falls any more: by less than
            1e-7 of its value in a step of "lbfgs", or 1e-6 in 50 steps of "adam".
        imaging: Image formation: any object with a differentiable `image` of profiles of shape
            (..., pulse, range), see `entropy_fixed_point`; by default
            `torchsar.focus.azimuth_transform`. If range migration makes the sharpness depend on
            where the target lies in the image, start from the phase that `autofocus` finds with
            the same `imaging`.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. Gradients do not pass through it. Pulses
        without samples have the phase of the start or, with a basis, that of the fitted functions.
        With `assess`, standard deviation, quality, outcome and info as by `autofocus`.
        info["iterations"] is the number of steps.

    Raises:
        TypeError: If the data are not complex, or the start, mask or basis is not a tensor.
        ValueError: If the data are empty or not finite, the start, mask or basis has the wrong
            shape, the functions of the basis depend on each other, or the objective or method is
            unknown.
    """
    pulses = prepare(data, "sharpest_phase")
    begin = starting_phase(start, pulses, "sharpest_phase")
    cost, functions = _cost_of(objective, mask, imaging, pulses), _functions_of(basis, pulses)
    most = {"lbfgs": 100, "adam": 500}
    if method not in most:
        raise ValueError(f"sharpest_phase: method {method!r} is not known; choose one of {', '.join(most)}")
    count = most[method] if steps is None else steps

    def descend(cost_of_x: _PhaseCost, first: Tensor) -> tuple[Tensor, Tensor]:
        # the first step is 0.05 rad rms long: shorter ones cost iterations, longer ones leave the
        # minimum near the start
        if method == "adam":
            found = adam(cost_of_x, first, steps=count, rate=0.05, gradient_tolerance=tolerance, with_gradient=True)
        else:
            found = lbfgs(
                cost_of_x,
                first,
                steps=count,
                first_step=0.05 * math.sqrt(first.shape[-1]),
                gradient_tolerance=tolerance,
                value_tolerance=1e-7,
                with_gradient=True,
            )
        return found.x, found.steps

    def find(rows: Tensor, present: Tensor, which: Tensor | None) -> tuple[Tensor, Tensor]:
        assert which is not None
        rows, own = rows.detach(), _of_trials(functions, which)
        first, cost_of = pair_phase(rows, present) if begin is None else begin[which], cost(rows, which)
        if own is None:
            phase, taken = descend(cost_of, first)
            return torch.where(present, phase, first), taken

        def of_weights(x: Tensor) -> tuple[Tensor, Tensor]:
            value, gradient = cost_of(_summed(own, x))
            return value, _projected(own, gradient)

        weights, taken = descend(of_weights, _projected(own, first) / pulses.n)
        return _summed(own, weights), taken

    # The start that `find` receives holds the indices of the trials of a block, because masks,
    # starts and basis functions may differ between trials.
    phase, taken = find_phases(pulses, find, torch.arange(len(pulses.rows), device=pulses.rows.device))

    def again(rows: Tensor, which: Tensor | slice, at: Tensor) -> Tensor:
        """Continue within the span of the basis, with weights that follow from the cost.

        With a higher floor of the entropy the iterations leave the minimum. With a lower one they
        hardly move in noise.
        """
        weights = (lambda power, mean: power / mean) if objective == "contrast" else LogAbove(1.0)
        own, from_ = _of_trials(functions, which), phase[which]

        def held(change: Tensor) -> Tensor:
            return change if own is None else _summed(own, _projected(own, change) / pulses.n)

        at = from_ + held(at - from_)
        return at + held(on_the_circle(fixed_point(rows, at, Run(weights, AlongPulses(), 8, 1.8, 0.0))[0] - at))

    return conclude(pulses, phase, taken, assess, again)


class SharpestPhase(_PhaseEstimatorFromStart):
    """Phase per pulse of least image entropy or most contrast, by descent; see `sharpest_phase`.

    Args:
        objective: "power_entropy" or "amplitude_entropy" (minimised), or "contrast" (maximised).
        method: Gradient descent: "lbfgs", or "adam" for rough objectives.
        steps: Largest number of steps.
        assess: Whether to add the standard deviation and the outcome.
    """

    differentiable = "no"

    def __init__(
        self,
        objective: Named = "power_entropy",
        method: Method = "lbfgs",
        steps: int = 100,
        assess: bool = True,
    ) -> None:
        super().__init__(sharpest_phase, objective=objective, method=method, steps=steps, assess=assess)


def _summed(functions: Tensor, x: Tensor) -> Tensor:
    """Sum (trial, pulse) of functions (coordinate, pulse) or (trial, coordinate, pulse) with the
    weights x.
    """
    return (x[..., None, :] @ functions)[..., 0, :]


def _projected(functions: Tensor, gradient: Tensor) -> Tensor:
    """Gradient (trial, coordinate) with respect to the weights of functions, from that with respect
    to the phases.
    """
    return (functions @ gradient[..., None])[..., 0]


def _of_trials(x: Tensor | None, which: Tensor | slice) -> Tensor | None:
    """Select trials of x, if it has a dimension of trials before two others."""
    return x if x is None or x.ndim < 3 else x[which]


def _functions_of(basis: Tensor | None, pulses: Pulses) -> Tensor | None:
    """Orthogonalise the functions of a basis over the pulses, and scale them to unit mean square.
    Raises ValueError if the basis is invalid.
    """
    if basis is None:
        return None
    wide = _by_trial(basis, pulses, "basis")
    if wide.is_complex() or wide.ndim < 2 or wide.shape[-1] != pulses.n or not 1 <= wide.shape[-2] <= pulses.n:
        raise ValueError(
            f"sharpest_phase: basis must hold 1..{pulses.n} real functions over {pulses.n} pulses, shape "
            f"(coefficient, pulse), got {basis.dtype} of shape {tuple(basis.shape)}"
        )
    wide = wide.to(torch.float64)
    if not torch.isfinite(wide).all() or bool((torch.linalg.matrix_rank(wide) < wide.shape[-2]).any()):
        raise ValueError(
            f"sharpest_phase: the {wide.shape[-2]} functions of basis must be finite and linearly "
            "independent; use orthogonal functions such as those of torchsar.core.legendre"
        )
    return (torch.linalg.qr(wide.mT).Q.mT * math.sqrt(pulses.n)).to(pulses.rows.real.dtype).contiguous()


def _by_trial(x: Tensor, pulses: Pulses, what: str) -> Tensor:
    """Reshape x (..., a, b) to (trial, a, b). With two dimensions or fewer it keeps its shape."""
    if not isinstance(x, Tensor):
        raise TypeError(f"sharpest_phase: {what} must be a tensor, got {type(x).__name__}; torch.as_tensor makes one")
    try:
        wide = x if x.ndim < 3 else x.expand(*pulses.trials, *x.shape[-2:]).reshape(-1, *x.shape[-2:])
    except RuntimeError:
        raise ValueError(
            f"sharpest_phase: {what} of shape {tuple(x.shape)} does not fit "
            f"the trials of shape {tuple(pulses.trials)}; give two dimensions, for all trials alike, or put "
            "the dimensions of the trials in front"
        ) from None
    return wide.to(pulses.rows.device)


def _cost_of(
    objective: Named | Cost, mask: Tensor | None, imaging: Imaging | None, pulses: Pulses
) -> Callable[[Tensor, Tensor], _PhaseCost]:
    """Function of (rows, indices of their trials) that returns the cost of their phases. Raises
    ValueError if the objective is unknown or does not use the mask.
    """
    if isinstance(objective, str) and objective not in get_args(Named):
        raise ValueError(
            f"sharpest_phase: objective {objective!r} is not known; choose one of "
            f"{', '.join(get_args(Named))}, or give a function of images"
        )
    if mask is not None and not isinstance(objective, str):
        raise ValueError(
            "sharpest_phase: mask must be None if objective is a function; apply the mask inside that function"
        )
    if objective == "power_entropy" and mask is None and imaging is None:
        return lambda rows, _: partial(power_entropy, rows, rows.conj().resolve_conj())
    image = _centred_image if imaging is None else Through(imaging).image
    weights = None if mask is None else _by_trial(mask, pulses, "mask")

    def of_trials(rows: Tensor, which: Tensor) -> _PhaseCost:
        own = _of_trials(weights, which)
        named: dict[str, Cost] = {
            "power_entropy": partial(entropy, mask=own),
            "amplitude_entropy": partial(entropy, of="amplitude", mask=own),
            "contrast": lambda x: -contrast(x, mask=own),
        }
        return partial(_derived, rows, image, named[objective] if isinstance(objective, str) else objective)

    return of_trials


def _centred_image(rows: Tensor) -> Tensor:
    """Image (trial, azimuth, range) of rows (trial, range, pulse), as `azimuth_transform`
    forms it.
    """
    return (centred_ifft(rows) * math.sqrt(rows.shape[-1])).mT


def _derived(
    rows: Tensor, image: Callable[[Tensor], Tensor], of_image: Cost, phase_rad: Tensor
) -> tuple[Tensor, Tensor]:
    """Cost of the image by any function, with its gradient by automatic differentiation."""
    with torch.enable_grad():
        phase = phase_rad.detach().requires_grad_()
        cost = of_image(image(rotate(rows, phase)))
        if not isinstance(cost, Tensor) or cost.shape != phase.shape[:-1] or not cost.requires_grad:
            got = type(cost).__name__
            if isinstance(cost, Tensor):
                got = f"{'' if cost.requires_grad else 'detached '}{cost.dtype} of shape {tuple(cost.shape)}"
            raise ValueError(
                f"sharpest_phase: the objective returned {got} for {len(phase)} images; it must return one real "
                "cost per image that is differentiable in the samples of the image"
            )
        return cost.detach(), torch.autograd.grad(cost.sum(), phase)[0]


def power_entropy(rows: Tensor, mirrored: Tensor, phase_rad: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the entropy of the image and its gradient with respect to the phases.

    dE/dpsi_k = -(2 / F) Im sum_n x conj(IFFT((1 + ln p) f)), where F is the energy. Any constant
    may be omitted from (1 + ln p).

    Args:
        rows: Pulses, shape (trial, range, pulse), complex.
        mirrored: Their conjugate.
        phase_rad: Phases in rad, shape (trial, pulse).

    Returns:
        The entropy in nats, shape (trial,), and its gradient, shape (trial, pulse).
    """
    image = torch.fft.fft(rotate(rows, phase_rad), norm="ortho")
    real, imag = image.real.contiguous(), image.imag.contiguous()
    power = real * real + imag * imag
    mean = power.mean((-2, -1), keepdim=True)
    unit = power * torch.where(mean > 0, mean, 1).reciprocal()
    log = torch.log(unit.clamp_min(torch.finfo(unit.dtype).tiny))
    cells = unit.shape[-2] * unit.shape[-1]
    cost = math.log(cells) - (unit * log).sum((-2, -1), dtype=torch.float64) / cells
    model = torch.fft.ifft(torch.complex(real.mul_(log), imag.mul_(log)), norm="ortho")
    turned = ((mirrored * model).sum(-2) * cis(phase_rad)).imag
    return cost, 2 / cells * turned / torch.where(mean > 0, mean, 1)[..., 0]
