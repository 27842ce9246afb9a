"""Sweeps that are not straight: phase errors of the laser, and the internal channel that records
them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial, unit_phasor
from torchsar.radar import TriangularLadar
from torchsar.scene import CalibrationFibre, SweepError


@dataclass(frozen=True)
class PolynomialSweepError:
    """Frequency error sum_i c_i (u / s)^i of the sweep, u from its middle: coefficients (Hz, Hz/s,
    Hz/s^2, ...) of up and down sweeps.

    The phase error e(u) is its antiderivative, zero in the middle of each sweep.
    """

    up_hz: Sequence[float]
    down_hz: Sequence[float]

    def __post_init__(self) -> None:
        if (
            not len(self.up_hz)
            or not len(self.down_hz)
            or not all(math.isfinite(c) for c in (*self.up_hz, *self.down_hz))
        ):
            raise ValueError(
                "a polynomial sweep error needs finite coefficients for up and down, got "
                f"{self.up_hz} and {self.down_hz}; leave the effect out where there is none"
            )

    def turns(self, time_s: Tensor, ramp: int) -> Tensor:
        total = torch.zeros_like(time_s)
        for degree, c in reversed(list(enumerate(self.down_hz if ramp else self.up_hz))):
            total = (total + c / (degree + 1)) * time_s
        return total


@dataclass(frozen=True)
class SinusoidSweepError:
    """Frequency error A sin(2 pi F u + phase) of the sweep, u from its middle, with a phase of its
    own in up and down sweeps.
    """

    amplitude_hz: float
    frequency_hz: float
    phase_up_deg: float = 0.0
    phase_down_deg: float = 0.0

    def __post_init__(self) -> None:
        if (
            not all(
                math.isfinite(v) for v in (self.amplitude_hz, self.frequency_hz, self.phase_up_deg, self.phase_down_deg)
            )
            or not self.frequency_hz > 0
        ):
            raise ValueError(f"a sinusoidal sweep error needs finite numbers and a frequency above 0 Hz, got {self}")

    def turns(self, time_s: Tensor, ramp: int) -> Tensor:
        phase = math.radians(self.phase_down_deg if ramp else self.phase_up_deg)
        middle = math.cos(phase)
        return (
            self.amplitude_hz
            / (2 * math.pi * self.frequency_hz)
            * (middle - torch.cos(2 * math.pi * self.frequency_hz * time_s + phase))
        )


def wound_turns(error: SweepError, radar: TriangularLadar, position_s: Tensor) -> Tensor:
    """Phase error as a continuous function of the time since the start of a triangle (turns): sweep
    joined to sweep, period to period.
    """
    half = torch.as_tensor(radar.sweep_s / 2, dtype=torch.float64, device=position_s.device)
    ends = [(error.turns(-half, ramp), error.turns(half, ramp)) for ramp in (0, 1)]
    gain_up, gain_down = (last - first for first, last in ends)
    period = torch.floor(position_s.detach() / radar.period_s)
    within = position_s - period * radar.period_s
    up = error.turns(within - half, 0) - ends[0][0]
    down = gain_up + error.turns(within - 3 * half, 1) - ends[1][0]
    return period * (gain_up + gain_down) + torch.where(within.detach() < radar.sweep_s, up, down)


def calibration_channel(
    radar: TriangularLadar,
    fibre: CalibrationFibre,
    error: SweepError | None,
    n_period: int,
    draws: Draws,
    dtype: torch.dtype,
    device: torch.device | str | None = None,
) -> Tensor:
    """What the internal fibre records in the sweeps, (*trials, 2, K or 1, fast_time) of `dtype`,
    amplitude 1.

    Turns in the up sweep: fc tc + K u tc - K tc^2 / 2 + e(u) - e(u - tc), in the down sweep with -K
    and its own e; conjugated where the radar's dechirp sign is "echo_conj_lo". Noise by
    fibre.snr_db per sample.
    """
    u, delay, rate = radar.fast_time_axis().values(device), fibre.delay_s, radar.chirp_rate_hz_s
    rows = []
    for ramp, sign in ((0, 1.0), (1, -1.0)):
        turns = radar.carrier_hz * delay + sign * rate * delay * (u - delay / 2)
        rows.append(turns if error is None else turns + error.turns(u, ramp) - error.turns(u - delay, ramp))
    clean = unit_phasor(torch.stack(rows), dtype)[:, None]
    shape = (2, n_period if fibre.every_period else 1, len(u))
    if fibre.snr_db is None:
        found = clean.expand(*shape) if draws.trials is None else clean.expand(len(draws.trials), *shape)
    else:
        std = 10 ** (-per_trial(fibre.snr_db, 3, u) / 20)
        found = clean + draws.normal("echo.calibration.noise", shape, dtype, device) * std.to(clean.real.dtype)
    return found.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else found
