"""Common parts of the estimators of non-uniform rotation.

They describe the sampling of a recording and the rotation of the target, and remove the effect of
the rotation from the data.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from torchsar.core import host_values, numbers_on, outer_phasor, phasor_tables, refuse_non_finite, unit_phasor
from torchsar.focus.image_lines import DopplerLines
from torchsar.focus.matched_fourier import matched_fourier
from torchsar.focus.transforms import Gridding
from torchsar.focus.warped_sums import slow_times
from torchsar.radar.warp import warp

SEARCH_EPS = 1e-3  # accuracy of the transform during estimation; images use a better one


def each(change: Callable[..., Tensor], *objects: Any) -> Any:
    """Apply a function to the tensors of an object, or of several objects of the same class.

    Args:
        change: Function of one tensor of each object.
        objects: Tensors, or dataclasses of tensors and of such dataclasses.

    Returns:
        An object of that class, with the results.
    """
    if isinstance(objects[0], Tensor):
        return change(*objects)
    names = [field.name for field in fields(objects[0])]
    return replace(objects[0], **{name: each(change, *(getattr(x, name) for x in objects)) for name in names})


def chosen(keep: Tensor, first: Any, second: Any) -> Any:
    """Choose, for each trial, between two objects of the same class.

    Args:
        keep: True where the first is kept, shape (trial,), bool.
        first: An object whose tensors have the shape (trial, ...).
        second: The object taken for the other trials.

    Returns:
        The chosen trials.
    """
    return each(lambda x, y: torch.where(keep.reshape(-1, *[1] * (x.ndim - 1)), x, y), first, second)


@dataclass(frozen=True)
class Sampling:
    """Sampling of a recording in slow time and range.

    Args:
        wavelength_m: Wavelength in metres.
        prf_hz: Pulse repetition frequency in Hz.
        pulses: Number of pulses.
        cells: Number of range cells.
        first_m: Range of cell 0 in metres, from the assumed rotation centre.
        step_m: Range spacing of the cells in metres.
    """

    wavelength_m: float
    prf_hz: float
    pulses: int
    cells: int
    first_m: float
    step_m: float

    @staticmethod
    def of(name: str, data: Tensor, wavelength_m: float, prf_hz: float, range_m: Tensor) -> Sampling:
        """Describe the sampling of data, and check it.

        Args:
            name: Name of the caller, for error messages.
            data: Range-compressed pulses, shape (..., pulse, range).
            wavelength_m: Wavelength in metres.
            prf_hz: Pulse repetition frequency in Hz.
            range_m: Range coordinates of the cells in metres, shape (range,).

        Returns:
            The sampling.

        Raises:
            ValueError: If there are fewer than 8 pulses, a number is not positive, or the range
                axis has another length or is not evenly spaced.
        """
        if data.shape[-2] < 8:
            raise ValueError(
                f"{name} works on samples (..., pulse, range) of at least 8 pulses and one range cell, got "
                f"the shape {tuple(data.shape)}"
            )
        for what, value in (("wavelength_m", wavelength_m), ("prf_hz", prf_hz)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name}: {what} must be a positive number, got {value}")
        if not isinstance(range_m, Tensor) or range_m.shape != data.shape[-1:]:
            got = f"the shape {tuple(range_m.shape)}" if isinstance(range_m, Tensor) else type(range_m).__name__
            raise ValueError(
                f"{name}: range_m must be a tensor of the {data.shape[-1]} coordinates of the range cells (m), got "
                f"{got}"
            )
        refuse_non_finite(range_m, f"{name}: range_m")
        range_m = range_m.to(torch.float64)
        steps = torch.diff(range_m) if len(range_m) > 1 else torch.ones_like(range_m)
        first, step, least, largest = host_values(torch.stack([range_m[0], steps.mean(), *torch.aminmax(steps)]), 0.0)
        if step == 0 or max(step - least, largest - step) > 1e-6 * abs(step):
            raise ValueError(
                f"{name}: range_m must be evenly spaced, got steps of {least:g} to {largest:g} m; resample the data in "
                "range first"
            )
        return Sampling(wavelength_m, prf_hz, data.shape[-2], data.shape[-1], first, step)

    @property
    def duration_s(self) -> float:
        """Duration of the aperture in seconds."""
        return self.pulses / self.prf_hz

    def range_m(self, cell: Tensor) -> Tensor:
        """Convert range cells to range in metres.

        Args:
            cell: Indices of range cells, may be fractional, any shape.

        Returns:
            The range in metres from the assumed rotation centre, same shape.
        """
        return self.first_m + self.step_m * cell


@dataclass(frozen=True)
class Motion:
    """Rotation of a target, described by k1, k2, ... and by two parameters w and v.

    The phase of an echo is linear in w and v: the part that depends on the range y_n of the
    scatterer (the range term) is (2 pi / lambda) (w (y_n + centre_m) + v) phi^2, where phi is the
    warped time t + k1 t^2 / 2 + ... Estimates of w and v may start at zero, and may become negative
    where the data are noise.

    Args:
        k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s, 1/s^2,
            ..., shape (trial, order - 1), float64.
        w: Square of the rotation rate at the first pulse in rad^2/s^2, shape (trial,), float64.
        v: w times (yc - centre_m), where yc is the estimated range centre deviation, in m
            rad^2/s^2, shape (trial,), float64.
        centre_m: Range centre deviation yc known a priori, in metres (a cell at range y lies at y +
            yc from the rotation centre), shape (trial,), float64.
    """

    k: Tensor
    w: Tensor
    v: Tensor
    centre_m: Tensor

    @property
    def omega_rad_s(self) -> Tensor:
        """Rotation rate at the first pulse in rad/s, shape (trial,). It is 0 where the estimate of
        its square is negative.
        """
        return torch.where(self.w > 0, torch.where(self.w > 0, self.w, 1).sqrt(), 0)

    @property
    def offset(self) -> Tensor:
        """Squared rotation rate times yc in m rad^2/s^2, shape (trial,); a cell at range y lies at
        y + yc from the centre of rotation.
        """
        return self.w * self.centre_m + self.v

    @property
    def yc_m(self) -> Tensor:
        """Range centre deviation yc in metres, shape (trial,).

        A cell at range y lies at y + yc from the rotation centre. Where the estimate of the squared
        rotation rate is not positive, yc is the value known a priori.
        """
        return self.centre_m + torch.where(self.w > 0, self.v / torch.where(self.w > 0, self.w, 1), 0)

    def possible(self, sampling: Sampling) -> Tensor:
        """Check whether the data can hold an echo with this rotation.

        Its parameters must be finite, and the phase that depends on range must change by less than
        about half a turn from pulse to pulse in every range cell.

        Args:
            sampling: Sampling of the data.

        Returns:
            True where the rotation is possible, shape (trial,), bool.
        """
        ends = sampling.range_m(numbers_on(self.w.device, 0.0, sampling.cells - 1.0))
        whole = warp(numbers_on(self.w.device, sampling.duration_s), self.k)
        # a rotation by the angle a changes the phase at range y by a^2 y / wavelength cycles
        turns = 1 / sampling.wavelength_m * (self.w[:, None] * ends + self.offset[:, None]).abs() * whole.square()
        return torch.isfinite(self.k).all(-1) & (turns < sampling.pulses / 4).all(-1)

    def moved(self, change: Tensor) -> Motion:
        """Change the rotation.

        Args:
            change: Changes of k1, k2, ..., of w and, if the centre is estimated, of v, shape
                (trial, parameter).

        Returns:
            The changed rotation.
        """
        order = self.k.shape[-1]
        k, w, v = change.split([order, 1, change.shape[-1] - order - 1], -1)
        return Motion(self.k + k, self.w + w[:, 0], self.v + v.sum(-1), self.centre_m)


def warped_time(k: Tensor, times_s: Tensor, duration_s: float) -> tuple[Tensor, Tensor, Tensor]:
    """Evaluate the warped time t + k1 t^2 / 2 + k2 t^3 / 6 + ... of a target at m times t.

    Args:
        k: Relative derivatives k1, k2, ... of the rotation rate at the first pulse in 1/s, 1/s^2,
            ..., shape (trial, order - 1).
        times_s: Times in seconds, shape (m,) or (trial, m).
        duration_s: Duration T of the aperture in seconds.

    Returns:
        The warped time phi in seconds, shape (trial, m); u, which is phi over its value at the end
        of the aperture, shape (trial, m); and the derivatives du/dk_i, shape (trial, order - 1, m).
    """
    whole, phi = warp(numbers_on(k.device, duration_s), k), warp(times_s, k)
    u = phi / whole
    slopes = [
        (times_s ** (i + 2) - u * duration_s ** (i + 2)) / (math.factorial(i + 2) * whole) for i in range(k.shape[-1])
    ]
    return phi, u, torch.stack(slopes, -2) if slopes else u.new_zeros((*u.shape[:-1], 0, u.shape[-1]))


def without_range_term(data: Tensor, sampling: Sampling, motion: Motion, phi: Tensor) -> Tensor:
    """Remove the phase that depends on the range of a scatterer from pulses of a rotating target.

    The data are multiplied by exp(-j (2 pi / lambda) w (y_n + yc) phi^2), with the squared rotation
    rate w, the range y_n of cell n and the range centre deviation yc.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation of the target.
        phi: Warped time t + k1 t^2 / 2 + k2 t^3 / 6 + ... of the pulses in seconds, shape (trial,
            pulse).

    Returns:
        The data without this phase, shape (trial, pulse, range), complex.
    """
    square = -1 / sampling.wavelength_m * phi.square()
    fine, coarse = phasor_tables(
        square * (motion.w[:, None] * sampling.step_m), sampling.first_m / sampling.step_m, sampling.cells, data.dtype
    )
    return data * outer_phasor(
        fine, coarse * unit_phasor(square * motion.offset[:, None], data.dtype)[..., None], sampling.cells
    )


def image_of(data: Tensor, sampling: Sampling, motion: Motion, oversampling: float = 2.0) -> Tensor:
    """Form the image of a target with its rotation compensated.

    Args:
        data: Range-compressed pulses, shape (trial, pulse, range), complex.
        sampling: Sampling of the data.
        motion: Rotation of the target.
        oversampling: Image lines per Doppler cell.

    Returns:
        The image, shape (trial, line, range), with zero Doppler in the middle.
    """
    phi = warp(slow_times(sampling.pulses, sampling.prf_hz, data.device), motion.k)
    return matched_fourier(
        without_range_term(data, sampling, motion, phi),
        motion.k,
        sampling.prf_hz,
        lines=DopplerLines(oversampling),
        transform=Gridding(eps=SEARCH_EPS),
    )
