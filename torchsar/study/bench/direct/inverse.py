"""Dechirped pulses of a rotating and moving target, by direct evaluation in float64.

The signal model is that of Ruan et al. 2013 (Laser & Optoelectronics Progress 50, 102801), section
2.1, with what the paper neglects. The transmitted pulse i is exp(2j pi (f0 t + gamma t^2 / 2)) with
the time t from its middle and a start phase. A scatterer reflects it at its true distance from the
radar at the instant of the reflection: the wavefront is spherical, and translation, rotation and
vibration go on during the flight and during the pulse. The receiver multiplies the echo by the
conjugate of the echo of a point at the range that it tracks, samples the product faster than the
range window requires, and keeps the cells of the window only. The range response is therefore not
periodic in the window.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# speed of light in m/s
C = 299_792_458.0
F64 = torch.float64


@dataclass(frozen=True)
class Ladar:
    """Numbers of a radar and of its record; `finer` is the oversampling of the receiver."""

    carrier_hz: float = C / 1.55e-6
    bandwidth_hz: float = 150e9
    prf_hz: float = 2000.0
    rotation_rad_s: float = 0.005
    pulse_s: float = 100e-6
    range_m: float = 20e3
    pulses: int = 400
    cells: int = 256
    finer: int = 2

    def truth_rad(self, moved: Callable[[Tensor], Tensor], tracked: Callable[[Tensor], Tensor]) -> Tensor:
        """Phase of every pulse due to the motion along the line of sight, (pulse,)."""
        reflected = torch.arange(self.pulses, dtype=F64) / self.prf_hz + self.range_m / C
        return -4 * math.pi * self.carrier_hz / C * (moved(reflected) - tracked(reflected))


def still(t: Tensor) -> Tensor:
    """No motion."""
    return torch.zeros_like(t)


def echo(
    ladar: Ladar,
    x: Tensor,
    y: Tensor,
    amplitude: Tensor,
    moved: Callable[[Tensor], Tensor] = still,
    tracked: Callable[[Tensor], Tensor] = still,
) -> Tensor:
    """Dechirped pulses without noise and start phases, (pulse, fast time) complex128.

    The scatterers lie at the cross range `x` and the range `y` from the centre of rotation when
    they reflect the middle pulse. `moved` and `tracked` give the displacement in metres of the
    centre, at the time of reflection, and of the reference, at the time of the pulse, from the
    range of the ladar. The amplitude of a scatterer is that of its echo in the middle pulse.
    """
    fine = ladar.finer * ladar.cells
    fast = (torch.arange(fine, dtype=F64) - fine // 2) * (ladar.pulse_s / fine)
    rate = ladar.bandwidth_hz / ladar.pulse_s
    middle = torch.tensor(ladar.pulses // 2 / ladar.prf_hz + ladar.range_m / C, dtype=F64)
    # the delay is smooth within a pulse: six instants determine it
    nodes = ladar.pulse_s / 2 * torch.cos(math.pi * (torch.arange(6, dtype=F64) + 0.5) / 6)
    between = torch.linalg.solve(torch.vander(nodes / ladar.pulse_s).T, torch.vander(fast / ladar.pulse_s, 6).T).T

    def distance(t: Tensor, centre_m: Tensor) -> Tensor:
        """Distance less the range of the ladar, (..., scatterer); t: time of reflection."""
        angle = ladar.rotation_rad_s * (t - middle)
        across = x * torch.cos(angle) - y * torch.sin(angle)
        along = centre_m + x * torch.sin(angle) + y * torch.cos(angle)
        whole = ladar.range_m + along
        return along + across.square() / (torch.hypot(whole, across) + whole)

    turned = torch.polar(torch.ones_like(x), 4 * math.pi * ladar.carrier_hz / C * distance(middle, still(middle)))
    weight = amplitude.to(torch.complex128) * turned
    rows = []
    for pulse in range(ladar.pulses):
        arrival = pulse / ladar.prf_hz + 2 * ladar.range_m / C + nodes[:, None]
        reference = beyond = torch.zeros((), dtype=F64)  # delays less that of the range of the ladar
        for _ in range(4):
            reflected = arrival - ladar.range_m / C - beyond / 2
            beyond = 2 * distance(reflected, moved(reflected)) / C
            reference = 2 * tracked(arrival - ladar.range_m / C - reference / 2) / C
        late, u = between @ (beyond - reference), fast[:, None]
        turns = late * (rate / 2 * late - (ladar.carrier_hz + rate * u))
        inside = ((u - late).abs() <= ladar.pulse_s / 2).to(F64)
        rows.append(torch.polar(inside, 2 * math.pi * torch.remainder(turns, 1)) @ weight)
    wide = torch.fft.fftshift(torch.fft.ifft(torch.fft.ifftshift(torch.stack(rows), dim=-1)), dim=-1)
    edge = (fine - ladar.cells + 1) // 2
    kept = wide[:, edge : edge + ladar.cells]
    return torch.fft.fftshift(torch.fft.fft(torch.fft.ifftshift(kept, dim=-1)), dim=-1)
