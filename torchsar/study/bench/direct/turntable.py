"""Range-compressed pulses of satellites with non-uniform rotation, by direct sums in float64.

The echo follows Remote Sens. 2025, 17, 3447, Eqs. (1)-(3), with the exact sine and cosine of the
rotation angle. It is that of a dechirped pulse of finite length T_p, which the receiver integrates
for each range cell:

    s(n, m) = sum_p s_p integral exp(-j 4 pi (R_p(t_m + tau) - R_0) / lambda
                                     - j 2 pi tau (r_p - y_n) / (cell T_p)) dtau / T_p,

with the range r_p of the scatterer at the middle t_m of the pulse and the range y_n of the cell.
The range changes by the velocity times tau during the pulse. The response is therefore a sinc that
is not periodic over the window, whose side lobes leave the window, and which is displaced by the
velocity times the carrier frequency over the chirp rate. Satellites are random assemblies of faces,
rods and gridded panels with strong corners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

F64 = torch.float64
# width of lines of scatterers over the size of a part: lines of no width would put several
# scatterers into one resolution cell, where the bound for resolved scatterers does not hold
_WIDTH = 0.04


@dataclass(frozen=True)
class Turntable:
    """Sampling of a rotating satellite."""

    prf_hz: float
    pulses: int
    cells: int
    cell_m: float
    count: int
    half_width_m: float
    half_depth_m: float = 3.4
    wavelength_m: float = 1.55e-6
    duty: float = 0.25

    @property
    def range_m(self) -> Tensor:
        return self.cell_m * (torch.arange(self.cells, dtype=F64) - self.cells // 2)

    @property
    def options(self) -> dict:
        return {"wavelength_m": self.wavelength_m, "prf_hz": self.prf_hz, "range_m": self.range_m}

    def satellite(self, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """Cross range, range (m) and complex amplitude of the scatterers, (scatterer,) each."""
        source = torch.Generator().manual_seed(seed)
        at = _assembly(self.count, source)
        lean = math.pi * (torch.rand((), generator=source, dtype=F64) - 0.5) / 3
        turned = at @ torch.stack([lean.cos(), lean.sin(), -lean.sin(), lean.cos()]).view(2, 2)
        low, high = turned.amin(0), turned.amax(0)
        x, y = ((2 * turned - low - high) / (high - low)).unbind(-1)
        level = torch.rand(self.count, generator=source, dtype=F64).clamp_min(1e-6).log().neg().sqrt()
        level = torch.where(torch.rand(self.count, generator=source, dtype=F64) < 0.08, 2.5, level)
        phase = 2 * math.pi * torch.rand(self.count, generator=source, dtype=F64)
        return self.half_width_m * x, self.half_depth_m * y, torch.polar(level, phase)

    def echo(
        self,
        x: Tensor,
        y: Tensor,
        amplitude: Tensor,
        omega_rad_s: float = 0.02,
        k: tuple[float, ...] = (10.0, 1000.0),
        yc_m: float = 0.0,
    ) -> Tensor:
        """Pulses without noise, (pulse, range) complex128."""
        time = torch.arange(self.pulses, dtype=F64)[:, None] / self.prf_hz
        terms = (1.0, *k)
        zero = torch.zeros_like(time)
        angle = omega_rad_s * sum((c * time ** (i + 1) / math.factorial(i + 1) for i, c in enumerate(terms)), zero)
        rate = omega_rad_s * sum((c * time**i / math.factorial(i) for i, c in enumerate(terms)), zero)
        moved = x * torch.sin(angle) - 2 * (y + yc_m) * torch.sin(angle / 2).square()
        velocity = rate * (x * torch.cos(angle) - (y + yc_m) * torch.sin(angle))
        history = torch.polar(torch.ones_like(moved), -4 * math.pi / self.wavelength_m * moved) * amplitude
        # f0 T_p / B in metres per (m/s): the range of a cell is c / (2 B)
        coupled = 2 * self.duty / self.prf_hz / self.wavelength_m * self.cell_m
        offset = (y + moved + coupled * velocity - self.range_m[0]) / self.cell_m
        cell = torch.arange(self.cells, dtype=F64)
        whole = offset.round()
        near = torch.sin(math.pi * (offset - whole)) * torch.where(whole.remainder(2) == 0, 1.0, -1.0) / math.pi
        data = torch.empty(self.pulses, self.cells, dtype=torch.complex128)
        for first in range(0, self.pulses, 100):
            part = slice(first, first + 100)
            apart = offset[part, None] - cell[:, None]
            edge = near[part, None] * torch.where(cell[:, None].remainder(2) == 0, 1.0, -1.0)
            response = torch.where(apart.abs() < 1e-9, 1.0, edge / torch.where(apart.abs() < 1e-9, 1.0, apart))
            data[part] = (response.to(torch.complex128) @ history[part, :, None])[..., 0]
        return data

    def noisy(self, clean: Tensor, snr_db: float, seed: int) -> tuple[Tensor, float]:
        """Pulses with white noise, and the standard deviation of the noise.

        The SNR is the mean power of all samples over that of the noise.
        """
        std = float((clean.abs().square().mean() * 10 ** (-snr_db / 10)).sqrt())
        return clean + std * torch.randn(
            clean.shape, dtype=torch.complex128, generator=torch.Generator().manual_seed(seed)
        ), std


# settings of the scenes and methods, by choice
SMALL = Turntable(125e3, 2500, 64, 0.12, 120, 1.6)
MID = Turntable(500e3, 10000, 32, 0.24, 300, 6.43)


def _assembly(count: int, source: torch.Generator) -> Tensor:
    """Points of a random body with two wings and rods, (scatterer, 2), in arbitrary units."""

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=source, dtype=F64)

    wings, rods = int(0.5 * count), int(0.15 * count)
    half = 0.3 + 0.4 * uniform(2)
    side = torch.randint(4, (count - wings - rods,), generator=source)
    along = 2 * uniform(count - wings - rods) - 1
    across = torch.where(side < 2, 1.0, -1.0)
    face = torch.where((side % 2 == 0)[:, None], torch.stack([along, across], -1), torch.stack([across, along], -1))
    columns = int(torch.randint(3, 9, (1,), generator=source))
    wing = torch.stack([torch.randint(columns + 1, (wings,), generator=source) / columns, uniform(wings)], -1)
    lines = torch.randint(3, (wings,), generator=source) / 2
    wing = torch.where((uniform(wings) < 0.5)[:, None], wing, torch.stack([uniform(wings).to(F64), lines], -1))
    sign = torch.where(uniform(wings) < 0.5, -1.0, 1.0)
    reach, chord = 1.5 + 2 * uniform(1), 0.2 + 0.8 * uniform(1)
    wing = wing + _WIDTH * (uniform(wings, 2) - 0.5)
    wing = torch.stack([sign * (half[0] + reach * wing[:, 0]), chord * (2 * wing[:, 1] - 1)], -1)
    direction = 2 * math.pi * uniform(3)
    which = torch.randint(3, (rods,), generator=source)
    length = half.max() + (0.5 + uniform(3))[which] * uniform(rods)
    rod = length[:, None] * torch.stack([direction.cos(), direction.sin()], -1)[which]
    return torch.cat([half * face, wing, rod + _WIDTH * (uniform(rods, 2) - 0.5)])
