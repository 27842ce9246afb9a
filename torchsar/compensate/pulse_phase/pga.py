"""Phase gradient autofocus (PGA), and the spatial correlation algorithm (SCA).

SCA takes the phases between adjacent pulses of all range cells. In PGA the strongest scatterer of
every range cell is isolated by a window that narrows from iteration to iteration. The window acts
on an image of twice as many Doppler cells as pulses, made from pulses that are padded with zeros.
Without padding, a narrow window mixes the last pulses with the first, and the iterations drift away
from their optimum. On images of 1024 x 1024 cells the phase error then rises from 0.07 rad at the
best iteration to 0.4 rad after 20 iterations; with padding it stays at 0.03 rad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import (
    find_phases,
    pair_phase,
    pair_products,
    prepare,
    refuse_odd_counts,
    rotate,
    running_sum,
    safe_angle,
    starting_phase,
    without_line,
)
from torchsar.compensate.pulse_phase.stages import _PhaseEstimator, _PhaseEstimatorFromStart
from torchsar.core import Estimate, differentiable, power_of, unit_phasor
from torchsar.optim.scalar import vertex

Kernel = Literal["lumv", "ml", "synchronised", "eigenvector"]
Windows = Literal["shrinking", "measured"] | Sequence[float]
_PADDING = 2  # zero-padding of the pulses; the docstring of this module gives the reason


@differentiable("where ok")
def pga(
    data: Tensor,
    *,
    kernel: Kernel = "lumv",
    start: Tensor | None = None,
    windows: Windows = "shrinking",
    iterations: int = 20,
    patience: int = 6,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase of each pulse by phase gradient autofocus.

    >>> import torch
    >>> from torchsar.compensate import pga
    >>> point = torch.zeros(32, 8, dtype=torch.complex64)  # pulses, range cells
    >>> point[:, 3] = torch.exp(2j * torch.rand(32))
    >>> pga(point, kernel="ml", assess=False)["phase_rad"].shape
    torch.Size([32])

    Every iteration works on the original data with the present phase removed. It shifts the
    strongest cell of each range cell to zero Doppler, applies a window, transforms back to pulses,
    and estimates the remaining phase with the kernel. A constant and a linear part of this phase
    are dropped. Once the window no longer narrows, a trial ends after `patience` iterations that do
    not lower the image entropy. The result is the phase of the iteration with the least entropy,
    because iterations with narrow windows drift away; a loop over the largest number of
    `iterations` thus shows the course of the search. Differentiable, except for the choice of the
    peaks and of that iteration.

    From a zero start PGA fails on phase errors that are large or independent from pulse to pulse;
    use `pga_sca` or `autofocus` for these.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        kernel: Method that estimates the phase from the windowed data. "lumv" (linear unbiased
            minimum variance) and "ml" (maximum likelihood) add up the phases between adjacent
            pulses; "lumv" underestimates steps above one radian. "eigenvector" and "synchronised"
            use all pairs of pulses, with peaks found to a fraction of a cell: "eigenvector" takes
            the phases of the first eigenvector of the covariance matrix between pulses,
            "synchronised" finds the unit phasors that best agree with this matrix.
        start: Phase to start from in rad, shape (..., pulse); by default zero.
        windows: Widths of the window. "shrinking" begins with half of the image and narrows by the
            factor 0.8 per iteration, to 5 Doppler cells. "measured" is 1.5 times as wide as the
            blur 10 dB below the peak, of the power that is summed over the range cells with their
            peaks at zero Doppler, and at least 5 cells. Widths in Doppler cells hold for one
            iteration each, the last for all further ones.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex, or the start is not a tensor.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, the kernel is unknown, the windows are neither of the two names nor a list of
            widths of 1 cell or more, or a number of iterations is not a whole number of 1 or more.

    Reference:
        Kernels: Eichel and Jakowatz 1989 ("lumv"); Jakowatz and Wahl 1993 ("ml", "eigenvector").
        Windows: Ruan et al. 2013, section 3.1 ("shrinking"); Wahl et al. 1994 ("measured").
    """
    pulses, search = prepare(data, "pga"), _Search(kernel, windows, iterations, patience)

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return search(rows, present, torch.zeros_like(rows[:, 0].real) if begin is None else begin)

    return conclude(pulses, *find_phases(pulses, find, starting_phase(start, pulses, "pga")), assess)


@differentiable("where ok")
def pga_sca(
    data: Tensor,
    *,
    kernel: Kernel = "ml",
    windows: Windows = "shrinking",
    iterations: int = 20,
    patience: int = 6,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase of each pulse by phase gradient autofocus (PGA) that starts from `sca`.

    >>> import torch
    >>> from torchsar.compensate import pga_sca
    >>> point = torch.zeros(32, 8, dtype=torch.complex64)  # pulses, range cells
    >>> point[:, 3] = torch.exp(2j * torch.rand(32))
    >>> pga_sca(point, assess=False)["phase_rad"].shape
    torch.Size([32])

    A phase that is added to a pulse of the data is added to the estimate of `sca`. The size of the
    phase errors therefore has no effect on the result.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        kernel: Method that estimates the phase from the windowed data, see `pga`. "ml" forms the
            same products of adjacent pulses as `sca`.
        windows: Widths of the window, see `pga`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite, the kernel or the windows are not valid as
            in `pga`, or a number of iterations is not a whole number of 1 or more.

    Reference:
        Ruan et al. 2013, Eqs. (11)-(16).
    """
    pulses, search = prepare(data, "pga_sca"), _Search(kernel, windows, iterations, patience)

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> tuple[Tensor, Tensor]:
        return search(rows, present, pair_phase(rows, present))

    return conclude(pulses, *find_phases(pulses, find), assess)


@differentiable("where ok")
def sca(data: Tensor, *, assess: bool = True) -> Estimate:
    r"""Estimate the phase of each pulse from the products of adjacent pulses.

    >>> import torch
    >>> from torchsar.compensate import sca
    >>> phase = torch.tensor([0.0, 1.0, 3.0, 2.0])
    >>> point = torch.exp(1j * phase)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    >>> sca(point, assess=False)["phase_rad"]
    tensor([0., 1., 3., 2.])

    The phase between two adjacent pulses is that of the product of one with the conjugate of the
    other, summed over range, :math:`\mathrm{arg} \sum_n s_{k,n} s_{k-1,n}^*`; these phases are
    added up.
    The compensated data are data * exp(-j phase_rad)[..., None]. If a phase a[k] is added to pulse
    k of the data, the estimate grows by exactly a[k], up to a constant, so that the size of the
    phase errors has no effect. Noise and the scene limit the accuracy; a scene of many scatterers
    per range cell leaves an error of about 1.2 rad. Differentiable.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        assess: Whether to add the standard deviation and the outcome, which takes many times as
            long as the estimate.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed, from 0 at the first pulse. At a pulse of
        zeros the phase stays that of the pulse before; the next pulse is paired with the last one
        that holds samples. With `assess`, standard deviation, quality, outcome and info as by
        `autofocus`; the error that the scene causes is seen because further iterations move the
        phases.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite.

    Reference:
        Ruan et al. 2013, Eqs. (4)-(6).
    """

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> tuple[Tensor, Tensor]:
        return pair_phase(rows, present), torch.ones_like(present[:, 0], dtype=torch.int64)

    pulses = prepare(data, "sca")
    return conclude(pulses, *find_phases(pulses, find), assess)


class Sca(_PhaseEstimator):
    """Phase per pulse by the spatial correlation algorithm; see `sca`.

    Args:
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(self, assess: bool = True) -> None:
        super().__init__(sca, assess=assess)


class Pga(_PhaseEstimatorFromStart):
    """Phase per pulse by phase gradient autofocus; see `pga`.

    Args:
        kernel: Method that estimates the phase from the windowed data: "lumv", "ml", "synchronised"
            or "eigenvector", see `pga`.
        windows: Window widths: "shrinking", "measured", or a list of widths in Doppler cells, see
            `pga`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        kernel: Kernel = "lumv",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
        assess: bool = True,
    ) -> None:
        _Search(kernel, windows, iterations, patience)
        super().__init__(pga, kernel=kernel, windows=windows, iterations=iterations, patience=patience, assess=assess)


class PgaSca(_PhaseEstimator):
    """Phase per pulse by phase gradient autofocus started from SCA; see `pga_sca`.

    Args:
        kernel: Method that estimates the phase from the windowed data: "lumv", "ml", "synchronised"
            or "eigenvector", see `pga`.
        windows: Window widths: "shrinking", "measured", or a list of widths in Doppler cells, see
            `pga`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.
    """

    def __init__(
        self,
        kernel: Kernel = "ml",
        windows: Literal["shrinking", "measured"] | list[float] = "shrinking",
        iterations: int = 20,
        patience: int = 6,
        assess: bool = True,
    ) -> None:
        _Search(kernel, windows, iterations, patience)
        super().__init__(
            pga_sca, kernel=kernel, windows=windows, iterations=iterations, patience=patience, assess=assess
        )


@dataclass(frozen=True)
class _Search:
    """The iterations of PGA, as a function of (rows, present, start).

    It returns the phase of the sharpest iterate (trial, pulse) and the number of iterations
    (trial,). Patience is counted only once the window no longer narrows: in clutter, wide windows
    blur for many iterations what narrow ones sharpen later.
    """

    kernel: Kernel
    windows: Windows
    iterations: int
    patience: int

    def __post_init__(self) -> None:
        widths = self.windows if isinstance(self.windows, Sequence) else ()
        if not widths or not (
            widths in ("shrinking", "measured")
            if isinstance(widths, str)
            else all(isinstance(w, Real) and 1 <= w < math.inf for w in widths)
        ):
            raise ValueError(
                "pga: windows must be 'shrinking', 'measured' or a list of widths of 1 Doppler cell or more, "
                f"got {self.windows!r}"
            )
        refuse_odd_counts("pga", 1, iterations=self.iterations, patience=self.patience)
        if self.kernel not in _KERNELS:
            raise ValueError(f"PGA kernel {self.kernel!r} is not known; choose one of {', '.join(_KERNELS)}")

    def __call__(self, rows: Tensor, present: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        best, lowest = phase, torch.full_like(phase[:, 0], torch.inf)
        idle = made = torch.zeros_like(present[:, 0], dtype=torch.int64)
        narrows, last = torch.ones_like(present[:, 0]), torch.full_like(phase[:, 0], torch.inf)
        for iteration in range(self.iterations + 1):
            view = View.of(rows, present, phase)
            # entropy of the images in nats
            total, tiny = view.power.sum((-2, -1)), torch.finfo(view.power.dtype).tiny
            terms = view.power.clamp_min(tiny).log_().mul_(view.power).sum((-2, -1))
            cost = torch.log(total.clamp_min(tiny)) - terms / torch.where(total > 0, total, 1)
            better = cost < lowest
            best, lowest = torch.where(better[:, None], phase, best), torch.where(better, cost, lowest)
            idle = torch.where(better | narrows, 0, idle + 1)
            active = idle < self.patience
            if iteration == self.iterations or not bool(active.any()):
                break
            width = window_width(self.windows, iteration, view).to(phase).expand(len(phase))
            narrows, last = width < last, width
            cells = view.windowed((_PADDING * width / 2).floor().long())
            step = without_line(_KERNELS[self.kernel](view, cells), present)
            phase = torch.where(active[:, None], phase + step, phase)
            made = made + active
        return best, made


def window_width(windows: Windows, iteration: int, view: View) -> Tensor:
    """Compute the width of the window of an iteration.

    Args:
        windows: Widths of the window, see `pga`.
        iteration: Number of the iteration, from 0.
        view: The image.

    Returns:
        The width in Doppler cells, shape (1,) or (trial,).
    """
    n, floor = view.present.shape[-1], 5.0
    if windows == "shrinking":
        return torch.tensor([max(floor, 0.5 * n * 0.8**iteration)])
    if windows != "measured":
        return torch.tensor([windows[min(iteration, len(windows) - 1)]])
    # power at each distance from the peaks, summed over the range cells; cells that padding adds
    # are skipped
    index = torch.arange(0, _PADDING * n, _PADDING, device=view.peak.device) + view.peak[..., None]
    about = view.power.gather(-1, torch.remainder(index, _PADDING * n)).sum(-2)
    folded = torch.maximum(about, about.flip(-1).roll(1, -1))[..., : n // 2 + 1]
    above = folded >= 10 ** (-10.0 / 10) * folded[..., :1]
    reach = torch.where(above, torch.arange(folded.shape[-1], device=about.device), 0).amax(-1)
    return (1.5 * (2.0 * reach + 1)).clamp(floor, n)


@dataclass(frozen=True)
class View:
    """Padded image of pulses, its power, and the peaks of its range cells.

    Args:
        image: Image, shape (trial, range, 2 pulse), complex.
        power: Its power without derivatives.
        peak: Strongest cell of each range cell, shape (trial, range).
        present: False where a pulse holds only zeros, shape (trial, pulse).
    """

    image: Tensor
    power: Tensor
    peak: Tensor
    present: Tensor

    @staticmethod
    def of(rows: Tensor, present: Tensor, phase: Tensor) -> View:
        """Form the padded image of pulses after a phase is removed."""
        image = torch.fft.fft(rotate(rows, phase), _PADDING * rows.shape[-1], norm="ortho")
        power = power_of(image.detach())
        return View(image, power, power.max(-1).indices, present)

    def windowed(self, half: Tensor) -> Tensor:
        """Take the cells within `half` (trial,) of the peak of each range cell, zero beyond.

        The result has shape (trial, range, 2 reach + 1), with the peak in the middle.
        """
        padded = self.image.shape[-1]
        reach = min(int(half.max()), padded // 2 - 1)
        offsets = torch.arange(-reach, reach + 1, device=self.peak.device)
        near = self.image.gather(-1, torch.remainder(self.peak[..., None] + offsets, padded))
        return near * (offsets.abs() <= half[:, None, None]) if bool((half < reach).any()) else near

    def pulses(self, cells: Tensor) -> Tensor:
        """Transform cells around zero Doppler back to pulses, (trial, range, pulse)."""
        return torch.fft.ifft(_spread(cells, self.image.shape[-1]), norm="ortho")[..., : self.present.shape[-1]]

    def adjacent(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Products (trial, pulse - 1) of each pulse with the conjugate of the pulse before it,
        summed over range, and powers of the pulse before.

        As functions of slow time, the sums contain only the differences of Doppler within the
        window. If the window is narrow, they are computed at fewer times than there are pulses and
        interpolated, which is exact.
        """
        padded, reach = self.image.shape[-1], cells.shape[-1] // 2
        length = 1 << (4 * reach).bit_length()
        if 2 * length > padded or not bool(self.present.all()):
            g = self.pulses(cells)
            return pair_products(g, self.present), power_of(g[..., :-1]).sum(-2)
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float64, device=cells.device)
        earlier = cells * unit_phasor(-offsets / padded, cells.dtype)
        now, before = (torch.fft.ifft(_spread(x, length), norm="forward") for x in (cells, earlier))
        sums = torch.stack([(now * before.conj()).sum(-2), power_of(before).sum(-2).to(now.dtype)])
        harmonics = torch.fft.fftshift(torch.fft.fft(sums, norm="forward"), dim=-1)[..., 1:]
        products, powers = torch.fft.ifft(_spread(harmonics, padded))[..., 1 : self.present.shape[-1]]
        return products, powers.real

    def centred(self, cells: Tensor) -> Tensor:
        """Pulses of the windowed cells with the interpolated peaks shifted to zero Doppler; absent
        pulses are zero.

        Kernels that are coherent over the aperture need the peaks to a fraction of a Doppler cell.
        """
        g, padded = self.pulses(cells), self.image.shape[-1]
        k = torch.arange(g.shape[-1], dtype=torch.float64, device=g.device)
        low, top, high = (
            power_of(self.image.gather(-1, torch.remainder(self.peak[..., None] + d, padded)))[..., 0]
            # not zero, since the derivative of the root is infinite there
            .clamp_min(torch.finfo(self.power.dtype).tiny)
            .sqrt()
            for d in (-1, 0, 1)
        )
        turns = -(vertex(low, top, high).clamp(-0.5, 0.5) / padded)[..., None].double() * k
        return g * unit_phasor(turns, g.dtype) * self.present[:, None, :]


def _spread(cells: Tensor, n: int) -> Tensor:
    """Put cells (..., 2 reach + 1) around zero Doppler into FFT order, with zeros up to n cells."""
    reach = cells.shape[-1] // 2
    zeros = cells.new_zeros((*cells.shape[:-1], n - cells.shape[-1]))
    return torch.cat([cells[..., reach:], zeros, cells[..., :reach]], -1)


def _lumv(view: View, cells: Tensor) -> Tensor:
    """Phases of the LUMV kernel: running sum of Im(conj(g) dg) / |g|^2, each summed over range,
    with dg = g[k] - g[k - 1].
    """
    products, before = view.adjacent(cells)
    step = products.imag / torch.where(before > 0, before, 1)
    return torch.cat([torch.zeros_like(step[..., :1]), step.cumsum(-1)], -1)


def _coherent(view: View, cells: Tensor, unit: bool) -> Tensor:
    """Phases of the eigenvector of the largest eigenvalue of the sum over rows of g g^H, by six
    power steps.

    With `unit`, the vector is reduced to unit modulus in each step. The phases then make the rows
    most coherent over the aperture.
    """
    g = view.centred(cells)
    v = torch.ones_like(g[:, 0])
    for _ in range(6):
        v = (g * (g.conj() * v[:, None, :]).sum(-1, keepdim=True)).sum(-2)
        largest = v.detach().abs().amax(-1, keepdim=True)
        v = v / torch.where(largest > 0, largest, 1)
        v = v / torch.where(v == 0, 1, v.abs()) if unit else v
    return safe_angle(v)


# functions that return the phases (trial, pulse) of each kernel, given the image and its windowed
# cells
_KERNELS: dict[Kernel, Callable[[View, Tensor], Tensor]] = {
    "lumv": _lumv,
    "ml": lambda view, cells: running_sum(view.adjacent(cells)[0]),
    "synchronised": lambda view, cells: _coherent(view, cells, True),
    "eigenvector": lambda view, cells: _coherent(view, cells, False),
}
