"""Non-linear sweeps of a ladar: phase errors of the laser, and the channel that records them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import Draws, per_trial, unit_phasor
from torchsar.echo.recorded import noise, trials_of
from torchsar.radar import TriangularLadar
from torchsar.scene import CalibrationFibre
from torchsar.scene.ladar import SweepError
from torchsar.scene.trials import either, finite_numbers, with_dims


@dataclass(frozen=True)
@finite_numbers("a polynomial sweep error")
class PolynomialSweepError(SweepError):
    """Frequency error of the sweep as a polynomial, sum_i c_i u^i.

    >>> import torch
    >>> from torchsar import echo
    >>> error = echo.PolynomialSweepError(up_hz=[1e6], down_hz=[0.0])
    >>> error.turns(torch.tensor([-1e-6, 0.0, 1e-6]), ramp=0)  # in cycles
    tensor([-1.,  0.,  1.])

    u is the time from the middle of the sweep in seconds. The phase error is the antiderivative of
    the frequency error, zero at the middle of each sweep.

    Args:
        up_hz: c_0, c_1, ... of the up-sweep in Hz, Hz/s, ...; each a number or one value per trial.
        down_hz: c_0, c_1, ... of the down-sweep.

    Raises:
        ValueError: If a list is empty or a coefficient is not finite.
    """

    up_hz: Sequence[Tensor | float]
    down_hz: Sequence[Tensor | float]

    def __post_init__(self) -> None:
        if not len(self.up_hz) or not len(self.down_hz):
            raise ValueError(
                "up_hz and down_hz of a polynomial sweep error must each have at least one coefficient, "
                f"got {self.up_hz} and {self.down_hz}; leave the sweep error out where there is none"
            )

    def turns(self, time_s: Tensor, ramp: int, dims: int | None = None) -> Tensor:
        behind = time_s.ndim if dims is None else dims
        total = torch.zeros_like(time_s)
        for degree, c in reversed(list(enumerate(self.down_hz if ramp else self.up_hz))):
            total = (total + with_dims(c, behind, time_s) / (degree + 1)) * time_s
        return total


@dataclass(frozen=True)
@finite_numbers("a sinusoidal sweep error", frequency_hz="positive")
class SinusoidSweepError(SweepError):
    """Frequency error of the sweep as a sinusoid, A sin(2 pi F u + phase).

    >>> import math, torch
    >>> from torchsar import echo
    >>> error = echo.SinusoidSweepError(amplitude_hz=math.pi * 1e6, frequency_hz=1e6)
    >>> error.turns(torch.tensor([-5e-7, 0.0, 5e-7]), ramp=0).round(decimals=2)  # in cycles
    tensor([1., 0., 1.])

    u is the time from the middle of the sweep in seconds. The phase error is the antiderivative of
    the frequency error, zero at the middle of each sweep.

    Args:
        amplitude_hz: Amplitude A in hertz.
        frequency_hz: Frequency F in hertz.
        phase_up_deg: Phase of the up-sweep in degrees.
        phase_down_deg: Phase of the down-sweep in degrees.

    Raises:
        ValueError: If a number is not finite or the frequency is not positive.
    """

    amplitude_hz: Tensor | float
    frequency_hz: Tensor | float
    phase_up_deg: Tensor | float = 0.0
    phase_down_deg: Tensor | float = 0.0

    def turns(self, time_s: Tensor, ramp: int, dims: int | None = None) -> Tensor:
        behind = time_s.ndim if dims is None else dims
        phase = either(self.phase_down_deg if ramp else self.phase_up_deg, math.radians, torch.deg2rad)
        amplitude, frequency, middle, phase = (
            with_dims(v, behind, time_s)
            for v in (self.amplitude_hz, self.frequency_hz, either(phase, math.cos, torch.cos), phase)
        )
        return amplitude / (2 * math.pi * frequency) * (middle - torch.cos(2 * math.pi * frequency * time_s + phase))


def wound_turns(error: SweepError, radar: TriangularLadar, position_s: Tensor) -> Tensor:
    """Return the phase error of the laser, continued without jumps from sweep to sweep.

    The phase error is zero at time 0, the start of an up-sweep. Each sweep starts with the phase
    error at which the sweep before it ends. The same up-sweep and down-sweep repeat in every
    period.

    Args:
        error: Phase error of one up-sweep and one down-sweep.
        radar: Ladar parameters.
        position_s: Time since the start of a period in seconds, negative before it, shape (n,) or
            (..., pulse, n), float64.

    Returns:
        Phase error in cycles, shape (*trials, n) or (*trials, pulse, n).
    """
    half = torch.as_tensor(radar.sweep_s / 2, dtype=torch.float64, device=position_s.device)
    ends = [(error.turns(-half, ramp, 2), error.turns(half, ramp, 2)) for ramp in (0, 1)]
    gain_up, gain_down = (last - first for first, last in ends)
    period = torch.floor(position_s.detach() / radar.period_s)
    within = position_s - period * radar.period_s
    up = error.turns(within - half, 0, 2) - ends[0][0]
    down = gain_up + error.turns(within - 3 * half, 1, 2) - ends[1][0]
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
    """Return the beat signal of the internal calibration fibre in every sweep, with amplitude 1.

    At the time u from the middle of an up-sweep the phase in cycles is
    fc tc + K u tc - K tc^2 / 2 + e(u) - e(u - tc), with the carrier fc, the chirp rate K, the delay
    tc of the fibre and the phase error e of the laser. In a down-sweep, K is replaced by -K, and e
    is the error of the down-sweep. The signal is conjugated if radar.dechirp_sign is
    "echo_conj_lo".

    Args:
        radar: Ladar parameters.
        fibre: Calibration fibre.
        error: Phase error of the laser, None for none.
        n_period: Number of periods.
        draws: Random draws of the noise.
        dtype: Complex dtype of the result.
        device: Device of the result.

    Returns:
        Beat signal, shape (*trials, 2, n, fast_time): the up-sweep, then the down-sweep, of
        n = n_period periods if `fibre.every_period` is set, otherwise of n = 1 period.

    Reference:
        Remote Sens. 2024, 16, 793, section 2.1 (internal calibration module).
    """
    u, rate = radar.fast_time_axis().values(device), radar.chirp_rate_hz_s
    delay = with_dims(fibre.delay_s, 1, u)
    rows = []
    for ramp, sign in ((0, 1.0), (1, -1.0)):
        turns = radar.carrier_hz * delay + sign * rate * delay * (u - delay / 2)
        rows.append(turns if error is None else turns + error.turns(u, ramp, 1) - error.turns(u - delay, ramp, 1))
    clean = unit_phasor(torch.stack(torch.broadcast_tensors(*rows), -2), dtype)[..., None, :]
    shape = (2, n_period if fibre.every_period else 1, len(u))
    found = clean.expand(*trials_of(draws, 3, clean), *shape)
    if fibre.snr_db is not None:
        std = 10 ** (-per_trial(fibre.snr_db, 0, u) / 20)
        found = clean + noise(draws, "echo.calibration.noise", shape, std, dtype, device)
    return found.conj().resolve_conj() if radar.dechirp_sign == "echo_conj_lo" else found
