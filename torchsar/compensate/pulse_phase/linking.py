"""Phase linking: maximum likelihood phases of the pulses of a homogeneous scene.

A scene whose speckle fills a large part of the Doppler band has no sharp image, and methods that
sharpen the image end with wrong phases. The phases are well determined nevertheless: they and the
Doppler spectrum of the scene maximise a likelihood (module `likelihood`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import Pulses, by_blocks, or_one, prepare, starting_phase
from torchsar.compensate.pulse_phase.homogeneous import smoothed_spectrum
from torchsar.compensate.pulse_phase.likelihood import (
    Fit,
    Speckle,
    deviation,
    lag_sums,
    newton,
    rms_of_pulses,
    windowed_spectrum,
)
from torchsar.compensate.pulse_phase.linking_assess import Judged, judged, outcome_of
from torchsar.compensate.pulse_phase.stages import _PhaseEstimatorFromStart
from torchsar.core import Estimate, Outcome, cis, differentiable
from torchsar.core.derivatives import without_derivatives

_BLOCK_BYTES = 64 << 20  # largest memory of the working arrays of a block of trials


@differentiable("no")
def link_phases(data: Tensor, *, start: Tensor | None = None, assess: bool = True) -> Estimate:
    """Estimate the phase of each pulse of a homogeneous scene by maximum likelihood.

    >>> import torch
    >>> from torchsar.compensate import link_phases
    >>> clutter = torch.randn(16, 32, dtype=torch.complex64)
    >>> link_phases(clutter, assess=False)["phase_rad"].shape
    torch.Size([16])

    The scene is speckle with any Doppler spectrum. Its error does not depend on the size or kind of
    the phase errors. The time grows with the cube of the number of pulses, and the memory with its
    square (200 MB for 1024 pulses).

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.
        start: Phase to start from in rad, shape (..., pulse), if it is known to about a radian; by
            default the search starts from phases that fit one of several Doppler bands best.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. `info` holds two log likelihoods minus
        that of white noise, of shape (...,). Both count only the share of the range cells that is
        independent. For "fit_nats", by which phases of one scene compare, it is the share of the
        band that is occupied. For "gain_nats" it also allows for the correlation of range cells.

        With `assess`, the standard deviation of each pulse is the Cramer-Rao bound for the
        estimated spectrum, in which range cells that depend on each other count less, raised by the
        share of the likelihood that the phases gain on noise, and to what the scatter of the range
        cells shows, each judged by the spectra of others. A constant and a linear phase, which only
        shift the image, are left out of it. `quality` is the predicted Strehl ratio times the share
        of the likelihood that noise does not explain. Outcomes: EMPTY; SINGULAR with fewer than
        three pulses; NOISE if the likelihood gains less than twice as much as on noise; INEXACT if
        the Strehl ratio for 1.9 standard deviations (more below 24 range cells) is below 0.8;
        PARTS_DISAGREE if range cells of similar power have different spectra or ask for other
        phases, or the pulses before and after a boundary are less than 0.55 times as coherent as
        predicted; SPARSE if a sparse description is likelier, or few range cells have similar
        power; DISPLACED.

    Raises:
        TypeError: If the data are not complex or the start is not a tensor.
        ValueError: If the data are empty or not finite, or the start does not have one phase per
            pulse.

    Reference:
        Guarnieri and Tebaldini, IEEE Trans. Geosci. Remote Sens. 46(11), 2008 (phase linking).
    """
    pulses = prepare(data, "link_phases")
    return linked(pulses, starting_phase(start, pulses, "link_phases"), assess=assess)


class LinkPhases(_PhaseEstimatorFromStart):
    """Phase per pulse of a homogeneous scene by maximum likelihood; see `link_phases`.

    Args:
        assess: Whether to add the standard deviation and the outcome.
    """

    differentiable = "no"

    def __init__(self, assess: bool = True) -> None:
        super().__init__(link_phases, assess=assess)


def linked(pulses: Pulses, start: Tensor | None = None, still: bool = False, assess: bool = True) -> Estimate:
    """Estimate the phases of pulses that were checked; see `link_phases`.

    Args:
        pulses: The pulses.
        start: Phase to start from in rad, shape (trial, pulse), or None.
        still: True if scatterers do not change and the caller confirms the phases, as by several
            starts. The Cramer-Rao bound for one spectrum of similar range cells then is the
            deviation, also of few cells, and a sparse description is not considered.
        assess: Whether to add the standard deviation and the outcome.

    Returns:
        The `Estimate` that `link_phases` returns.
    """
    rows, n, trials = pulses.rows, pulses.n, pulses.trials
    # with fewer pulses a phase error cannot be distinguished from a shift of the image
    if not len(rows) or n < 3:
        zero, none = torch.zeros(*trials, n, dtype=rows.real.dtype, device=rows.device), rows.real.sum((-2, -1)) * 0
        info = {"gain_nats": none.reshape(trials), "fit_nats": none.reshape(trials)}
        return Estimate({"phase_rad": zero}, outcome=Outcome.SINGULAR.like(info["gain_nats"]), info=info)
    size = max(1, _BLOCK_BYTES // (16 * n * (6 * n + 2 * rows.shape[1])))

    def work(part: slice) -> tuple[Tensor, ...]:
        return _linked(rows[part], pulses.present[part], None if start is None else start[part], still, assess)

    with without_derivatives("link_phases", pulses):
        phase, fit, gain, *rest = by_blocks(pulses, work, size=size)
    value = {"phase_rad": phase.reshape(*trials, n).to(rows.real.dtype)}
    info = {"gain_nats": gain.reshape(trials), "fit_nats": fit.reshape(trials)}
    if not assess:
        return Estimate(value, outcome=Outcome.NOT_ASSESSED.like(info["gain_nats"]), info=info)
    with torch.no_grad():
        outcome, std, quality, seen = outcome_of(pulses, Judged(*rest), gain, sparse=not still)
    info |= {name: x.reshape(trials) for name, x in seen.items()}
    return Estimate(
        value,
        {"phase_rad": std.reshape(*trials, n).to(rows.real.dtype)},
        quality.reshape(trials).to(rows.real.dtype),
        outcome.reshape(trials),
        info,
    )


def _linked(rows: Tensor, present: Tensor, start: Tensor | None, still: bool, assess: bool) -> tuple[Tensor, ...]:
    """Phases (trial, pulse) of a block of trials; two log likelihood gains over white noise,
    (trial,); and the fields of `Judged`.

    The first gain is multiplied by the share of the band that is occupied, the second one by the
    share of the information of the range cells that is independent.
    """
    scene = Speckle.of(rows, present)
    u, fit = _refined(scene, _grown(scene) if start is None else cis(start.to(torch.float64)))
    gain = scene.gain(u, fit)
    share = scene.independent_share(u, fit, scene.information_each(fit))
    found = judged(scene, u, fit, still) if assess else ()
    return torch.angle(u), scene.independent * gain, share * gain, *found


def _grown(scene: Speckle) -> Tensor:
    """Phases near those of greatest likelihood, as exp(j phase), (trial, pulse).

    A search over all pulses ends in local minima, in which parts of the pulses have slipped by a
    Doppler cell. Short blocks of at most 32 pulses have few such minima. Their phases are therefore
    found first, and neighbouring blocks are joined until one is left.
    """
    trials, n = scene.present.shape
    size = -(-n // 2 ** max(0, math.ceil(math.log2(n / 32))))
    u = _solved(scene.blocks(size))
    while size < n:
        blocks = u.reshape(trials, -1, size)
        # the last block has no neighbour, so that one of absent pulses is added
        if blocks.shape[1] % 2:
            blocks = torch.cat([blocks, torch.ones_like(blocks[:, :1])], 1)
        size *= 2
        u = _joined(scene.blocks(size), blocks.reshape(-1, size))
    return u.reshape(trials, -1)[:, :n]


def _solved(blocks: Speckle) -> Tensor:
    """Phases of short blocks: the likeliest ones of searches that start from several Doppler bands.

    As many bands are processed together as fit into the memory of a block of trials.
    """
    count = len(blocks.samples)
    which = torch.arange(count, device=blocks.samples.device)
    together = max(1, _BLOCK_BYTES // max(1, sum(16 * own.numel() for own, *_ in blocks.groups)))
    found, gains = [], []
    bands = torch.tensor((0.1, 0.25, 0.45, 0.65, 0.8, 0.9), dtype=torch.float64, device=which.device)
    for widths in bands.split(together):
        every = blocks.trials(which.repeat(len(widths)))
        u = every.start(widths.repeat_interleave(count))
        # the first phases are inaccurate, so that the spectrum is first smoothed more
        for number in range(8):
            smooth = windowed_spectrum if number < 2 else smoothed_spectrum
            u = newton(every.fit(every.periodograms(u, smooth)).matrix, u)
        gain = every.gain(u, every.fit(every.periodograms(u, smoothed_spectrum)))
        found.append(u.unflatten(0, (-1, count)))
        gains.append(gain.unflatten(0, (-1, count)))
    best = torch.cat(gains).nan_to_num(-torch.inf).argmax(0)
    return torch.cat(found)[best, which]


def _joined(pairs: Speckle, u: Tensor) -> Tensor:
    """Join the phases of pairs of blocks, each correct except for a linear phase.

    The spectrum of the second block is shifted circularly to match that of the first, and their sum
    gives a common covariance. For each slope of the second block, the best constant phase follows
    in closed form. With a matrix M and the phases a and b of the blocks it leaves b^H M b - 2 |a^H
    M b|: two Fourier transforms over the slopes.
    """
    half, slopes = u.shape[-1] // 2, 4 * u.shape[-1]
    left, right = u[:, :half], u[:, half:]
    powers = [pairs.powers(u, slice(0, half)), pairs.powers(u, slice(half, None))]
    likeness = sum(
        torch.fft.ifft(torch.fft.fft(one.sqrt()).conj() * torch.fft.fft(other.sqrt())).real
        for one, other in zip(*powers, strict=True)
    )
    bins = powers[0][0].shape[-1]
    at = (torch.arange(bins, device=u.device) + torch.as_tensor(likeness).argmax(-1, keepdim=True)) % bins
    both = [one + other.gather(-1, at) for one, other in zip(*powers, strict=True)]
    matrix = pairs.fit(pairs.smoothed(both, smoothed_spectrum)).matrix

    sums = lag_sums(right.conj()[:, :, None] * matrix[:, half:, half:] * right[:, None, :])
    own = torch.fft.fft(torch.roll(torch.nn.functional.pad(sums, (0, slopes - sums.shape[-1])), 1 - half, -1)).real
    crossed = (left.conj()[:, None, :] @ matrix[:, :half, half:])[:, 0] * right
    mutual = slopes * torch.fft.ifft(crossed, slopes)
    best = (own - 2 * mutual.abs()).argmin(-1, keepdim=True)
    line = 2 * math.pi / slopes * best * torch.arange(half, device=u.device)
    u = torch.cat([left, -right * cis(line - torch.angle(mutual.gather(-1, best)))], -1)
    for _ in range(3):
        u = newton(matrix, u)
        matrix = pairs.fit(pairs.periodograms(u, smoothed_spectrum)).matrix
    return u


def _refined(scene: Speckle, u: Tensor) -> tuple[Tensor, Fit]:
    """Phases of greatest likelihood for adapted spectra, and the fit with these spectra.

    Phases and spectra are found in turn. A smooth error of the phase widens the estimated spectrum,
    and the wider spectrum hardly opposes the error, so that convergence is slow. Three rounds are
    therefore extrapolated (squared iteration) where that makes the phases likelier, until they
    change by less than 0.3 standard deviations.
    """
    spectra = scene.periodograms(u, smoothed_spectrum)
    std = rms_of_pulses(deviation(scene.summed(scene.information_each(scene.fit(spectra)))), scene.present)
    active = torch.arange(len(u), device=u.device)
    for _ in range(6):
        some, first = scene.trials(active), u[active]
        own = [of_all[active] for of_all in spectra]
        second, own = some.round(first, own)
        third, own = some.round(second, own)
        step, next_ = torch.angle(second * first.conj()), torch.angle(third * second.conj())
        bend = (next_ - step).norm(dim=-1, keepdim=True)
        reach = (step.norm(dim=-1, keepdim=True) / or_one(bend)).where(bend > 0, 1).clamp(1, 8)
        far, of_far = some.round(first * cis(2 * reach * step + reach.square() * (next_ - step)), own)
        better = some.gain(far, some.fit(of_far)) > some.gain(third, some.fit(own))
        new = torch.where(better[:, None], far, third)
        own = [torch.where(better[:, None], one, other) for one, other in zip(of_far, own, strict=True)]
        u = u.index_copy(0, active, new)
        spectra = [of_all.index_copy(0, active, of_some) for of_all, of_some in zip(spectra, own, strict=True)]
        active = active[_distance(new, first) > 0.3 * std[active]]
        if not len(active):
            break
    return u, scene.fit(spectra)


def _distance(u: Tensor, v: Tensor) -> Tensor:
    """Rms difference between phases over the pulses in rad, (trial,)."""
    return torch.angle(u * v.conj()).square().mean(-1).sqrt()
