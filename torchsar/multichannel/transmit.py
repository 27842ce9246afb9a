"""Taking the range of a far transmitter out of the phase of every pulse: by the ephemeris, exactly,
or by the scaling phase of the paper.

Source: brief 001, Signal model; Remote Sens. 2020, 12, 1703, Eq. (31).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, per_trial, unit_phasor
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.radar import BistaticRadar, polynomial_range


def transmit_phasor(
    coefficients: Sequence[float | Tensor], time_s: Tensor, wavelength_m: float, dtype: torch.dtype
) -> Tensor:
    """exp(+j 2 pi / lambda (k1 t + k2 t^2 + ...)) of `dtype`, shape of time_s (float64, s): what
    the transmit range took from the phase.
    """
    return unit_phasor(polynomial_range(coefficients, time_s) / wavelength_m, dtype)


def remove_transmit_range(
    data: Tensor, time_s: Tensor, coefficients: Sequence[float | Tensor], wavelength_m: float, with_range: bool = True
) -> Tensor:
    """Data times exp(+j 2 pi / lambda (R_T(t) - R_T(0))), R_T(t) - R_T(0) = k1 t + k2 t^2 + ...:
    afterwards the receive path alone is in the phase.

    data: (..., channel, pulse, range), or (..., channel, pulse) where not with_range; time_s:
    (pulse,) float64; coefficients: numbers or (...,). The transmit range is common to all channels,
    so that this is exact; the receive window follows it, so that envelopes stay. Differentiable in
    data and coefficients. Raises ValueError for times of other pulses.
    """
    pulses = data.shape[-2] if with_range else data.shape[-1]
    if time_s.shape[-1:] != (pulses,):
        raise ValueError(
            f"remove_transmit_range needs one time a pulse ({pulses}), got shape "
            f"{tuple(time_s.shape)}; with_range={with_range} says which axis holds the pulses"
        )
    phasor = transmit_phasor([per_trial(k, 1, data) for k in coefficients], time_s, wavelength_m, data.dtype)
    return data * _over_range(phasor[..., None, :], with_range)


def scale_azimuth(
    data: Tensor, radar: BistaticRadar, time_s: Tensor, motion: PointMotion, order: int = 4, with_range: bool = True
) -> Tensor:
    """Azimuth nonlinear chirp scaling, Eq.

    (31): data of channel m times exp(j pi (q2 t'^2 + q3 t'^3 + q4 t'^4)), t' = t - dx_m / v_e, q_i
    = 2 k_i / lambda.

    data: as in `remove_transmit_range`; motion: of the points, (...,). order: highest coefficient
    taken out. k1 t stays, centres the Doppler at (u_r - k1) / lambda, and belongs into the channel
    response (34): `reconstruct(..., left_k1_m_s=k1)`. Neglects 2 k2 t dx_m / v_e, 0.006 rad at the
    ends of 4.5 s. Differentiable.
    """
    delay = radar.channels_at(data.device) / motion.effective_m_s[..., None]
    bends = (0.0, *radar.transmit_range[1:order])
    return data * _over_range(
        transmit_phasor(bends, time_s - delay[..., None], radar.wavelength_m, data.dtype), with_range
    )


def neglected_transmit_phase_rad(radar: BistaticRadar, order: int, integration_s: float) -> float:
    """Largest phase of the transmit range beyond this order over an integration time centred on t =
    0 (rad).
    """
    half = integration_s / 2
    return (
        2
        * math.pi
        / radar.wavelength_m
        * sum(abs(k) * half**power for power, k in enumerate(radar.transmit_range, 1) if power > order)
    )


def _over_range(phasor: Tensor, with_range: bool) -> Tensor:
    return phasor[..., None] if with_range else phasor


class RemoveTransmitRange(Stage):
    """`remove_transmit_range` by the radar's ephemeris coefficients.

    order: how many of them, None for all.

    Two are enough for apertures below 20 s (brief 001); warns where the rest exceeds 0.3 rad at the
    ends of the data.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar, order: int | None = None) -> None:
        super().__init__()
        if order is not None and order < 0:
            raise ValueError(f"order counts coefficients of the transmit range, 0 for none, got {order}")
        self.radar, self.order = radar, len(radar.transmit_range) if order is None else order

    def forward(self, signal: Signal) -> Signal:
        pulse = signal.axis("pulse")
        left = neglected_transmit_phase_rad(self.radar, max(self.order, 1), pulse.n * pulse.step)
        if left > 0.3:
            warnings.warn(
                f"the transmit range beyond order {self.order} turns the phase by {left:.2g} rad at "
                f"the ends of the data; raise the order to {len(self.radar.transmit_range)}",
                stacklevel=3,
            )
        coefficients = self.radar.transmit_range[: self.order]
        return signal.with_data(
            remove_transmit_range(
                signal.data,
                pulse.values(signal.data.device),
                coefficients,
                self.radar.wavelength_m,
                "range" in signal.names,
            )
        )


class AzimuthScaling(Stage):
    """`scale_azimuth`, the paper's own form, which leaves k1 to the reconstruction.

    order: highest coefficient taken out, 2..4; velocities per trial.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar, order: int = 4) -> None:
        super().__init__()
        if not 2 <= order <= 4:
            raise ValueError(f"azimuth scaling takes out orders 2 to 4 of the transmit range (Eq. 31), got {order}")
        self.radar, self.order = radar, order

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0) -> Signal:
        motion = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s)
        time = signal.axis("pulse").values(signal.data.device)
        return signal.with_data(
            scale_azimuth(signal.data, self.radar, time, motion, self.order, "range" in signal.names)
        )
