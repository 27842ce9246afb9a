"""Errors of point responses due to approximate range histories, predicted without simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import receive_range
from torchsar.scene.bistatic import ExactRange, Gate, ReceiveRange
from torchsar.scene.movers import Movers


@dataclass(frozen=True)
class LitPoints:
    """Moving points, one per row, with the times at which they are illuminated and processed.

    Every predicted error is that of the worst point: the mean of |exp(j phi) - 1|^2 over the
    pulses, weighted by the power of the gate, in dB, where phi is the neglected phase.

    Args:
        movers: Points, shape (row, 1).
        gate: Illumination of the points.
        radar: Radar parameters.
        n_pulse: Number of pulses.
        processed_hz: Width of the Doppler band that is focused in hertz; None for the whole band in
            which points are illuminated.
    """

    movers: Movers
    gate: Gate
    radar: BistaticRadar
    n_pulse: int
    processed_hz: float | None = None

    @cached_property
    def time_s(self) -> Tensor:
        """Slow times in seconds, shape (time,)."""
        step = max(1, self.n_pulse // 513)
        return self.radar.pulse_axis(self.n_pulse).values()[::step]

    @cached_property
    def weight(self) -> Tensor:
        """Power gain of the gate, set to zero outside the processed band, shape (row, time)."""
        power = self.gate.weight(self.movers, self.time_s, self.radar)[..., 0].square().mean(-2)
        if self.processed_hz is None:
            return power
        along = self.radar.speed_m_s - self.movers.u_a_m_s
        half_s = self.processed_hz * self.radar.wavelength_m * self.radar.reference_range_m / (2 * along.square())
        return power * ((self.time_s - self.movers.y0_m / along).abs() <= half_s)

    def _worst_db(self, phase_rad: Tensor) -> float:
        """Error in dB of the point with the largest error, for phases (row or 1, time, any)."""
        square = (2 - 2 * torch.cos(phase_rad)).mean(-1)
        error = (self.weight * square).sum(-1) / self.weight.sum(-1).clamp_min(torch.finfo(torch.float64).tiny)
        return 10 * math.log10(max(float(error.max()), 1e-30))

    def transmit_order_db(self, order: int) -> float:
        """Predict the error where the transmit range is compensated to a given order in slow time.

        Args:
            order: Number of coefficients of radar.transmit_range, k1 of t, k2 of t^2, ..., that are
                compensated; the others are neglected.

        Returns:
            Mean of |exp(j phi) - 1|^2 over the pulses in dB for the worst point, with the neglected
            phase phi.
        """
        left = self.radar.transmit_range[order:]
        metres = sum((k * self.time_s ** (order + i) for i, k in enumerate(left, 1)), torch.zeros_like(self.time_s))
        return self._worst_db(2 * math.pi / self.radar.wavelength_m * metres[None, :, None])

    def migration_db(self, bulk: bool, known: bool = False) -> float:
        """Predict the error due to range migration that is not corrected.

        Args:
            bulk: Whether range migration is corrected; otherwise all of it remains.
            known: Whether the correction of each point is that of its true motion; otherwise all
                points are corrected as a point at rest at the along-track position 0.

        Returns:
            Mean of |exp(j phi) - 1|^2 over pulses and range frequencies in dB for the worst point,
            where phi is the phase that the remaining migration causes across the band.
        """
        radar, frequency_hz = self.radar, torch.linspace(-0.5, 0.5, 17, dtype=torch.float64)
        left = ExactRange().range_m(self.movers, self.time_s, radar).mean(-3) - self.movers.range_m[..., None, :]
        if bulk:
            rest = receive_range(self.time_s, 0.0, 0.0, 0.0, radar.reference_range_m, radar.speed_m_s, 0.0)
            left = torch.zeros_like(left) if known else left - rest[:, None]
        return self._worst_db(2 * math.pi * radar.pulse.bandwidth_hz / radar.wave_speed_m_s * frequency_hz * left)

    def receive_model_db(self, model: ReceiveRange) -> float:
        """Predict the error of the echo due to a model of the range to the receiver.

        Args:
            model: Model of the range.

        Returns:
            Mean of |exp(j phi) - 1|^2 over the pulses in dB for the worst point, where phi is the
            phase difference between the model and the exact range.
        """
        left = (one.range_m(self.movers, self.time_s, self.radar) for one in (model, ExactRange()))
        phase = 2 * math.pi / self.radar.wavelength_m * torch.sub(*left)[..., 0].mT
        return self._worst_db(phase)
