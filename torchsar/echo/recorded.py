"""From echoes to recordings: noise, trials, impairments and true values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from torchsar.core import Axis, Draws, Recording, Signal, Truth


class Impairment(Protocol):
    """Impairment of a recording by the receiver or the environment.

    >>> from torchsar import Draws, Recording, echo, radar, scene
    >>> def halved(recording, draws):
    ...     signal = recording.signal.with_data(recording.signal.data / 2)
    ...     return Recording(signal, recording.radar, recording.aux), {}
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0, rotation_rad_s=0.1)
    >>> world = scene.TurntableWorld(scene.Points([0.0], [0.0]))
    >>> recording, _ = echo.simulate_turntable(isar, world, 4, 8, Draws(1), {"half": halved})
    >>> recording.signal.data[:, 4].abs().round(decimals=2)  # the range cell of the point
    tensor([0.5000, 0.5000, 0.5000, 0.5000])

    It is called with a recording and random draws, and returns the impaired recording and the true
    values of the impairment by name.
    """

    def __call__(self, recording: Recording, draws: Draws) -> tuple[Recording, Mapping[str, Tensor]]: ...


def noise(
    draws: Draws,
    purpose: str,
    shape: Sequence[int],
    std: Tensor,
    dtype: torch.dtype,
    device: torch.device | str | None = None,
) -> Tensor:
    """Draw normally distributed noise, circular if it is complex.

    Args:
        draws: Random draws.
        purpose: Address of the random numbers.
        shape: Shape of the noise of one trial.
        std: Standard deviation of a sample, shape (...,).
        dtype: Dtype of the noise, complex or real.
        device: Device of the noise.

    Returns:
        Noise, shape (..., *shape).
    """
    unit = draws.normal(purpose, shape, dtype, device)
    return unit * std.to(unit.real.dtype)[(...,) + (None,) * len(shape)]


def trials_of(draws: Draws, tail: int, *data: Tensor) -> tuple[int, ...]:
    """Return the shape of the trials of a simulation.

    Args:
        draws: Random draws.
        tail: Number of the last dimensions of the data that are no trials.
        *data: Data, which have no trials yet if they are without random numbers.

    Returns:
        Shape to which the trials of data and draws broadcast.
    """
    drawn = () if draws.trials is None else (len(draws.trials),)
    return np.broadcast_shapes(drawn, *(x.shape[:-tail] for x in data))


def recorded(
    data: Tensor,
    clean: Tensor,
    axes: tuple[Axis, ...],
    radar: Any,
    values: Mapping[str, Tensor],
    impairments: Mapping[str, Impairment] | None,
    draws: Draws,
    aux: Mapping[str, Tensor] | None = None,
    clean_aux: Mapping[str, Tensor] | None = None,
    count_lines: bool = True,
) -> tuple[Recording, Truth]:
    """Form the recording and its truth, and apply impairments.

    Args:
        data: Samples before impairments, shape (..., *axes); those that are equal in all trials are
            expanded to the trials of the draws.
        clean: Samples of the clean recording of the truth, same shape.
        axes: Axes of the samples.
        radar: Radar parameters.
        values: True values by name.
        impairments: Impairments by name, applied in order.
        draws: Random draws.
        aux: Recorded side data.
        clean_aux: Side data of the clean recording.
        count_lines: Whether the recording gets line numbers, as by `apply_impairments`.

    Returns:
        Recording and truth, which holds the true values of the impairments as well.
    """
    tail = len(axes)
    trials = trials_of(draws, tail, data, clean)
    data, clean = (x.expand(*trials, *x.shape[x.ndim - tail :]) for x in (data, clean))
    before = Recording(Signal(data, axes), radar, dict(aux or {}))
    apply = apply_impairments if count_lines else _applied
    recording, found = apply(before, impairments or {}, draws)
    return recording, Truth({**values, **found}, Recording(Signal(clean, axes), radar, dict(clean_aux or {})))


def apply_impairments(
    recording: Recording, impairments: Mapping[str, Impairment], draws: Draws
) -> tuple[Recording, dict[str, Tensor]]:
    """Apply impairments to a recording, simulated or recorded.

    >>> import torch
    >>> from torchsar import Draws, core, echo, radar
    >>> isar = radar.InverseRadar(1e10, 1e9, 500.0)
    >>> pulses = core.Recording(core.Signal(torch.ones(4, 8) + 0j, isar.raw_axes(4, 8)), isar)
    >>> found, truth = echo.apply_impairments(pulses, {"lost": echo.LostPulses(count=1)}, Draws(1))
    >>> found.signal.data.abs().mean(-1), truth["lost.present"]
    (tensor([0., 1., 1., 1.]), tensor([False,  True,  True,  True]))

    A recording without the side data `line_number` (in `aux`) gets the line numbers 0, 1, ... in
    the order of its pulses.

    Args:
        recording: Recording.
        impairments: Impairments by name, applied in order.
        draws: Random draws; each impairment draws its own random numbers, addressed by its name.

    Returns:
        The impaired recording, and the true values under "<impairment>.<name>".
    """
    return _applied(numbered(recording), impairments, draws)


def numbered(recording: Recording) -> Recording:
    """Return a recording with line numbers, 0, 1, ... in the order of its pulses if it has none.

    Args:
        recording: Recording.

    Returns:
        Recording with the side data `line_number`.
    """
    if "line_number" in recording.aux:
        return recording
    data = recording.signal.data
    lines = torch.arange(data.shape[-2], device=data.device).expand(data.shape[:-1])
    return replace(recording, aux={**recording.aux, "line_number": lines})


def _applied(
    recording: Recording, impairments: Mapping[str, Impairment], draws: Draws
) -> tuple[Recording, dict[str, Tensor]]:
    """Apply impairments to a recording without adding line numbers."""
    true_values: dict[str, Tensor] = {}
    for name, impairment in impairments.items():
        recording, values = impairment(recording, draws.part(name))
        true_values.update({f"{name}.{key}": value for key, value in values.items()})
    return recording, true_values


def with_samples(recording: Recording, data: Tensor, **aux: Tensor) -> Recording:
    """Return a recording with other samples, and with further side data.

    Args:
        recording: Recording.
        data: Samples of the same axes.
        **aux: Further side data, or others of the same names.

    Returns:
        The changed recording.
    """
    return replace(recording, signal=recording.signal.with_data(data), aux={**recording.aux, **aux})
