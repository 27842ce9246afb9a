"""Entropy of the image as a function of the rotation: range phase, matched Fourier transform,
entropy; many candidates at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.rotation.unknowns import Turn, Unknowns, Variables
from torchsar.core import Signal, block_bytes_of, real_dtype, refuse_non_finite
from torchsar.focus.matched_fourier import matched_fourier, range_phase
from torchsar.radar import InverseRadar


class ImageEntropy:
    """Entropy (nats) of the image of range-compressed pulses by the rotation taken out of them: the
    objective of every search for the rotation.

    figure(x): costs (..., candidate) of candidates x (..., candidate, n), the unknowns of
    `figure.unknowns`; +inf, never NaN, where the warp is not monotonic. Differentiable twice in x.
    figure.single(x): the same of one vector per trial, (..., n) -> (...,); figure.with_gradient(x):
    cost and gradient by blocks, for `torchsar.optim.lbfgs`.

    data: (..., pulse, range) complex. wavelength_m, prf_hz: of the instrument; range_m: (range,)
    coordinates y_n, zero in the middle of the window. order, range_term, variables: see `Unknowns`.
    yc_m: the deviation of the rotation centre (m), a number or (...,), that y_n + yc is the range
    from it; None searches for it. oversampling: of the image lines. At 1 peaks fall between lines
    and displace the minimum: by 2 % of k and 24 % of omega on a target of 120 points at 20 dB, at 2
    by 0.2 and 1 %, at 4 by 0.07 and 0.2 %; more on smaller targets. lines: computed about zero
    Doppler, by default all that the pulse rate holds. taps: of the kernel of the transform; 4 of
    them err by 2e-6 in entropy, 6 by 1e-7.

    Memory: candidates go through in blocks; derivatives keep what all their candidates need. Raises
    TypeError or ValueError for samples that are not complex and finite, fewer than 8 pulses,
    numbers that are not positive, or a range axis of another length. Remote Sens. 2025, 17, 3447,
    Eqs. (7)-(12), the entropy of |I|^2 over all pixels.
    """

    def __init__(
        self,
        data: Tensor,
        *,
        wavelength_m: float,
        prf_hz: float,
        range_m: Tensor,
        order: int = 3,
        range_term: bool = True,
        yc_m: Tensor | float | None = 0.0,
        variables: Variables = "raw",
        oversampling: float = 2.0,
        lines: int | None = None,
        taps: int = 4,
    ) -> None:
        _check(data, wavelength_m, prf_hz, range_m)
        self.wavelength_m, self.prf_hz, self.range_m = (
            wavelength_m,
            prf_hz,
            range_m.to(device=data.device, dtype=torch.float64),
        )
        self.oversampling, self.lines, self.taps = oversampling, lines, taps
        self.unknowns = Unknowns(data.shape[-2] / prf_hz, order, range_term, yc_m is None, variables)
        self.trials, self.dtype = data.shape[:-2], data.dtype
        self._data = _levelled(data.detach()).reshape(-1, *data.shape[-2:])
        known = torch.as_tensor(0.0 if yc_m is None else yc_m, dtype=torch.float64, device=data.device).detach()
        self._yc = known.expand(self.trials).reshape(-1)

    @staticmethod
    def of(signal: Signal, radar: InverseRadar, **options: Any) -> ImageEntropy:
        """Of a signal (pulse, range) of an instrument; options as in the constructor."""
        return ImageEntropy(
            signal.data,
            wavelength_m=radar.wavelength_m,
            prf_hz=radar.prf_hz,
            range_m=signal.axis("range").values(signal.data.device),
            **options,
        )

    def __call__(self, x: Tensor) -> Tensor:
        rows, count = x.reshape(-1, x.shape[-1]), x.shape[-2]
        costs = [self._cost(part, rows[part], count) for part in self._blocks(len(rows), count)]
        return torch.cat(costs).reshape(x.shape[:-1])

    def single(self, x: Tensor) -> Tensor:
        """Costs (...,) of one vector (..., n) per trial."""
        return self(x[..., None, :])[..., 0]

    def with_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Costs (...,) and gradients (..., n) of one vector per trial, block by block."""
        rows = x.detach().reshape(-1, x.shape[-1])
        pairs = [
            _steep(lambda part_x, part=part: self._cost(part, part_x, 1), rows[part])
            for part in self._blocks(len(rows), 1)
        ]
        cost, gradient = (torch.cat(parts) for parts in zip(*pairs, strict=True))
        return cost.reshape(x.shape[:-1]), gradient.reshape(x.shape)

    def turn(self, x: Tensor) -> Turn:
        """The rotation (...,) that one vector (..., n) per trial stands for."""
        return self.unknowns.turn(x, self._yc.reshape(self.trials))

    def start(self, omega_rad_s: Tensor | float, warp_k: Tensor, yc_m: Tensor | float | None = None) -> Tensor:
        """The vector (..., n) of a rotation, one per trial; yc_m: by default the known one,
        or 0.
        """
        like = {"dtype": torch.float64, "device": self._data.device}
        omega, k = torch.as_tensor(omega_rad_s, **like), torch.as_tensor(warp_k, **like)
        if k.shape[-1:] != (self.unknowns.order - 1,):
            raise ValueError(
                f"a rotation of order {self.unknowns.order} starts from warp_k with "
                f"{self.unknowns.order - 1} entries in its last dim, got shape {tuple(k.shape)}"
            )
        yc = self._yc.reshape(self.trials) if yc_m is None else torch.as_tensor(yc_m, **like)
        return self.spread(self.unknowns.at(omega, k, yc))

    def spread(self, x: Tensor) -> Tensor:
        """A vector (n,) or (..., n) for every trial, on the device of the data."""
        return x.to(self._data.device).expand(*self.trials, x.shape[-1]).contiguous()

    def units(self, x: Tensor) -> Tensor:
        """Steps (..., n) of about a radian at the edge of the target, see `Unknowns.units`."""
        step = float(self.range_m[1] - self.range_m[0]) if len(self.range_m) > 1 else 1.0
        return self.unknowns.units(x, self.wavelength_m, abs(step) * len(self.range_m), self._data.shape[-2])

    def uncompensated(self) -> Tensor:
        """Entropy (...,) of the image of even rotation without range phase."""
        flat = torch.zeros(len(self._data), self.unknowns.order - 1, dtype=torch.float64, device=self._data.device)
        with torch.no_grad():
            costs = [self._entropy(self._data[part], flat[part]) for part in self._blocks(len(flat), 1)]
        return torch.cat(costs).reshape(self.trials)

    def _blocks(self, rows: int, count: int) -> Iterator[slice]:
        """Rows of candidates that stay in the cache together, `count` of them for each trial; a
        block does not cross trials where there are several candidates.
        """
        size = self._data[0].numel() * self._data.element_size() * max(1.0, self.oversampling)
        height = max(1, int(4 * block_bytes_of(self._data.device) // size))
        if count == 1:
            yield from (slice(first, min(first + height, rows)) for first in range(0, rows, height))
            return
        for trial in range(0, rows, count):
            yield from (
                slice(first, min(first + height, trial + count)) for first in range(trial, trial + count, height)
            )

    def _cost(self, part: slice, x: Tensor, count: int) -> Tensor:
        """Costs (row,) of a block of vectors (row, n)."""
        own = slice(part.start // count, (part.stop - 1) // count + 1)
        turn = self.unknowns.turn(x.to(torch.float64), self._yc[own])
        pulses = self._data[own]
        if self.unknowns.range_term:
            pulses = range_phase(
                pulses, self.range_m, self.wavelength_m, self.prf_hz, turn.omega_rad_s, turn.warp_k, turn.yc_m
            )
        return torch.where(turn.feasible, self._entropy(pulses, turn.warp_k), torch.inf)

    def _entropy(self, pulses: Tensor, k: Tensor) -> Tensor:
        image = matched_fourier(
            pulses, k, self.prf_hz, oversampling=self.oversampling, lines=self.lines, taps=self.taps
        )
        return _entropy(image)


def _entropy(image: Tensor) -> Tensor:
    """-sum p ln p, p = |I|^2 / sum |I|^2, of images of about unit level, (..., line, range) ->
    (...,) float64.
    """
    power = torch.view_as_real(image).square().sum(-1)
    total = power.sum((-2, -1), dtype=torch.float64)
    inner = (power * torch.log(power.clamp_min(torch.finfo(power.dtype).tiny))).sum((-2, -1), dtype=torch.float64)
    safe = torch.where(total > 0, total, 1)
    return torch.log(safe) - inner / safe


def _steep(cost: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor]:
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        value = cost(x)
        (gradient,) = torch.autograd.grad(value.sum(), x)
    return value.detach(), gradient


def _levelled(data: Tensor) -> Tensor:
    """Each trial over its root mean square, so that squares neither under- nor overflow."""
    peak = data.abs().amax((-2, -1), keepdim=True)
    unit = data / torch.where(peak > 0, peak, 1)
    rms = (unit.real.square() + unit.imag.square()).mean((-2, -1), keepdim=True).sqrt()
    return unit / torch.where(rms > 0, rms, 1)


def _check(data: Tensor, wavelength_m: float, prf_hz: float, range_m: Tensor) -> None:
    real_dtype(data.dtype)
    if data.ndim < 2 or data.shape[-2] < 8 or not data.shape[-1]:
        raise ValueError(
            "the entropy of an image needs data (..., pulse, range) of at least 8 pulses, got "
            f"shape {tuple(data.shape)}"
        )
    refuse_non_finite(data, "ImageEntropy")
    for name, value in (("wavelength_m", wavelength_m), ("prf_hz", prf_hz)):
        if not value > 0:
            raise ValueError(f"ImageEntropy: {name} must be positive, got {value}")
    if range_m.shape != data.shape[-1:]:
        raise ValueError(
            f"ImageEntropy: range_m needs the {data.shape[-1]} coordinates of the range axis, got "
            f"shape {tuple(range_m.shape)}"
        )
