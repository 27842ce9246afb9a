"""Phase linking: maximum likelihood phases of the pulses of a homogeneous scene.

A scene whose speckle fills a large part of the Doppler band has no sharp image, and methods that
sharpen the image end with wrong phases. The phases are well determined nevertheless. The samples z
of a range cell over the pulses are z = D a, where D = diag(exp(j phi)) holds the phase errors and a
is circular Gaussian with a Toeplitz covariance R that the Doppler spectrum fixes. The phases and
the spectrum minimise the negative log likelihood of a cell,

    ln det R + tr(R^-1 D^H C D) = ln det R + u^H (R^-T o C) u,    u = exp(j phi),

where C is the covariance of the samples and "o" the product of elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import Pulses, prepare
from torchsar.compensate.pulse_phase.pairs import pair_phase
from torchsar.compensate.pulse_phase.spectrum import smoothed_spectrum
from torchsar.compensate.pulse_phase.verdict import LEAST_STREHL
from torchsar.core import Estimate, cis, over_blocks

# Range cells are grouped by power, because each group has its own spectrum: largest ratio of the
# powers in a group, and number of groups; the last one also takes all weaker cells.
_GROUP_RATIO, _GROUPS = 4.0, 4
# Bands of the first guess as shares of the pulse rate, and the share of its power in the band.
_WIDTHS, _IN_BAND = (0.1, 0.25, 0.45, 0.65, 0.8, 0.9), 0.85
# least spectral density relative to its mean: it keeps R invertible where noise is weak
_FLOOR = 1e-4
# Largest number of estimates of the spectrum; those smoothed by a window, because the first phases
# are far off, and its half width in bins; Newton steps of the phases after each.
_ROUNDS, _COARSE_ROUNDS, _WINDOW, _STEPS = 16, 2, 4, 4
_STILL_RAD = 0.01  # phase change, rms over the pulses, that ends the rounds
# Kinks: from one of 64 pulses on, the slope of the phase changes by so many Doppler cells. A block
# of pulses that has slipped by a cell is the usual local minimum. Kinks are sought in two rounds;
# the best of them are refined, as often as one gains so many nats.
_SLOPES, _KINKS, _KINK_ROUNDS, _REFINED, _REPEATS, _GAIN_NATS = (1, 2, 4, 8), 64, (0, 3), 4, 8, 0.5
_PRIOR = 3 / math.pi**2  # information in 1/rad^2 of a phase that is uniform over a turn
# Gain of the log likelihood per pulse by which the phases fit circular noise: 1.1 to 2.3 nats were
# measured for 4 to 192 range cells and 64 to 256 pulses. A scene must gain twice as much.
_NOISE_NATS, _MARGIN = 2.0, 2.0
_BLOCK_BYTES = 64 << 20  # limits the memory of a block of trials


def link_phases(data: Tensor) -> Estimate:
    """Estimate the phase of each pulse of a homogeneous scene by maximum likelihood.

    The scene is speckle with any Doppler spectrum. Its error does not depend on the size or kind of
    the phase errors. The time grows with the cube of the number of pulses. Not differentiable.

    Args:
        data: Range-compressed and aligned pulses, shape (..., pulse, range), complex.

    Returns:
        `phase_rad` of shape (..., pulse), to be removed. The standard deviation of each pulse is
        the Cramer-Rao bound for the estimated spectrum, raised by the share of the likelihood that
        the phases gain on noise. A constant and a linear phase only add a phase to the image and
        shift it; they are left out of the standard deviation. `quality` is the predicted Strehl
        ratio times the share of the likelihood that noise does not explain. `ok` is False where the
        Strehl ratio is below 0.8 or the gain in likelihood below twice that of noise. `info` holds
        "gain_nats" of shape (...,): log likelihood minus that of white noise.

    Raises:
        TypeError: If the data are not complex.
        ValueError: If the data are empty or not finite.

    Reference:
        Guarnieri and Tebaldini, IEEE Trans. Geosci. Remote Sens. 46(11), 2008 (phase linking).
    """
    pulses = prepare(data, "link_phases", empty=False)
    rows, n = pulses.rows.detach(), pulses.n
    size = max(1, _BLOCK_BYTES // (16 * n * (6 * n + 2 * rows.shape[1] + 8 * _KINKS)))
    parts = [slice(first, first + size) for first in range(0, len(rows), size)]
    done: dict[int, tuple[Tensor, Tensor, Tensor]] = {}

    def work(part: slice) -> None:
        done[part.start] = _linked(rows[part], pulses.present[part])

    with torch.no_grad():
        over_blocks(work, parts, rows)
    phase, std, gain = (torch.cat([done[part.start][i] for part in parts]) for i in range(3))
    return _estimate(pulses, phase, std, gain)


def _estimate(pulses: Pulses, phase: Tensor, std: Tensor, gain: Tensor) -> Estimate:
    real, trials = pulses.rows.real.dtype, pulses.trials
    noise = _NOISE_NATS * pulses.present.sum(-1)
    scene = (1 - noise / _or_one(gain)).clamp(0, 1)
    std = torch.where(scene[:, None] > 0, std / _or_one(scene).sqrt()[:, None], torch.inf).clamp_max(_PRIOR**-0.5)
    strehl = torch.exp(-std.square().mean(-1))
    return Estimate(
        value={"phase_rad": phase.reshape(*trials, pulses.n).to(real)},
        std={"phase_rad": std.reshape(*trials, pulses.n).to(real)},
        quality=(strehl * scene).reshape(trials).to(real),
        ok=((strehl > LEAST_STREHL) & (gain > _MARGIN * noise)).reshape(trials),
        info={"gain_nats": gain.reshape(trials)},
    )


def _linked(rows: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phase and standard deviation (trial, pulse) in rad, and gain (trial,) in nats, of a block."""
    if rows.shape[-1] < 3:  # nothing to distinguish a phase error from a shift of the image
        zero = torch.zeros(present.shape, dtype=torch.float64, device=rows.device)
        return zero, zero + torch.inf, zero[:, 0]
    scene = _Scene.of(rows, present)
    u = scene.start(torch.where(present, pair_phase(rows, present), 0).to(torch.float64))
    active = torch.arange(len(u), device=u.device)
    for count in range(_ROUNDS):
        smooth = _windowed if count < _COARSE_ROUNDS else smoothed_spectrum
        matrix = scene.trials(active).fit(u[active], smooth).matrix
        new = _newton(matrix, u[active], _STEPS)
        if count in _KINK_ROUNDS:
            new = _without_kinks(matrix, new)
        moved = torch.angle(new * u[active].conj()).square().mean(-1).sqrt()
        u = u.index_copy(0, active, new)
        if count > max(_KINK_ROUNDS):
            active = active[moved > _STILL_RAD]
            if not len(active):
                break
    fit = scene.fit(u, smoothed_spectrum)
    return torch.angle(u), _deviation(fit.information), scene.samples - fit.constant - _value(fit.matrix, u)


Smooth = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class _Fit:
    """Likelihood of the phases for given spectra.

    Args:
        matrix: R^-T o C, summed over the range cells, shape (trial, pulse, pulse), Hermitian.
        constant: ln det R, summed over the range cells, shape (trial,).
        information: Fisher information of the phases in 1/rad^2, shape (trial, pulse, pulse).
    """

    matrix: Tensor
    constant: Tensor
    information: Tensor


@dataclass(frozen=True)
class _Scene:
    """Samples of the range cells in groups of similar power.

    Args:
        groups: Samples with zeros in the cells of other groups, shape (trial, pulse, range); their
            products z z^H summed over the cells, shape (trial, pulse, pulse); and the number of
            cells, shape (trial,).
        present: Pulses that were received, shape (trial, pulse), bool.
        samples: Number of samples, shape (trial,), which is also the negative log likelihood of
            white noise, since the samples have a mean power of 1.
    """

    groups: list[tuple[Tensor, Tensor, Tensor]]
    present: Tensor
    samples: Tensor

    @staticmethod
    def of(rows: Tensor, present: Tensor) -> _Scene:
        z = rows.mT.to(torch.complex128)
        samples = present.sum(-1).to(torch.float64) * z.shape[-1]
        total = (z.real.square() + z.imag.square()).sum((-2, -1))
        z = z * torch.where(total > 0, samples / _or_one(total), 1).sqrt()[:, None, None]
        power = (z.real.square() + z.imag.square()).sum(-2)
        ratio = power.amax(-1, keepdim=True) / power.clamp_min(torch.finfo(torch.float64).tiny)
        member = (ratio.log() / math.log(_GROUP_RATIO)).clamp(0, _GROUPS - 1).long()
        groups = []
        for index in range(_GROUPS):
            inside = member == index
            if bool(inside.any()):
                own = z * inside[:, None, :]
                groups.append((own, own @ own.mH, inside.sum(-1).to(torch.float64)))
        return _Scene(groups, present, samples)

    def trials(self, at: Tensor) -> _Scene:
        """The scenes of some of the trials, given by their indices."""
        groups = [(own[at], products[at], cells[at]) for own, products, cells in self.groups]
        return _Scene(groups, self.present[at], self.samples[at])

    def start(self, phase: Tensor) -> Tensor:
        """The phases of greatest likelihood for one of several bands, as exp(j phase)."""
        n = phase.shape[-1]
        lag = torch.arange(n, dtype=torch.float64, device=phase.device)
        every = sum(products for _, products, _ in self.groups) / self._cells[:, None, None]
        least, best = torch.full_like(phase[:, 0], torch.inf), cis(phase)
        for width in _WIDTHS:
            band = _IN_BAND * torch.sinc(width * lag) + (1 - _IN_BAND) * (lag == 0)
            lower, log_det = self._factor(band.to(torch.complex128).expand(len(phase), -1))
            matrix = torch.cholesky_inverse(lower).mT * every
            u = _newton(matrix, _smallest(matrix, cis(phase)), _STEPS)
            value = log_det + _value(matrix, u)
            best = torch.where((value < least)[:, None], u, best)
            least = torch.minimum(value, least)
        return best

    def fit(self, u: Tensor, smooth: Smooth) -> _Fit:
        """The likelihood with the smoothed spectra of the samples without the phases of u."""
        n = u.shape[-1]
        matrix, information = torch.zeros_like(self.groups[0][1]), torch.zeros_like(self.groups[0][1].real)
        constant = torch.zeros_like(self.samples)
        for own, products, cells in self.groups:
            spectrum = torch.fft.fft(own * u.conj()[..., None], 2 * n, dim=-2)
            power = (spectrum.real.square() + spectrum.imag.square()).sum(-1)
            mean = power.mean(-1, keepdim=True)
            power = torch.where(mean > 0, power, 1) / _or_one(cells * self.present.sum(-1))[:, None]
            power = torch.maximum(power, _FLOOR * power.mean(-1, keepdim=True))
            lower, log_det = self._factor(torch.fft.ifft(smooth(power, cells.clamp_min(1)))[..., :n])
            inverse = torch.cholesky_inverse(lower).mT
            matrix = matrix + inverse * products
            constant = constant + cells * log_det
            own_information = (inverse * (lower @ lower.mH)).real - torch.eye(n, dtype=torch.float64, device=u.device)
            information = information + 2 * cells[:, None, None] * own_information
        return _Fit(matrix, constant, information)

    @property
    def _cells(self) -> Tensor:
        return sum((cells for *_, cells in self.groups[1:]), self.groups[0][2])

    def _factor(self, lags: Tensor) -> tuple[Tensor, Tensor]:
        """Cholesky factor and log determinant of the covariance of the present pulses.

        It is Toeplitz with the first column `lags` (trial, pulse); other pulses have variance 1.
        """
        n = lags.shape[-1]
        at = torch.arange(n, device=lags.device)
        lag = at[:, None] - at
        both = torch.cat([lags, lags[:, 1:].conj().flip(-1)], -1)[:, lag % (2 * n - 1)]
        kept = self.present[:, :, None] & self.present[:, None, :]
        lower = torch.linalg.cholesky(torch.where(kept, both, torch.eye(n, dtype=lags.dtype, device=lags.device)))
        return lower, 2 * torch.diagonal(lower, dim1=-2, dim2=-1).real.log().sum(-1)


def _windowed(power: Tensor, _: Tensor) -> Tensor:
    """Smooth a spectrum (trial, bin) by a Hann window of 9 bins."""
    window = torch.hann_window(2 * _WINDOW + 3, periodic=False, dtype=power.dtype, device=power.device)[1:-1]
    padded = torch.nn.functional.pad(power[:, None], (_WINDOW, _WINDOW), mode="circular")
    return torch.nn.functional.conv1d(padded, (window / window.sum())[None, None])[:, 0]


def _value(matrix: Tensor, u: Tensor) -> Tensor:
    """u^H M u, shape (trial,)."""
    return (u.conj() * (matrix @ u[..., None])[..., 0]).sum(-1).real


def _smallest(matrix: Tensor, start: Tensor) -> Tensor:
    """Phases, as exp(j phase), of the eigenvector of the smallest eigenvalue; inverse iteration."""
    n = start.shape[-1]
    ridge = 1e-6 * torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)[:, None, None] + 1e-12
    lower = torch.linalg.cholesky(matrix + ridge * torch.eye(n, dtype=matrix.dtype, device=matrix.device))
    vector = start
    for _ in range(4):
        vector = torch.cholesky_solve(vector[..., None], lower)[..., 0]
        vector = vector / _or_one(vector.abs().amax(-1, keepdim=True))
    size = vector.abs()
    return torch.where(size > 0, vector / _or_one(size), 1)


def _newton(matrix: Tensor, u: Tensor, steps: int) -> Tensor:
    """Lower u^H M u by damped Newton steps of the phases of u."""
    value, diagonal = _value(matrix, u), torch.diagonal(matrix, dim1=-2, dim2=-1).real.mean(-1)
    damping = torch.full_like(value, 1e-3)
    eye = torch.eye(u.shape[-1], dtype=torch.float64, device=u.device)
    for _ in range(steps):
        turned = u.conj()[..., :, None] * matrix * u[..., None, :]
        slope = turned.sum(-1)
        bend = 2 * turned.real - torch.diag_embed(2 * slope.real - (2 * damping * diagonal + 1e-9)[:, None])
        lower, failed = torch.linalg.cholesky_ex(bend)
        lower = torch.where((failed == 0)[:, None, None], lower, eye)
        step = -torch.cholesky_solve(2 * slope.imag[..., None], lower)[..., 0]
        trial = u * cis(step.clamp(-1, 1))
        reached = _value(matrix, trial)
        better = (failed == 0) & (reached <= value)
        u, value = torch.where(better[:, None], trial, u), torch.where(better, reached, value)
        damping = torch.where(better, damping / 5, damping * 10).clamp(1e-9, 1e3)
    return u


def _without_kinks(matrix: Tensor, u: Tensor) -> Tensor:
    """Remove kinks of the phase as long as that lowers u^H M u."""
    value, n = _value(matrix, u), u.shape[-1]
    active = torch.arange(len(u), device=u.device)
    for _ in range(_REPEATS):
        if not len(active):
            break
        bent = _bent(matrix[active], u[active]).flatten(0, 1)
        bent = _newton(matrix[active].repeat_interleave(_REFINED, 0), bent, _STEPS)
        reached = _value(matrix[active].repeat_interleave(_REFINED, 0), bent).unflatten(0, (-1, _REFINED))
        at = reached.argmin(-1, keepdim=True)
        better = reached.gather(-1, at)[:, 0] < value[active] - _GAIN_NATS
        chosen = bent.unflatten(0, (-1, _REFINED)).gather(1, at[..., None].expand(-1, -1, n))[:, 0]
        active, chosen = active[better], chosen[better]
        u = u.index_copy(0, active, chosen)
        value = value.index_copy(0, active, _value(matrix[active], chosen))
    return u


def _bent(matrix: Tensor, u: Tensor) -> Tensor:
    """The kinks of u with the lowest values, shape (trial, kink, pulse)."""
    n = u.shape[-1]
    pulse = torch.arange(n, dtype=torch.float64, device=u.device)
    first = torch.linspace(0, n, _KINKS + 2, dtype=torch.float64, device=u.device)[1:-1].round()
    slope = torch.tensor([s for size in _SLOPES for s in (size, -size)], dtype=torch.float64, device=u.device)
    ramps = slope[:, None, None] * (2 * math.pi / n) * (pulse - first[:, None]).clamp_min(0)
    kinks = cis(ramps.flatten(0, 1))
    turned = u.conj()[..., :, None] * matrix * u[..., None, :]
    values = ((turned @ kinks.mT) * kinks.mH).sum(-2).real
    return u[:, None] * kinks[values.topk(_REFINED, largest=False).indices]


def _deviation(information: Tensor) -> Tensor:
    """Standard deviation of each phase in rad, (trial, pulse), without its straight line."""
    n = information.shape[-1]
    pulse = torch.linspace(-1, 1, n, dtype=torch.float64, device=information.device)
    line = torch.linalg.qr(torch.stack([torch.ones_like(pulse), pulse], -1)).Q
    eye = torch.eye(n, dtype=torch.float64, device=information.device)
    flat = eye - line @ line.mT
    covariance = flat @ torch.linalg.inv(information + _PRIOR * eye) @ flat
    return torch.diagonal(covariance, dim1=-2, dim2=-1).clamp_min(0).sqrt()


def _or_one(x: Tensor) -> Tensor:
    """x where it is positive, else 1."""
    return torch.where(x > 0, x, 1)
