"""Error of an image after registration to its reference."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.core import Signal, checked_samples, cis, unit_level
from torchsar.focus.chirp_z import chirp_z
from torchsar.metrics.image import error_db, pair_of

# _REFINED: number of Newton steps that refine the shift or the phase slope, by choice
# _ROUNDS: number of repetitions in which both are refined in turn, by choice
_REFINED, _ROUNDS = 4, 3
# _STEPS: largest number of steps of the affine registration, by choice
# _SETTLED_DB: reduction of the error in dB below which the registration ends, by choice
# _BLOCK_ROWS: rows of the image whose derivatives are in memory at once, by choice
_STEPS, _SETTLED_DB, _BLOCK_ROWS = 4, 0.01, 256
# _MOST_LINEAR: largest rotation, stretch and shear, by choice
# _MOST_SHIFT: largest change of the shift in samples during their fit, by choice
# _MOST_BEND: largest quadratic phase at the edges in cycles, by choice
# _LEAST_SHOWN: least fraction of the energy of each image in the compared pixels, by choice
_MOST_LINEAR, _MOST_SHIFT, _MOST_BEND, _LEAST_SHOWN = 0.02, 1.0, 0.15, 0.5


def registered_error_db(image: Tensor | Signal, reference: Tensor | Signal) -> Tensor:
    """Compute the relative error of an image, registered to its reference, of each trial.

    >>> import torch
    >>> from torchsar import metrics
    >>> line = torch.sinc(torch.arange(-16.0, 16.0) / 2)
    >>> image = torch.outer(line, line) + 0j
    >>> moved = 2j * image.roll((1, -2), (0, 1))
    >>> [bool(e(moved, image) > -30) for e in (metrics.error_db, metrics.registered_error_db)]
    [True, False]

    Registration removes what autofocus cannot observe of a path. Constant and linear errors of the
    path shift the image, rotate, stretch and shear it slightly, add a linear phase over it and a
    small quadratic one, and give it a complex gain. The shift is that of the largest correlation of
    the intensities, refined with the phases of the images; rotation, stretch and shear, of up to 2
    %, and a quadratic phase of up to 0.15 turns at the edges are fitted to the difference of the
    images. The pixels that both images show after the shift are compared. The samples of both must
    hold the spectrum (`PathImage.sampling_limits`): a displacement of coarser samples cannot be
    removed. Memory and time are those of some twenty images.

    Args:
        image: Image I, shape (..., azimuth, range), complex, or a Signal.
        reference: Image I0 of the same size; its trials broadcast with those of I.

    Returns:
        Error |registered(I) - I0|^2 / |I0|^2 over the compared pixels in dB, shape (...,), float64;
        0 dB where the images have nothing in common, one of them is zero, or the compared pixels
        hold less than half of the energy of either image.

    Raises:
        TypeError: If one of them is not a tensor of numbers.
        ValueError: If they are not complex images of equal size, their samples are not finite, they
            are signals whose axes have other names or spacings, or their trials do not broadcast.
    """
    return registered_errors(image, reference)["image_error_db"]


def registered_errors(image: Tensor | Signal, reference: Tensor | Signal) -> dict[str, Tensor]:
    """Compute the errors of amplitude and of phase of an image, registered to its reference.

    >>> import torch
    >>> from torchsar import metrics
    >>> line = torch.sinc(torch.arange(-16.0, 16.0) / 2)
    >>> image = torch.outer(line, line) + 0j
    >>> turned = image * torch.exp(0.3j * torch.sign(torch.arange(-16, 16) + 0.5))
    >>> found = metrics.registered_errors(turned, image)
    >>> bool(found["amplitude_error_db"] < -30), found["phase_error_rad"].round(decimals=1)
    (True, tensor(0.2000, dtype=torch.float64))

    An image whose amplitudes are right serves for all that is seen; the phases matter where images
    are compared or added, as in interferometry. Autofocus leaves slow phases over the image, which
    make the error of the complex samples large although the image is sharp. The registration
    is that which minimises the error of the complex samples, see `registered_error_db`, with its
    arguments and raised errors. Strong phases displace it, and with it the amplitudes: at
    equal amplitudes, a sine phase of 2.5 rad leaves -25 to -34 dB.

    Args:
        image: Image I, shape (..., azimuth, range), complex, or a Signal.
        reference: Image I0 of the same size; its trials broadcast with those of I.

    Returns:
        Each of shape (...,), float64, over the compared pixels after registration:
        `amplitude_error_db`, the power of the difference of the moduli after the gain that fits
        best, relative to that of the reference; `phase_error_rad`, the rms of the difference of the
        phases, weighted by the product of the moduli; and `image_error_db`, the error of the
        complex samples, see `registered_error_db`. Images that have nothing in common have 0 dB and
        1.81 rad, as unrelated phases, but for the amplitudes of unrelated speckle: two positive
        moduli fit each other by chance, to about 1 - (pi / 4)^2, which is -4.2 dB (-4.3 to -4.7 dB
        after registration, or 0 dB where it leaves little overlap).
    """
    axes = [[(axis.name, axis.step) for axis in x.axes[-2:]] for x in (image, reference) if isinstance(x, Signal)]
    if len(axes) == 2 and axes[0] != axes[1]:
        raise ValueError(
            f"only images on grids of equal axes and spacings can be compared, got {axes[0]} and {axes[1]}"
        )
    pair = (checked_samples(x, "registered_errors", "azimuth, range") for x in pair_of(image, reference))
    a, b = (unit_level(x).to(torch.complex128) for x in pair)
    try:
        lead = torch.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    except RuntimeError:
        raise ValueError(
            f"registered_errors needs images whose trials broadcast, got {tuple(a.shape)} and {tuple(b.shape)}"
        ) from None
    a, b = (x.expand(*lead, *x.shape[-2:]).reshape(-1, *x.shape[-2:]) for x in (a, b))
    whole = b.abs().square().sum((-2, -1))
    spectrum = torch.fft.fft2(a)
    turns = [_turns(torch.fft.fft2(b), dim) for dim in (-2, -1)]
    map_, phase = _shifted(a, b, spectrum, turns)
    first, most = map_, map_.new_tensor([_MOST_SHIFT, _MOST_LINEAR, _MOST_LINEAR])
    moved, seen = _displaced(spectrum, turns, map_)
    energy = a.abs().square().sum((-2, -1))
    # The compared pixels of the reference are selected before the fit. Otherwise a step could
    # reduce the error by moving pixels out of the image.
    b = torch.where(seen, b, 0)
    hidden = torch.where(seen, moved, 0).abs().square().sum((-2, -1)) < _LEAST_SHOWN * energy
    hidden = hidden | (b.abs().square().sum((-2, -1)) < _LEAST_SHOWN * whole) | (whole == 0) | (energy == 0)
    best = _error(moved, b, seen, phase)
    done = torch.zeros_like(best, dtype=torch.bool)
    for _ in range(_STEPS):
        step_map, step_phase = _step(moved, b, seen, phase, turns)
        trial_map, trial_phase = map_ + step_map, phase + step_phase
        small = ((trial_map - first).abs() <= most).flatten(1).all(-1)
        small = small & (trial_phase[:, 2:].abs() <= 4 * _MOST_BEND).all(-1)
        trial_map = torch.where(small[:, None, None], trial_map, map_)
        trial_phase = torch.where(small[:, None], trial_phase, phase)
        trial_moved, trial_seen = _displaced(spectrum, turns, trial_map)
        error = _error(trial_moved, b, trial_seen, trial_phase)
        # a registration that has converged is not changed while other trials continue
        better, done = (error < best) & small & ~done, done | ~small | (error > best - _SETTLED_DB)
        trial = trial_map, trial_phase, error, trial_moved, trial_seen
        old = map_, phase, best, moved, seen
        map_, phase, best, moved, seen = (
            torch.where(better.reshape(-1, *(1,) * (a.ndim - 1)), new, a) for new, a in zip(trial, old, strict=True)
        )
        if bool(done.all()):
            break
    turned = torch.where(seen, _turned(moved, phase), 0)
    level, bright = turned.abs(), b.abs()
    energy, weight = level.square().sum((-2, -1), keepdim=True), level * bright
    gain = weight.sum((-2, -1), keepdim=True) / torch.where(energy == 0, 1, energy)
    amplitude = error_db(torch.complex(gain * level, 0 * level), torch.complex(bright, 0 * bright))
    common = turned * b.conj()
    common = common * common.sum((-2, -1), keepdim=True).conj()
    square = (weight * torch.angle(common).square()).sum((-2, -1)) / weight.sum((-2, -1)).clamp_min(1e-300)
    found = {
        "amplitude_error_db": (amplitude, 0.0),
        "phase_error_rad": (square.sqrt(), math.pi / math.sqrt(3)),
        "image_error_db": (best, 0.0),
    }
    return {name: torch.where(hidden, unknown, value).reshape(lead) for name, (value, unknown) in found.items()}


def _from_middle(n: int, like: Tensor) -> Tensor:
    """Distances of n samples from their middle, in samples, float64 (n,)."""
    return torch.arange(n, dtype=torch.float64, device=like.device) - (n - 1) / 2


def _shifted(a: Tensor, b: Tensor, spectrum: Tensor, turns: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Displacement (trial, axis, 3) and phase (trial, 5) that register image a to b.

    The displacement found here is only a shift, and the phase only a slope. The displacement along
    an axis is in samples of a. Its three coefficients multiply 1, the azimuth sample and the range
    sample, both counted from the middle. The coefficients of the phase, in cycles, are those of x,
    y, x^2, x y and y^2. Here x and y are azimuth and range from the middle, as fractions of the
    size of the image.
    """
    size = a.shape[-2:]
    bright = [torch.fft.fft2(x.abs().square()) for x in (a, b)]
    place = [torch.arange(n, dtype=torch.float64, device=a.device) / n for n in size]
    place = [place[0][:, None], place[1]]
    even = [torch.fft.fftfreq(n, dtype=torch.float64, device=a.device) for n in size]
    shift = _peak(bright[0].conj() * bright[1], [even[0][:, None], even[1]])
    slope = None
    for _ in range(_ROUNDS):
        moved = torch.fft.ifft2(spectrum * _ramp(turns, shift).conj())
        common = moved * b.conj()
        # the first estimate of the slope uses smaller weights of bright pixels, so that few points
        # cannot determine it
        if slope is None:
            size_of = common.abs()
            slope = _peak(common / torch.where(size_of > 0, size_of, 1).sqrt(), place)
        slope = _peak(common, place, slope)
        flat = b * _ramp(place, slope).conj()
        shift = _peak(spectrum.conj() * torch.fft.fft2(flat), turns, shift)
    assert slope is not None
    map_ = torch.zeros(len(a), 2, 3, dtype=torch.float64, device=a.device)
    map_[..., 0] = -torch.cat(shift, -1)[:, 0]
    return map_, torch.nn.functional.pad(torch.cat(slope, -1)[:, 0], (0, 3))


def _displaced(spectrum: Tensor, turns: list[Tensor], map_: Tensor) -> tuple[Tensor, Tensor]:
    """Displace the image of a spectrum along azimuth, then along range.

    Also returns True for the pixels whose source positions are inside the original image.
    """
    u, v = (_from_middle(n, map_) for n in spectrum.shape[-2:])
    of_range = torch.fft.ifft(spectrum, dim=-1)  # azimuth spectra of the range lines
    image = _stretched(of_range, turns[0], u, map_[:, 0, 0, None] + map_[:, 0, 2, None] * v, map_[:, 0, 1])
    back = torch.fft.fft(image, dim=-1).mT
    image = _stretched(back, turns[1].mT, v, map_[:, 1, 0, None] + map_[:, 1, 1, None] * u, map_[:, 1, 2]).mT
    seen = torch.ones_like(image.real, dtype=torch.bool)
    for dim, (at, n) in enumerate(zip((u[:, None], v), spectrum.shape[-2:], strict=True)):
        linear = (
            map_[:, dim, 0, None, None] + map_[:, dim, 1, None, None] * u[:, None] + map_[:, dim, 2, None, None] * v
        )
        source = at + linear + (n - 1) / 2
        # a tolerance for rounding, so that the outermost pixels of an image without displacement
        # are used
        seen = seen & (source > -1e-6) & (source < n - 1 + 1e-6)
    return image, seen


def _stretched(spectrum: Tensor, turns: Tensor, at: Tensor, shift: Tensor, stretch: Tensor) -> Tensor:
    """Samples at the positions `at` (1 + stretch) + shift along the second-last dimension.

    spectrum: spectrum along that dimension, (trial, n, column). turns: frequencies, (trial, n, 1).
    at: positions relative to the middle, (n,). shift: (trial, column). stretch: (trial,). The phase
    at the middle of the spectrum is not changed.
    """
    n = len(at)
    rising, order = turns.sort(1)
    first = rising[:, :1]
    f = torch.fft.fftfreq(n, dtype=torch.float64, device=at.device)
    middle = f[order[:, :1]] - first
    displaced = shift[:, None] + (stretch * at[0])[:, None, None]
    sorted_ = spectrum.gather(1, order.expand_as(spectrum)) * cis(2 * math.pi * rising * displaced)
    image = chirp_z(sorted_, 0.0, -(1 + stretch[:, None]) / n, n, dim=1, centre=0) / n
    place = at[:, None] - at[0]
    return image * cis(2 * math.pi * (middle + first * (1 + stretch[:, None, None])) * place)


def _turned(image: Tensor, phase: Tensor) -> Tensor:
    """Multiply the image by exp(2j pi p), where p is the polynomial with the five coefficients
    `phase` (trial, 5) in cycles; see `_shifted`.
    """
    x, y = (_from_middle(n, phase) / n for n in image.shape[-2:])
    along, across = (phase[:, i, None] * at + phase[:, 2 + 2 * i, None] * at.square() for i, at in enumerate((x, y)))
    total = along[..., None] + across[:, None] + phase[:, 3, None, None] * x[:, None] * y
    return image * cis(2 * math.pi * total)


def _error(moved: Tensor, b: Tensor, seen: Tensor, phase: Tensor) -> Tensor:
    """Error in dB of the compared pixels after multiplication by the best gain, (trial,)."""
    a = torch.where(seen, _turned(moved, phase), 0)
    energy = a.abs().square().sum((-2, -1), keepdim=True)
    gain = (a.conj() * b).sum((-2, -1), keepdim=True) / torch.where(energy == 0, 1, energy)
    return error_db(gain * a, b)


def _step(moved: Tensor, b: Tensor, seen: Tensor, phase: Tensor, turns: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Gauss-Newton step of the displacement (trial, axis, 3) and of the phase (trial, 5)."""
    a = torch.where(seen, _turned(moved, phase), 0)
    energy = a.abs().square().sum((-2, -1), keepdim=True)
    gain = (a.conj() * b).sum((-2, -1), keepdim=True) / torch.where(energy == 0, 1, energy)
    spectrum = torch.fft.fft2(moved)
    along = [torch.fft.ifft2(spectrum * (2j * math.pi * t)) for t in turns]
    along = [gain * torch.where(seen, _turned(x, phase), 0) for x in along]
    a, left = gain * a, b - gain * a
    n, m = a.shape[-2:]
    # coordinates are divided by the size of the image, so that the normal equations are well
    # conditioned
    u, v = _from_middle(n, phase) / n, _from_middle(m, phase) / m
    normal, right = 0.0, 0.0
    for first in range(0, n, _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        x, y = u[rows, None], v
        d0, d1, one = along[0][:, rows], along[1][:, rows], a[:, rows]
        bends = [1j * one * z for z in (x, y, x * x, x * y, y * y)]
        columns = [d0, d0 * x, d0 * y, d1, d1 * x, d1 * y, *bends, one, 1j * one]
        part = torch.stack([column.flatten(1) for column in columns], -1)
        normal = normal + (part.mH @ part).real
        right = right + (part.mH @ left[:, rows].flatten(1)[..., None]).real
    assert isinstance(normal, Tensor) and isinstance(right, Tensor)
    level = normal.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None]
    # regularised, because an image of one point does not determine all coefficients
    ridge = torch.eye(normal.shape[-1], dtype=torch.float64, device=a.device) * torch.where(level > 0, 1e-9 * level, 1)
    step = torch.linalg.solve(normal + ridge, right)[..., 0]
    scale = step.new_tensor([1, n, m])
    return step[:, :6].reshape(-1, 2, 3) / scale, step[:, 6:11] / (2 * math.pi)


def _ramp(turns: list[Tensor], at: list[Tensor]) -> Tensor:
    """Phase ramp exp(2j pi (turns . at)), (..., n, m)."""
    return cis(2 * math.pi * turns[0] * at[0]) * cis(2 * math.pi * turns[1] * at[1])


def _peak(z: Tensor, turns: list[Tensor], start: list[Tensor] | None = None) -> list[Tensor]:
    """Arguments d at which |sum z exp(2j pi turns . d)| is largest, for `turns` in steps of 1/n.

    The search begins at `start`, by default at the maximum of an inverse FFT, and is refined by
    Newton steps.
    """
    size = z.shape[-2:]
    if start is None:
        at = torch.fft.ifft2(z).abs().flatten(-2).argmax(-1)[..., None, None]
        start = [
            torch.where(i > n // 2, i - n, i).to(torch.float64)
            for i, n in zip((at // size[1], at % size[1]), size, strict=True)
        ]
    found = list(start)
    for _ in range(_REFINED):
        for dim, t in enumerate(turns):  # the Newton steps are made along one axis after the other
            turned, w = z * _ramp(turns, found), 2 * math.pi * t
            s0, s1, s2 = (x.sum((-2, -1), keepdim=True) for x in (turned, 1j * w * turned, -w.square() * turned))
            rise = 2 * (s1 * s0.conj()).real
            bend = 2 * (s1.abs().square() + (s2 * s0.conj()).real)
            step = torch.where(bend < 0, -rise / torch.where(bend < 0, bend, -1), 0)
            found[dim] = found[dim] + step.clamp(-0.5, 0.5)
    return found


def _turns(spectrum: Tensor, dim: int) -> Tensor:
    """Frequencies of a spectrum in cycles per sample, within half a cycle of its circular
    centre.
    """
    n, other = spectrum.shape[dim], -3 - dim
    f = torch.fft.fftfreq(n, dtype=torch.float64, device=spectrum.device)
    power = spectrum.abs().square().sum(other)
    middle = torch.angle((power * torch.exp(2j * math.pi * f)).sum(-1, keepdim=True)) / (2 * math.pi)
    off = f - middle
    return (off - torch.round(off)).unsqueeze(other)
