"""Alignment of the envelopes of pulses in range, before their phases are estimated.

A shift is the range position of a pulse relative to the other pulses, in range cells. It is
positive towards greater range and circular in the range window. `shift_range(data, -shift_cells)`
removes it. The envelope of a pulse with the samples s is its power |s|^2, divided by its mean, so
that neither the phase nor the gain of the pulse affects the shift. The envelope is sampled every
half cell, where it is band-limited and can be shifted by any fraction of a cell without error.

A range cell with many scatterers is speckle: its power in a pulse has an exponential distribution.
The mean T of this distribution, noise included, is estimated from all pulses. The log-likelihood of
a shift is then the correlation of |s|^2 with -1 / T. This was tried on a simulated aircraft (as in
Ruan et al. 2013, Fig. 2). The shifts of single pulses have half the jitter that they have with the
usual correlation of |s| with its mean. A polynomial of slow time can be fitted at an SNR of -10 dB
per sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchsar.compensate import envelope_assess
from torchsar.compensate.envelope_fit import (
    Course,
    Envelopes,
    centred,
    gate_jumps,
    likeliest_jumps,
    log_likelihood,
    running_shifts,
    single_shifts,
    smooth_shifts,
    with_tones,
)
from torchsar.compensate.pulse_phase.data import checked
from torchsar.core import (
    Estimate,
    Signal,
    Stage,
    block_bytes_of,
    checked_samples,
    differentiable,
    host_value,
    linear_phasor,
    refuse_non_finite,
    true_positions,
)

Method = Literal["polynomial", "single", "amplitude", "running"]


def shift_range(data: Tensor, shift_cells: Tensor | float) -> Tensor:
    """Shift every pulse in range, circularly.

    >>> import torch
    >>> from torchsar.compensate import shift_range
    >>> pulses = torch.zeros(3, 8, dtype=torch.complex64)
    >>> pulses[:, 4] = 1
    >>> shift_range(pulses, torch.tensor([-1.0, 0.0, 2.0])).abs().argmax(-1)
    tensor([3, 4, 6])

    The shift multiplies the range spectrum by a linear phase that is zero in the middle of the
    band. The phase of an echo therefore does not change with its position. Unitary: the shift -s
    reverses the shift s. Differentiable in both arguments.

    Args:
        data: Range-compressed pulses, shape (..., pulse, range), complex.
        shift_cells: Shifts in range cells, positive towards greater range, shape (..., pulse),
            (pulse,) or a number.

    Returns:
        The shifted pulses, shape (..., pulse, range), complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the shifts have another shape or are not finite.
    """
    data = checked_samples(data, "shift_range", "pulse, range", finite=False)
    n = data.shape[-1]
    shift = torch.as_tensor(shift_cells, dtype=torch.float64, device=data.device)
    if shift.ndim and shift.shape[-1] != data.shape[-2]:
        raise ValueError(
            f"shift_range: shift_cells must be a number or hold one shift per pulse, (..., {data.shape[-2]}), "
            f"got shape {tuple(shift.shape)}"
        )
    refuse_non_finite(shift, "shift_range: shift_cells")
    phasor = torch.fft.ifftshift(linear_phasor(-shift / n, -(n // 2), n, data.dtype), dim=-1)
    return torch.fft.ifft(torch.fft.fft(data) * phasor)


@differentiable("no")
def align_envelopes(
    data: Tensor,
    *,
    method: Method = "polynomial",
    degree: int = 2,
    tones: int = 0,
    passes: int = 6,
    blocks: int = 16,
    assess: bool = True,
) -> Estimate:
    """Estimate the range shifts of pulses, by default as a smooth function of slow time.

    >>> pulses = torch.zeros(40, 32, dtype=torch.complex64)
    >>> pulses[:, 10], pulses[:, 13] = 1, 2
    >>> moved = shift_range(pulses, torch.linspace(-2, 2, 40))
    >>> align_envelopes(moved)["shift_cells"][[0, -1]].round()
    tensor([-2.,  2.], dtype=torch.float64)

    First the drift is found: the straight line of slow time along which the envelopes, smoothed in
    range, add up best. Then each of `passes` rounds estimates the shift of each block of pulses by
    its likelihood, given the mean envelope of the other blocks. A polynomial is fitted to these
    shifts, robust against blocks that failed. Jumps of the range gate by whole cells between pulses
    are found from single pulses, given all of them, and kept where they are likelier. What single
    pulses leave open adds to the standard deviation. With less than about four scatterers per range
    cell, jumps cost no accuracy from an SNR of 0 dB per sample on; below that, rare jumps and those
    by one cell may be ok and wrong (rates on the page of outcomes). Shifts may cross the ends of
    the window any number of times, but must not depart from a straight line by half a window. Not
    differentiable.

    On 400 pulses of a simulated aircraft the error of the shifts is 0.02 cell at an SNR of -8 dB
    per sample and above, and 0.05 cell at -12.5 dB. On noise-free data the remaining shifts raise
    the image entropy by less than 0.002 nats. The other methods follow motion that is not smooth,
    of less than half a range window from pulse to pulse, and need an SNR of about 0 dB:

    - "running": each pulse against a running mean of the ten pulses before it; the amplitudes are
      correlated. The mean drifts: a start for the other two.
    - "amplitude": each pulse against the mean of all aligned pulses, by the correlation of the
      amplitudes |s|, the usual method.
    - "single": the same by the likelihood of the powers |s|^2, whose speckle jitter is half as
      large: 0.03 cell rms on noise-free data of a simulated aircraft.

    Args:
        data: Range-compressed pulses of any phase, shape (..., pulse, range), complex.
        method: "polynomial", "single", "amplitude" or "running".
        degree: Degree of the polynomial.
        tones: Number of sinusoids (vibration) that are also estimated from the shifts of single
            pulses. One is kept where it clearly exceeds the jitter of these shifts. Its period must
            be two pulses or more and the SNR about -5 dB per sample or more.
        passes: Number of rounds of the polynomial.
        blocks: Number of blocks of pulses for the polynomial.
        assess: Whether to add the standard deviation, the quality and the outcome.

    Returns:
        `shift_cells` in range cells, shape (..., pulse), positive towards greater range, of mean
        zero; `shift_range(data, -shift_cells)` removes these shifts. A pulse of zeros has the shift
        of the fitted history. info["present"] is True for the pulses that hold samples.
        The assessment adds the standard deviation: of a polynomial, from the scatter of the blocks
        about it and what single pulses leave open; of single pulses, from the difference of the two
        halves of the band. `quality` is 1 / (1 + (2 std)^2). The outcome is EMPTY without samples
        and NOISE where shifts scatter as random ones do; TOO_FEW for fewer than two pulses with
        samples or four range cells, PARTS_DISAGREE where the two halves of the band do not confirm
        a polynomial or its standard deviation reaches an eighth of a cell, and INEXACT where that
        of single pulses reaches half a cell.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite, or an option is invalid.
    """
    whole = all(isinstance(value, int) for value in (degree, tones, passes, blocks))
    if not (whole and degree >= 0 and tones >= 0 and passes >= 1 and blocks >= 1):
        raise ValueError(
            "align_envelopes: degree and tones must be whole numbers of 0 or more, passes and blocks of 1 or more, "
            f"got degree {degree!r}, tones {tones!r}, passes {passes!r} and blocks {blocks!r}"
        )

    if method not in get_args(Method):
        raise ValueError(f"align_envelopes: method must be one of {list(get_args(Method))}, got {method!r}")
    if tones and method != "polynomial":
        raise ValueError(f"align_envelopes: tones belong to the method 'polynomial', got method {method!r}")

    def find(pulses: Envelopes) -> Course:
        if method == "polynomial":
            smooth, std = smooth_shifts(pulses, degree, passes, blocks)
            return with_tones(pulses, smooth, tones, degree), std
        shift = running_shifts(pulses, 0.1)
        if method != "running":
            shift = single_shifts(pulses, shift, "amplitude" if method == "amplitude" else "likelihood", 4)
        return single_shifts(pulses, shift, "refined", 2) if method == "single" else shift, None

    flat, present = checked(data, "align_envelopes")
    flat, shape = flat.detach(), data.shape[:-2]
    size = flat.shape[1] * flat.shape[2] * flat.element_size()
    parts = flat.split(max(1, 8 * block_bytes_of(flat.device) // max(1, size))) if len(flat) else ()
    parts, jumps = [*parts], []
    courses: list[Course] = []
    for i, part in enumerate(parts):
        pulses = Envelopes.of(part)
        smooth, std = find(pulses)
        jump = torch.zeros_like(smooth)
        if std is not None:
            parts[i], smooth, std, jump = _with_jumps(part, pulses, find, smooth, std)
        courses.append((smooth, std))
        jumps.append(jump)
    shifts = [course[0] + jump for course, jump in zip(courses, jumps, strict=True)]
    enough = present.sum(-1, keepdim=True) >= 2
    shift = torch.where(enough, centred(torch.cat(shifts), present), 0) if parts else present.double()
    value, info = {"shift_cells": shift.reshape(data.shape[:-1])}, {"present": present.reshape(data.shape[:-1])}
    found = Estimate(value, quality=shift.new_ones(shape), info=info)
    if not (assess and parts):
        return found
    judged = [envelope_assess.deviation(part, *course, find) for part, course in zip(parts, courses, strict=True)]
    std, agree = (torch.cat(each).reshape(shape) for each in zip(*judged, strict=True))
    return envelope_assess.assessed(found, std, agree, data.shape[-1])


def _with_jumps(
    lines: Tensor, pulses: Envelopes, find: Callable[[Envelopes], Course], smooth: Tensor, std: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find jumps of the range gate beside smooth shifts, in trials where they are likelier.

    Args:
        lines: Pulses, shape (trial, pulse, range), complex.
        pulses: Their envelopes.
        find: Estimator of smooth shifts.
        smooth: Its shifts in cells, shape (trial, pulse).
        std: Their standard deviation in cells, shape (trial,).

    Returns:
        The pulses without the jumps, the smooth shifts, their standard deviation, which includes
        what single pulses leave open, and the jumps in whole cells, in the same shapes.
    """
    jump, moved = torch.zeros_like(smooth), pulses.moved(smooth)
    apart = likeliest_jumps(pulses, smooth, jump)[1]
    # a gate that follows the target leaves no pulse a whole cell apart, but most of them a part
    step = pulses.peak(moved * pulses.likelihood(moved.sum(-2, keepdim=True) / pulses.count).conj()).abs()
    step = torch.where(pulses.present, step, torch.nan).nanmedian(-1).values
    # jumps of less rms size, in cells, cost no accuracy that matters
    open_to_jumps = (apart > 0.02) | (step > 0.1)
    at = true_positions(open_to_jumps, host_value(open_to_jumps.sum(), len(apart)))
    if len(at):
        some, some_lines = Envelopes(pulses.spectra[at], pulses.present[at], pulses.n), lines[at]
        here = gate_jumps(some, smooth[at])
        again, _ = find(Envelopes.of(shift_range(some_lines, -here)))
        for _ in range(3):
            here, _ = likeliest_jumps(some, again, here)
        without = shift_range(some_lines, -here)
        again, std_again = find(Envelopes.of(without))
        apart_again = likeliest_jumps(some, again, here)[1]
        gain = log_likelihood(some, again + here) - log_likelihood(some, smooth[at])
        better = gain > math.log(2 * pulses.n) * (here.diff() != 0).sum(-1)
        at, pick = at[better], better
        smooth, jump = smooth.index_copy(0, at, again[pick]), jump.index_copy(0, at, here[pick])
        lines, apart = lines.index_copy(0, at, without[pick]), apart.index_copy(0, at, apart_again[pick])
        std = std if std_again is None else std.index_copy(0, at, std_again[pick])
    return lines, smooth, torch.hypot(std, apart), jump


class AlignEnvelopes(Stage):
    """Stage that estimates the range shift of every pulse and the mean range rate.

    It calls `align_envelopes` and leaves the signal unchanged. It provides `shift_m` of shape
    (..., pulse), positive towards greater range, which `ShiftRange` can remove, and the range rate
    `velocity_m_s` of shape (...,), receding positive. The range rate is ambiguous by one range
    window per pulse. Where dechirped pulses couple range to Doppler, an acceleration a of the
    target adds a f0 / gamma to the range rate, with carrier frequency f0 and chirp rate gamma
    (f0 / gamma is 0.13 s for the parameters of Ruan et al. 2013).

    Args:
        method: "polynomial", "single", "amplitude" or "running", see `align_envelopes`.
        degree: Degree of the polynomial of slow time.
        tones: Number of sinusoids (vibration) to estimate.
        passes: Number of rounds of the polynomial.
        blocks: Number of blocks of pulses for the polynomial.
        assess: Whether to add the standard deviation, the quality and the outcome.
    """

    provides = ("shift_m", "velocity_m_s")
    neutral = {"shift_m": 0.0, "velocity_m_s": 0.0}
    differentiable = "no"

    def __init__(
        self,
        method: Method = "polynomial",
        degree: int = 2,
        tones: int = 0,
        passes: int = 6,
        blocks: int = 16,
        assess: bool = True,
    ) -> None:
        super().__init__()
        self.options: dict[str, Any] = {"method": method, "degree": degree, "tones": tones, "passes": passes}
        self.options |= {"blocks": blocks, "assess": assess}

    def forward(self, signal: Signal, velocity_m_s: Tensor | None = None) -> Estimate:
        """Estimate the shifts of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            velocity_m_s: Range rate in m/s for which the pulses were compressed, shape (...,).

        Returns:
            `shift_m` in metres, shape (..., pulse), and its standard deviation. `velocity_m_s`,
            shape (...,), is the mean rate of the shifts plus the `velocity_m_s` given, if any: the
            value to give to `torchsar.focus.CompressDechirped`. `quality`, outcome and `info` are
            those of `align_envelopes`.
        """
        found = align_envelopes(signal.data, **self.options)
        cells, cell_m = found["shift_cells"], signal.axis("range").step
        # slope of the line fitted by least squares; 0 for a single pulse
        k = torch.arange(cells.shape[-1], dtype=cells.dtype, device=cells.device) - (cells.shape[-1] - 1) / 2
        drift = (cells * k).sum(-1) / k.square().sum().clamp_min(1)
        velocity = drift * (cell_m / signal.axis("pulse").step) + (0 if velocity_m_s is None else velocity_m_s)
        value = {"shift_m": cells * cell_m, "velocity_m_s": velocity}
        std = {"shift_m": found.std["shift_cells"] * cell_m} if found.std else {}
        return replace(found, value=value, std=std)


class ShiftRange(Stage):
    """Stage that aligns the pulses: each is moved in range by -`shift_m` (metres).

    `shift_m` usually comes from an earlier stage such as `AlignEnvelopes`. The move is circular,
    see `shift_range`. Differentiable in the signal and the shifts.
    """

    def forward(self, signal: Signal, shift_m: Tensor) -> Signal:
        """Shift the pulses of a signal of axes (pulse, range).

        Args:
            signal: Range-compressed pulses, shape (..., pulse, range), complex.
            shift_m: Shifts to remove in metres, shape (..., pulse), positive towards greater range,
                such as those of `AlignEnvelopes`.

        Returns:
            The signal with every pulse moved by -shift_m.
        """
        return signal.with_data(shift_range(signal.data, -shift_m / signal.axis("range").step))
