"""The phase that a compensation by velocities leaves in each pulse: the step whose error does not
accumulate.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import prepare, refuse_odd_counts, rotate, starting_phase
from torchsar.compensate.pulse_phase.imaging import AlongPulses
from torchsar.compensate.pulse_phase.sharpen import Run, in_turn
from torchsar.core import Estimate

ENOUGH_STD_RAD = 0.5
_RELAXATION = 1.7
# what counts as scene: this share of the power of a typical bright cell, and so many times the mean
# power
_SHARE, _LEVEL = 0.02, 4.0


def phase_polish(
    data: Tensor, *, start: Tensor | None = None, iterations: int = 80, tolerance_rad: float = 0.005
) -> Estimate:
    """Phase of every pulse against the scene that all of them show, with value["phase_rad"] (...,
    pulse) to be removed (brief 000, section 5c).

    data: (..., pulse, range) complex, compensated, compressed and deramped in azimuth, so that
    scatterers are tones; a window of range cells about the scatterers costs less and shows more.
    Integrated velocities leave a random walk of the order of a radian, whose phase steps are small:
    no start by adjacent pulses is needed. Beyond a radian iterations may end in an image of two
    peaks; a start (..., pulse) rad, such as that of `pga`, prevents it. Every iteration forms the
    image, weighs its cells, goes back to pulses, and takes the phase of each pulse against that.
    The weights are Wiener's, over-relaxed, until a trial's step is below tolerance_rad rms or
    `iterations` are done; a cell counts as scene where it holds a fiftieth of a typical bright
    cell, however wide the window. One step before, with the power over the maximum of the range
    cell, settles trials of single points at once; the last five, with p / (p + p_max / 10) on twice
    as many cells, let scatterers be that are lit for a part of the record only. Single points reach
    the bound of the phase of one sweep, where the SNR after compression exceeds about 14 dB.
    Constant and slope, which an image cannot tell from its own place, stay near zero.

    std: predicted from the energy of the cells above the noise. ok: it is below 0.5 rad. quality:
    share of the energy in cells that stand out. Differentiable. Raises TypeError or ValueError for
    samples that are not finite and complex, or counts below 1.
    """
    pulses = prepare(data, "phase_polish")
    refuse_odd_counts("phase_polish", 1, iterations=iterations)
    along = AlongPulses()
    begin = starting_phase(start, pulses, "phase_polish")
    begin = torch.zeros_like(pulses.rows[:, 0].real) if begin is None else begin
    settle = Run(_single_points, along, 1, 1.0, 0.0)
    search = Run(_scene, along, iterations, _RELAXATION, tolerance_rad)
    finish = Run(_near_peak, AlongPulses(2), 5, 1.0, tolerance_rad / 2)
    phase, taken = in_turn(pulses.rows, begin, [settle, search, finish])
    quality, std = _confidence(rotate(pulses.rows.detach(), phase.detach()))
    shape = pulses.trials
    ok = (std < ENOUGH_STD_RAD) & pulses.present.any(-1)
    return Estimate(
        {"phase_rad": phase.to(torch.float64).reshape(*shape, pulses.n)},
        quality=quality.reshape(shape),
        ok=ok.reshape(shape),
        std={"phase_rad": std[:, None].expand(-1, pulses.n).reshape(*shape, pulses.n)},
        info={"iterations": taken.reshape(shape)},
    )


def _bright(power: Tensor) -> Tensor:
    """Power of a typical bright cell: the mean over cells weighted with their own power, (trial, 1,
    1).
    """
    return power.square().sum((-2, -1), keepdim=True) / power.sum((-2, -1), keepdim=True).clamp_min(
        torch.finfo(power.dtype).tiny
    )


def _single_points(power: Tensor, mean: Tensor) -> Tensor:
    """Power over that of the strongest cell of the range cell, in trials whose typical bright cell
    is the brightest but for 3 dB; elsewhere as `_scene`.
    """
    peak = power.amax(-1, keepdim=True)
    few = _bright(power) > 0.5 * peak.amax(-2, keepdim=True)
    return torch.where(few, power / torch.where(peak > 0, peak, 1), _scene(power, mean))


def _scene(power: Tensor, mean: Tensor) -> Tensor:
    """(p / (p + level))^2 of powers averaged over three range cells, less the mean of its row: a
    pulse is left out of the scene that it is compared with.
    """
    pairs = power + power.roll(1, -2)
    local = (pairs + pairs.roll(-1, -2)) / 4
    share = local / (local + torch.maximum(_LEVEL * mean, _SHARE * _bright(power))).clamp_min(
        torch.finfo(power.dtype).tiny
    )
    weight = share.square()
    return weight - weight.mean(-1, keepdim=True)


def _near_peak(power: Tensor, mean: Tensor) -> Tensor:
    """Weights near one for cells within 10 dB of the strongest of their range cell, falling with
    their power below.
    """
    peak = power.amax(-1, keepdim=True)
    return power / torch.where(peak > 0, power + 0.1 * peak, 1)


def _confidence(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Share of the energy that is scene, and the deviation of a pulse's phase, (trial,) float64
    each. rows: (trial, range, pulse), corrected.

    Noise is the level that half of the cells of the image stay below; what stands out of it is
    scene. A pulse knows its phase to 1 / sqrt(2 g), g its energy over the noise variance.
    """
    image = torch.fft.fft(rows, norm="ortho")
    power = (image.real.square() + image.imag.square()).to(torch.float64).flatten(-2)
    noise = power.median(-1).values / 0.6931471805599453
    tiny = torch.finfo(torch.float64).tiny
    scene = torch.where(power > 12 * noise[:, None], power - noise[:, None], 0).sum(-1)
    total = power.sum(-1)
    gain = scene / rows.shape[-1] / noise.clamp_min(1e-30)
    return torch.where(total > 0, scene / total.clamp_min(tiny), 0), torch.where(
        total > 0, 1 / torch.sqrt(2 * gain.clamp_min(1e-3)), torch.pi
    )
