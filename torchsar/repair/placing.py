"""Lines as they were recorded: lost lines, uneven times, and range windows that move.

A strip whose lines have numbers, times or window starts of their own is put on the regular grid
that focusing needs: lines on the grid are placed, others are interpolated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchsar.core import Recording, unit_phasor
from torchsar.radar import StripmapRadar
from torchsar.repair.lines import trusted_numbers


@dataclass(frozen=True, eq=False)
class LinePlan:
    """Places of recorded lines on a regular grid.

    Args:
        time: Times of the lines in pulse intervals since the first row of the grid, rising, float64
            (line,).
        cells: Samples by which the window of each line begins after the first one of the grid,
            float64 (line,).
        radar: Radar of the regular recording.
        notes: What is said about the lines.
    """

    time: Tensor
    cells: Tensor
    radar: StripmapRadar
    notes: tuple[str, ...]

    @staticmethod
    def of(radar: StripmapRadar, aux: Mapping[str, Tensor], lines: int) -> LinePlan | None:
        """Plan the grid of a recording by its side data.

        Args:
            radar: Radar, with the usual pulse rate and the nearest window start.
            aux: Side data: `line_time_s` in seconds, or else `line_number`; `window_start_m`, the
                slant range of the first sample of each line. All are (line,).
            lines: Number of lines.

        Returns:
            The plan; None for a recording that is regular.

        Raises:
            ValueError: If times do not rise, numbers contradict each other, or the grid would have
                more than ten times as many lines as the recording.
        """
        index, notes = torch.arange(lines, dtype=torch.float64), []
        time, cells = index, torch.zeros_like(index)
        if "line_time_s" in aux:
            clock = aux["line_time_s"].double()
            if not bool((clock.diff() > 0).all()):
                at = int(clock.diff().argmin())
                raise ValueError(
                    f"line_time_s must rise, got {float(clock[at + 1]):.9g} s after {float(clock[at]):.9g} s at line "
                    f"{at + 1}"
                )
            time = (clock - clock[0]) * radar.prf_hz
        elif "line_number" in aux:
            time = _numbered(aux["line_number"].long())
        if "window_start_m" in aux:
            cells = (aux["window_start_m"].double() - radar.near_range_m) / radar.range_step_m
        if float((time - index).abs().max()) < 1e-3 and not bool(cells.any()):
            return None
        rows = round(float(time[-1])) + 1
        if rows > 10 * lines:
            raise ValueError(
                f"the lines reach over {rows} pulse intervals of 1 / {radar.prf_hz:g} s, and there are {lines} of "
                "them; check the times or numbers of the lines, and prf_hz"
            )
        lost = rows - len(time.round().unique())
        if lost > 0:
            at = int((time.diff() > 1.5).int().argmax())
            notes.append(
                f"{lost} of {rows} lines are missing, the first after line {at}; they are zero until a stage, such as "
                "sparse_fill, fills them"
            )
        uneven = float((time - time.round()).abs().max())
        if uneven >= 1e-3:
            notes.append(f"times of lines lie up to {uneven:.2g} pulse intervals beside the grid and are interpolated")
        if bool(cells.any()):
            notes.append(f"the range window moves by up to {float(cells.max()):.6g} samples and is aligned")
        return LinePlan(time, cells, radar, tuple(notes))

    @property
    def rows(self) -> int:
        """Number of rows of the grid."""
        return round(float(self.time[-1])) + 1

    @property
    def missing(self) -> Tensor:
        """Rows of the grid that have no line near them, bool (row,)."""
        empty = torch.ones(self.rows, dtype=torch.bool)
        empty[self.time.round().long()] = False
        return empty

    @property
    def further_samples(self) -> int:
        """Number of samples by which the grid is longer than a line."""
        return int(self.cells.max().ceil())

    def needed(self, first: int, last: int, taps: int = 24) -> tuple[int, int]:
        """Return the first recorded line that rows of the grid need, and the one after the last.

        Args:
            first: First row.
            last: Row after the last one.
            taps: Number of lines from which one is interpolated.
        """
        ends = torch.tensor([float(first), float(last - 1)], dtype=torch.float64)
        low, high = torch.searchsorted(self.time, ends - 1e-3).tolist()
        return max(0, low - taps // 2), min(len(self.time), high + taps // 2 + 1)

    def doppler_turns(self, lines: Tensor, first: int) -> float:
        """Estimate the Doppler centroid, in cycles per pulse interval, from lines of uneven times.

        The phases of products of adjacent lines grow with the centroid times their distance in
        time. Where these distances differ, one centroid fits them all, without ambiguity. Where
        they hardly differ, the centroid nearest to the pointing of the radar is taken.

        Args:
            lines: Recorded lines, (line, range), aligned in range.
            first: Number of the first of them.
        """
        step = self.time[first : first + len(lines)].diff()
        near = step < 1.5
        step, products = step[near], (lines[1:] * lines[:-1].conj()).sum(-1).to(torch.complex128)[near]
        radar, blocks = self.radar, 8
        most = round(2 * radar.velocity_m_s / radar.wavelength_m / radar.prf_hz)
        nominal = (radar.pointing_doppler_hz or 0.0) / radar.prf_hz
        if len(step) < 8 * blocks:
            return nominal
        step, products = (x[: len(x) // blocks * blocks].view(blocks, -1) for x in (step, products))
        base = float(products.sum().angle()) / (2 * torch.pi)
        turns = base + torch.round(nominal - base + torch.arange(-most, most + 1, dtype=torch.float64))
        # moduli are added, so that each block may have a centroid of its own
        score = torch.stack([(products * unit_phasor(-f * step, products.dtype)).sum(-1).abs() for f in turns.tolist()])
        power = products.abs().sum(-1)
        gain = (score - score[most]) / (power + 1e-3 * power.max()).clamp_min(1e-300)
        certain = gain.mean(-1) > 4 * gain.std(-1) / blocks**0.5  # four standard deviations, by choice
        chosen = int(torch.where(certain, gain.mean(-1), 0).argmax()) if bool(certain.any()) else most
        near = turns[chosen] + torch.linspace(-0.5, 0.5, 101, dtype=torch.float64)
        fit = [(products * unit_phasor(-f * step, products.dtype)).real.sum() for f in near.tolist()]
        return float(near[int(torch.stack(fit).argmax())])

    def placed(self, lines: Tensor, start: int, first: int, last: int, turns: float) -> Tensor:
        """Interpolate recorded lines to rows of the grid, or place them there.

        Args:
            lines: The recorded lines that `needed` names, (line, range), aligned in range.
            start: Number of the first of them.
            first: First row.
            last: Row after the last one.
            turns: Doppler centroid in cycles per pulse interval, about which lines are
                interpolated.

        Returns:
            Rows of the grid, (row, range); zero where no line is near.
        """
        time = self.time[start : start + len(lines)]
        found = lines.new_zeros(last - first, lines.shape[-1])
        if float((self.time - self.time.round()).abs().max()) < 1e-3:
            row = time.round().long() - first
            inside = (row >= 0) & (row < last - first)
            found[row[inside]] = lines[inside]
            return found
        for begin in range(first, last, 256):
            out = torch.arange(begin, min(begin + 256, last), dtype=torch.float64)
            weights, low = _interpolation(time, out, turns)
            found[begin - first : begin - first + len(out)] = (
                weights.to(lines.dtype) @ lines[low : low + weights.shape[1]]
            )
        return found

    def aligned(self, lines: Tensor, start: int) -> Tensor:
        """Move the samples of recorded lines to the window of the grid. Moves by a fraction of a
        sample are made by Fourier transforms.

        Args:
            lines: Recorded lines, (line, range).
            start: Number of the first of them.

        Returns:
            Lines, (line, range + further_samples).
        """
        cells = self.cells[start : start + len(lines)]
        n = lines.shape[-1] + self.further_samples
        if not bool(self.cells.any()):
            return lines
        whole = cells.round()
        if float((cells - whole).abs().max()) < 1e-3:
            at = torch.arange(n)[None] - whole.long()[:, None]
            inside = (at >= 0) & (at < lines.shape[-1])
            return torch.where(inside, lines.gather(-1, at.clamp(0, lines.shape[-1] - 1)), 0)
        turn = torch.fft.fftfreq(n, dtype=torch.float64) * -cells[:, None]
        return torch.fft.ifft(torch.fft.fft(lines, n) * unit_phasor(turn, lines.dtype))


def regular_lines(recording: Recording) -> Recording:
    """Put the lines of a strip on the regular grid that focusing needs.

    >>> import torch
    >>> from torchsar import Recording, radar, repair
    >>> sensor = radar.StripmapRadar(carrier_hz=5.3e9, pulse=radar.LinearFM(30e6, 2e-6),
    ...     sampling_hz=32e6, prf_hz=1257.0, velocity_m_s=7066.0, near_range_m=988e3)
    >>> samples, number = torch.ones(6, 4, dtype=torch.complex64), torch.tensor([0, 1, 2, 5, 6, 7])
    >>> recording = Recording.from_arrays(samples, sensor, line_number=number)
    >>> repair.regular_lines(recording).signal.data[:, 0].real.tolist()
    [1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0]

    Lines whose numbers or times lie on the grid are placed, and missing ones are zero. Lines of
    uneven times, such as those of a pulse rate that changes or dithers, are interpolated from the
    24 nearest lines, as a band of 0.9 PRF about the Doppler centroid allows with the least error;
    the centroid follows from the lines. Windows that move are aligned, and the record becomes as
    wide as all of them. A recording of trials or a regular one is returned as it is.

    Args:
        recording: Recording of a StripmapRadar with the axes (pulse, range) whose side data may
            hold `line_number`, `line_time_s` or `window_start_m`, each (line,).

    Returns:
        Recording on the grid. Its side data hold `missing` (row,), bool, and `line_number`, counted
        along the grid, if it was known; others of single lines are left out.

    Raises:
        ValueError: If times or numbers of lines contradict each other.
    """
    data, aux = recording.signal.data, dict(recording.aux)
    plan = LinePlan.of(recording.radar, aux, data.shape[-2]) if data.ndim == 2 else None
    if plan is None:
        return recording
    lines = plan.aligned(data, 0)
    rows = plan.placed(lines, 0, 0, plan.rows, plan.doppler_turns(lines, 0))
    kept = {name: x for name, x in aux.items() if name not in (*_PER_LINE, "agc_db")}
    radar = recording.radar
    axes = radar.raw_axes(*rows.shape, recording.signal.axes[-2].start)
    side = {**kept, "missing": plan.missing}
    side |= {"line_number": torch.arange(plan.rows)} if "line_number" in aux else {}
    return replace(recording, signal=replace(recording.signal, data=rows, axes=axes), aux=side)


# side data of single lines, which a regular grid does not have
_PER_LINE = ("line_number", "line_time_s", "window_start_m")


def _numbered(number: Tensor) -> Tensor:
    """Times of lines in pulse intervals since the first one, from their numbers.

    Numbers that contradict their neighbours are replaced by what follows from these.
    """
    index = torch.arange(len(number))
    trusted = trusted_numbers(number - index, torch.ones_like(index, dtype=torch.bool), 100_000)
    if int(trusted.sum()) * 2 < len(number):
        raise ValueError(
            f"line_number cannot be reconciled: only {int(trusted.sum())} of {len(number)} numbers agree with those of "
            "neighbouring lines; check that they rise from line to line, or leave them out"
        )
    last = torch.where(trusted, index, -1).cummax(0).values
    last = torch.where(last < 0, int(trusted.int().argmax()), last)
    offset = (number - index)[last]
    return (index + offset - offset[0]).double()


def _interpolation(
    time: Tensor, out: Tensor, turns: float, band: float = 0.9, taps: int = 24, noise: float = 1e-3
) -> tuple[Tensor, int]:
    """Weights (row, line) that interpolate lines of uneven times to rows of a grid, and the number
    of the first line.

    The weights are optimal for a spectrum that is flat in a band about the centroid, with white
    noise (Wiener).

    band: width of the band relative to the pulse rate, by choice. noise: power of the noise
    relative to the signal, by choice.
    """
    middle = torch.searchsorted(time, out)
    index = middle[:, None] + torch.arange(-(taps // 2), taps - taps // 2)
    inside = (index >= 0) & (index < len(time))
    index = index.clamp(0, len(time) - 1)
    at = time[index]
    both = inside[:, :, None] & inside[:, None, :]
    one = torch.eye(taps, dtype=torch.float64)
    matrix = torch.where(both, torch.sinc(band * (at[:, :, None] - at[:, None, :])), 0) + one * (
        noise + 1.0 * ~inside[:, None]
    )
    goal = torch.where(inside, torch.sinc(band * (at - out[:, None])), 0)
    weights = torch.linalg.solve(matrix, goal) * unit_phasor(turns * (out[:, None] - at), torch.complex128)
    low, high = int(index.min()), int(index.max()) + 1
    full = torch.zeros(len(out), high - low, dtype=torch.complex128)
    return full.scatter_add(1, index - low, torch.where(inside, weights, 0)), low
