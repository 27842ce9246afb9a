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
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.assess import conclude
from torchsar.compensate.pulse_phase.data import (
    find_phases,
    prepare,
    refuse_odd_counts,
    rotate,
    safe_angle,
    starting_phase,
    without_line,
)
from torchsar.compensate.pulse_phase.pairs import pair_phase, pair_products, running_sum
from torchsar.core import Estimate, power_of, unit_phasor
from torchsar.core.arguments import names_arguments

Kernel = Literal["lumv", "ml", "synchronised", "eigenvector"]
_PADDING = 2  # zero-padding of the pulses; the docstring of this module gives the reason


@names_arguments
@dataclass(frozen=True)
class Shrinking:
    """A PGA window that narrows by a constant factor per iteration.

    Args:
        first: First width as a fraction of the number of Doppler cells (1/2 in Ruan et al. 2013,
            section 3.1).
        factor: Factor by which the width changes per iteration (0.8 in Ruan et al. 2013, section
            3.1).
        floor: Smallest width in Doppler cells.

    Raises:
        ValueError: If `first` or `factor` is not in 0..1, or the floor is below 1 cell.
    """

    first: float = 0.5
    factor: float = 0.8
    floor: float = 5.0

    def __post_init__(self) -> None:
        if not (0 < self.first <= 1 and 0 < self.factor <= 1 and self.floor >= 1):
            raise ValueError(
                "Shrinking: first and factor must be above 0 and at most 1, and floor must be 1 Doppler cell or "
                f"more, got {self}"
            )

    def width(self, iteration: int, n: int, profile: Callable[[], Tensor]) -> Tensor:
        """Compute the width of the PGA window, which narrows by a constant factor per iteration.

        Args:
            iteration: Number of the iteration, from 0.
            n: Number of Doppler cells of the image.
            profile: Not used.

        Returns:
            The width in Doppler cells, shape (1,).
        """
        return torch.tensor([max(self.floor, self.first * n * self.factor**iteration)])


@names_arguments
@dataclass(frozen=True)
class Measured:
    """A PGA window that follows the width of the blur.

    The peak of each range cell is shifted to zero Doppler, and the power is summed over the range
    cells. The width of the blur is that of the interval, centred on the peak of this sum, that
    holds all cells at most `level_db` below the peak. The window is `margin` times as wide.

    Args:
        level_db: Level below the peak in dB, positive.
        margin: Factor applied to the measured width.
        floor: Smallest width in Doppler cells.

    Reference:
        Wahl et al. 1994 (10 dB and a margin of 50 %).
    """

    level_db: float = 10.0
    margin: float = 1.5
    floor: float = 5.0

    def width(self, iteration: int, n: int, profile: Callable[[], Tensor]) -> Tensor:
        """Compute the width of the PGA window from the width of the blur.

        Args:
            iteration: Not used.
            n: Number of Doppler cells of the image.
            profile: Function that returns the power along Doppler, summed over the range cells with
                their peaks shifted to index 0, shape (trial, n).

        Returns:
            The width in Doppler cells, shape (trial,).
        """
        about = profile()
        folded = torch.maximum(about, about.flip(-1).roll(1, -1))[..., : n // 2 + 1]
        above = folded >= 10 ** (-self.level_db / 10) * folded[..., :1]
        reach = torch.where(above, torch.arange(folded.shape[-1], device=about.device), 0).amax(-1)
        return (self.margin * (2.0 * reach + 1)).clamp(self.floor, n)


@names_arguments
@dataclass(frozen=True)
class Listed:
    """A list of PGA window widths, one per iteration; the last serves all further iterations.

    Args:
        cells: Widths in Doppler cells.

    Raises:
        ValueError: If the list is empty or a width is below 1 cell.
    """

    cells: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.cells or not all(math.isfinite(w) and w >= 1 for w in self.cells):
            raise ValueError(f"Listed: cells must hold window widths of 1 Doppler cell or more, got {self.cells}")

    def width(self, iteration: int, n: int, profile: Callable[[], Tensor]) -> Tensor:
        """Look up the width of the PGA window of an iteration in the list.

        Args:
            iteration: Number of the iteration, from 0.
            n: Not used.
            profile: Not used.

        Returns:
            The width in Doppler cells, shape (1,).
        """
        return torch.tensor([self.cells[min(iteration, len(self.cells) - 1)]])


# a schedule of window widths: `width` maps the number of the iteration, the number of Doppler
# cells, and a function that returns the power about the peaks, to widths in Doppler cells
Windows = Shrinking | Measured | Listed


def pga(
    data: Tensor,
    *,
    kernel: Kernel = "lumv",
    start: Tensor | None = None,
    windows: Windows | None = None,
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
    because iterations with narrow windows drift away. Differentiable, except for the choice of the
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
        windows: Schedule of window widths, by default `Shrinking()`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex, the start is not a tensor, or `windows` is not a
            schedule.
        ValueError: If the data are empty or not finite, the start does not have one phase per
            pulse, the kernel is unknown, or a number of iterations is not a whole number of 1 or
            more.

    Reference:
        Kernels: Eichel and Jakowatz 1989 ("lumv"); Jakowatz and Wahl 1993 ("ml", "eigenvector").
    """
    pulses = prepare(data, "pga")
    search = _Search(_solver(kernel), windows or Shrinking(), iterations, patience)

    def find(rows: Tensor, present: Tensor, begin: Tensor | None) -> tuple[Tensor, Tensor]:
        return search(rows, present, torch.zeros_like(rows[:, 0].real) if begin is None else begin)

    return conclude(pulses, *find_phases(pulses, find, starting_phase(start, pulses, "pga")), assess)


def pga_sca(
    data: Tensor,
    *,
    kernel: Kernel = "ml",
    windows: Windows | None = None,
    iterations: int = 20,
    patience: int = 6,
    assess: bool = True,
) -> Estimate:
    """Estimate the phase of each pulse by phase gradient autofocus (PGA) that starts from `sca`.

    A phase that is added to a pulse of the data is added to the estimate of `sca`. The size of the
    phase errors therefore has no effect on the result.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        kernel: Method that estimates the phase from the windowed data, see `pga`. "ml" forms the
            same products of adjacent pulses as `sca`.
        windows: Schedule of window widths, by default `Shrinking()`.
        iterations: Largest number of iterations.
        patience: Number of iterations without a lower image entropy after which a trial ends.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. With `assess`, standard deviation,
        quality, outcome and info as by `autofocus`.

    Raises:
        TypeError: If the data are not complex or `windows` is not a schedule.
        ValueError: If the data are empty or not finite, the kernel is unknown, or a number of
            iterations is not a whole number of 1 or more.

    Reference:
        Ruan et al. 2013, Eqs. (11)-(16).
    """
    search = _Search(_solver(kernel), windows or Shrinking(), iterations, patience)

    def find(rows: Tensor, present: Tensor, _: Tensor | None) -> tuple[Tensor, Tensor]:
        return search(rows, present, pair_phase(rows, present))

    pulses = prepare(data, "pga_sca")
    return conclude(pulses, *find_phases(pulses, find), assess)


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


Solver = Callable[["_Rows", "_View"], Tensor]


@dataclass(frozen=True)
class _Search:
    """The iterations of PGA.

    Maps (rows, present, start) to the phase of the sharpest iterate (trial, pulse) and the number
    of iterations (trial,). Patience is counted only once the window no longer narrows: in clutter,
    wide windows blur for many iterations what narrow ones sharpen later.
    """

    solve: Solver
    windows: Windows
    iterations: int
    patience: int

    def __post_init__(self) -> None:
        refuse_odd_counts("pga", 1, iterations=self.iterations, patience=self.patience)
        if not hasattr(self.windows, "width"):
            raise TypeError(
                "pga: windows must be a schedule such as Shrinking(), Measured() or Listed((99.0, "
                f"33.0, 11.0)), got {self.windows!r}"
            )

    def __call__(self, rows: Tensor, present: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        best, lowest = phase, torch.full_like(phase[:, 0], torch.inf)
        idle = made = torch.zeros_like(present[:, 0], dtype=torch.int64)
        narrows, last = torch.ones_like(present[:, 0]), torch.full_like(phase[:, 0], torch.inf)
        for iteration in range(self.iterations + 1):
            view = _view(rows, phase)
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
            width = (
                self.windows.width(iteration, rows.shape[-1], lambda view=view: _profile(view))
                .to(phase)
                .expand(len(phase))
            )
            narrows, last = width < last, width
            # from the windowed rows with their peaks at zero Doppler
            rows_about = _Rows(_windowed(view, (_PADDING * width / 2).floor().long()), view.image.shape[-1], present)
            step = without_line(self.solve(rows_about, view), present)
            phase = torch.where(active[:, None], phase + step, phase)
            made = made + active
        return best, made


@dataclass(frozen=True)
class _View:
    """A padded image (trial, range, 2 n), its detached power, and the strongest cell of each row.

    The strongest cells have shape (trial, range).
    """

    image: Tensor
    power: Tensor
    peak: Tensor


def _view(rows: Tensor, phase: Tensor) -> _View:
    """Padded image of the pulses with a phase removed."""
    image = torch.fft.fft(rotate(rows, phase), _PADDING * rows.shape[-1], norm="ortho")
    power = power_of(image.detach())
    return _View(image, power, power.max(-1).indices)


@dataclass(frozen=True)
class _Rows:
    """Rows whose image holds only the cells (trial, range, 2 reach + 1) about zero Doppler.

    `padded` is the number of all cells of the image, `present` (trial, pulse) of the pulses.
    """

    cells: Tensor
    padded: int
    present: Tensor

    def pulses(self) -> Tensor:
        """The pulses (trial, range, pulse)."""
        image = _spread(self.cells, self.padded)
        return torch.fft.ifft(image, norm="ortho")[..., : self.present.shape[-1]]

    def adjacent(self) -> tuple[Tensor, Tensor]:
        """Products (trial, pulse - 1) of pulses with the conjugate of the pulse before, summed over
        range, and powers of the pulse before.

        The sums hold only the differences of Doppler within the window. Where it is narrow, they
        are computed at fewer times than there are pulses and interpolated, which is exact.
        """
        reach = self.cells.shape[-1] // 2
        length = 1 << (4 * reach).bit_length()
        if 2 * length > self.padded or not bool(self.present.all()):
            g = self.pulses()
            return pair_products(g, self.present), power_of(g[..., :-1]).sum(-2)
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float64, device=self.cells.device)
        earlier = self.cells * unit_phasor(-offsets / self.padded, self.cells.dtype)
        now, before = (torch.fft.ifft(_spread(x, length), norm="forward") for x in (self.cells, earlier))
        sums = torch.stack([(now * before.conj()).sum(-2), power_of(before).sum(-2).to(now.dtype)])
        harmonics = torch.fft.fftshift(torch.fft.fft(sums, norm="forward"), dim=-1)[..., 1:]
        products, powers = torch.fft.ifft(_spread(harmonics, self.padded))[..., 1 : self.present.shape[-1]]
        return products, powers.real


def _windowed(view: _View, half: Tensor) -> Tensor:
    """The cells within `half` (trial,) of the peak of each row, and zeros beyond.

    (trial, range, 2 reach + 1) with the peak in the middle.
    """
    padded = view.image.shape[-1]
    reach = min(int(half.max()), padded // 2 - 1)
    offsets = torch.arange(-reach, reach + 1, device=view.peak.device)
    near = view.image.gather(-1, torch.remainder(view.peak[..., None] + offsets, padded))
    return near * (offsets.abs() <= half[:, None, None]) if bool((half < reach).any()) else near


def _spread(cells: Tensor, n: int) -> Tensor:
    """Cells (..., 2 reach + 1) about zero in FFT order, with zeros up to n."""
    reach = cells.shape[-1] // 2
    zeros = cells.new_zeros((*cells.shape[:-1], n - cells.shape[-1]))
    return torch.cat([cells[..., reach:], zeros, cells[..., :reach]], -1)


def _profile(view: _View) -> Tensor:
    """Power about the peaks, summed over rows, peak first, (trial, n); padded cells are skipped."""
    padded = view.power.shape[-1]
    index = torch.remainder(torch.arange(0, padded, _PADDING, device=view.peak.device) + view.peak[..., None], padded)
    return view.power.gather(-1, index).sum(-2)


def _solver(kernel: Kernel) -> Solver:
    """The function of a kernel."""
    solvers: dict[str, Solver] = {
        "lumv": _lumv,
        "ml": lambda rows, _: running_sum(rows.adjacent()[0]),  # the phases between adjacent pulses
        "synchronised": partial(_coherent, unit=True),
        "eigenvector": partial(_coherent, unit=False),
    }
    if kernel not in solvers:
        raise ValueError(f"PGA kernel {kernel!r} is not known; choose one of {', '.join(solvers)}")
    return solvers[kernel]


def _lumv(rows: _Rows, view: _View) -> Tensor:
    """LUMV kernel: sum of Im(conj(g) dg) / sum |g|^2, with dg = g[k] - g[k - 1]."""
    products, before = rows.adjacent()
    step = products.imag / torch.where(before > 0, before, 1)
    return torch.cat([torch.zeros_like(step[..., :1]), step.cumsum(-1)], -1)


def _coherent(rows: _Rows, view: _View, unit: bool) -> Tensor:
    """Phases of the first eigenvector of the sum over rows of g g^H, by power steps.

    With steps of unit modulus, the phases make the rows most coherent over the aperture.
    """
    g = _centred(rows, view)
    v = torch.ones_like(g[:, 0])
    for _ in range(6):  # found by trial: accuracy against time
        v = (g * (g.conj() * v[:, None, :]).sum(-1, keepdim=True)).sum(-2)
        largest = v.detach().abs().amax(-1, keepdim=True)
        v = v / torch.where(largest > 0, largest, 1)
        v = v / torch.where(v == 0, 1, v.abs()) if unit else v
    return safe_angle(v)


def _centred(rows: _Rows, view: _View) -> Tensor:
    """The rows with their interpolated peaks at zero Doppler, and zeros for missing pulses.

    Kernels that are coherent over the aperture need the peaks to a fraction of a cell.
    """
    g, padded = rows.pulses(), view.power.shape[-1]
    k = torch.arange(g.shape[-1], dtype=torch.float64, device=g.device)
    low, top, high = (
        view.power.gather(-1, torch.remainder(view.peak[..., None] + d, padded))[..., 0].sqrt() for d in (-1, 0, 1)
    )
    bend = low - 2 * top + high  # of a parabola through three amplitudes
    offset = torch.where(bend < 0, 0.5 * (low - high) / torch.where(bend < 0, bend, -1), 0).clamp(-0.5, 0.5)
    turns = -(offset / padded)[..., None].double() * k
    return g * unit_phasor(turns, g.dtype) * rows.present[:, None, :]
