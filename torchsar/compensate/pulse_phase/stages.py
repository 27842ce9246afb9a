"""Phases of pulses as stages of a chain: their removal, and the base of their estimators.

The estimators provide the phase as `phase_rad` and leave the signal unchanged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import on_the_circle, rotate
from torchsar.core import Estimate, Signal, Stage, checked_samples, real_dtype, refuse_non_finite


def correct_pulse_phase(data: Tensor, phase_rad: Tensor) -> Tensor:
    """Remove a phase from every pulse: the samples are multiplied by exp(-j phase).

    >>> import torch
    >>> from torchsar.compensate import correct_pulse_phase
    >>> correct_pulse_phase(torch.tensor([[1.0], [1j]]), torch.tensor([0.0, torch.pi / 2])).real
    tensor([[1.],
            [1.]])

    Whole turns are first subtracted from the phase in float64, so that large phases lose no
    accuracy. Differentiable in both arguments.

    Args:
        data: Pulses, shape (..., pulse, range), complex.
        phase_rad: Phases in rad, shape (..., pulse) or (pulse,).

    Returns:
        The corrected pulses, shape (..., pulse, range), complex.

    Raises:
        ValueError: If there is not one finite phase per pulse.

    Reference:
        Ruan et al. 2013, text after Eq. (6).
    """
    if not isinstance(phase_rad, Tensor) or phase_rad.shape[-1:] != data.shape[-2:-1]:
        got = tuple(phase_rad.shape) if isinstance(phase_rad, Tensor) else type(phase_rad).__name__
        raise ValueError(
            f"correct_pulse_phase: phase_rad must be a tensor of one phase per pulse, (..., {data.shape[-2]}), "
            f"got {got}"
        )
    data = checked_samples(data, "correct_pulse_phase", "pulse, range", finite=False)
    refuse_non_finite(phase_rad, "correct_pulse_phase: phase_rad", "in trials without an estimate, use zero", "values")
    return rotate(data.mT, on_the_circle(phase_rad.to(torch.float64)).to(real_dtype(data.dtype))).mT


CorrectPulsePhase = Stage.of(correct_pulse_phase)


class _PhaseEstimator(Stage):
    """Base of stages that estimate the phase of every pulse by a function with options."""

    provides = ("phase_rad",)
    neutral = {"phase_rad": 0.0}
    differentiable = "where ok"

    def __init__(self, find: Callable[..., Estimate], **options: Any) -> None:
        super().__init__()
        self.find, self.options = find, options

    def forward(self, signal: Signal) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Returns:
            The `Estimate` of the function that the description of the stage names, with `phase_rad`
            of shape (..., pulse), to be removed.
        """
        return self.find(signal.data, **self.options)


class _PhaseEstimatorFromStart(_PhaseEstimator):
    """Base of those stages that can start from a phase."""

    def forward(self, signal: Signal, start: Tensor | None = None) -> Estimate:
        """Estimate the phase error of every pulse of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            start: Phase to start from in rad, shape (..., pulse); by default that of the function.

        Returns:
            The `Estimate` of the function that the description of the stage names, with `phase_rad`
            of shape (..., pulse), to be removed.
        """
        return self.find(signal.data, start=start, **self.options)
