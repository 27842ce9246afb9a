"""Azimuth reconstruction: from the aliased spectra of several channels to the full Doppler band of
a moving point.

Source: Remote Sens. 2020, 12, 1703, Eqs. (34)-(36). Data are demodulated by the Doppler centre of
the assumed motion, so that the rebuilt bands lie evenly about it to a fraction of a bin, and the
result is smooth in the velocities.
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, fft_lines, linear_phasor
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import (
    POOR,
    SINGULAR,
    SINGULAR_SINGLE,
    LeastSquares,
    Rebuild,
    condition_number,
    doppler_centre_hz,
    first_bin,
    shared_response,
)
from torchsar.radar import BistaticRadar


def reconstruct(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, left_k1_m_s: float = 0.0
) -> Tensor:
    """The full-band Doppler spectrum of points with this motion, about their Doppler centre.

    data: complex (..., channel, pulse), slow time zero at pulse n // 2, transmit range removed
    (else left_k1_m_s is its rate). Returns (..., bands * pulse), bins rising from `first_bin`,
    phases against slow time zero, scaled as the FFT of bands * pulse samples of the point seen by
    one channel. Differentiable in data and motion. Raises ValueError where the bands cannot be told
    apart by so many channels.
    """
    return reconstruct_lines(data[..., None], radar, motion, rebuild, left_k1_m_s)[..., 0]


def reconstruct_lines(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, left_k1_m_s: float = 0.0
) -> Tensor:
    """As `reconstruct` for data (..., channel, pulse, range) with one motion for all range lines;
    returns (..., bands * pulse, range).
    """
    _refuse_bands(data, radar, rebuild)
    n, dtype = data.shape[-2], data.dtype
    spectrum = fft_lines(_demodulated(data, radar, motion, rebuild.bands, left_k1_m_s))
    # pulse 0 was sampled n // 2 pulses before slow time zero
    late = linear_phasor(torch.tensor(n // 2 / n, dtype=torch.float64, device=data.device), 0.0, n, dtype)
    spectrum = (
        spectrum * (shared_response(radar, motion, n, rebuild.bands, dtype, left_k1_m_s).conj() * late)[..., None]
    )
    return _combined(spectrum, rebuild.weights(radar, motion, n).to(dtype) * rebuild.bands, motion.trial_dims)


def _demodulated(data: Tensor, radar: BistaticRadar, motion: PointMotion, bands: int, left_k1_m_s: float) -> Tensor:
    """Data whose FFT begins with the lowest bin of the lowest band about the Doppler centre: no
    spectrum need be rolled.
    """
    n = data.shape[-2]
    turns = -doppler_centre_hz(radar, motion, left_k1_m_s) / radar.prf_hz - first_bin(n, bands) % n / n
    return data * linear_phasor(turns, -(n // 2), n, data.dtype)[..., None, :, None]


def _combined(spectrum: Tensor, weights: Tensor, trial_dims: int) -> Tensor:
    """Weights (..., band, channel), or per bin (..., pulse, band, channel), over spectra (...,
    channel, pulse, range): (..., band * pulse, range).
    """
    if weights.ndim == trial_dims + 2:
        return (weights @ spectrum.flatten(-2)).unflatten(-1, spectrum.shape[-2:]).flatten(-3, -2)
    return (weights @ spectrum.transpose(-3, -2)).transpose(-3, -2).flatten(-3, -2)


def _refuse_bands(data: Tensor, radar: BistaticRadar, rebuild: Rebuild) -> None:
    if data.shape[-3] != radar.channels:
        raise ValueError(
            f"reconstruction expects {radar.channels} channels by the radar's channel_m, got data "
            f"with {data.shape[-3]}; select the channels of both"
        )
    why = rebuild.refusal(radar.channels)
    if why is not None:
        raise ValueError(why)


class Reconstruct(Stage):
    """Channels (channel, pulse[, range]) to the full Doppler band of points with the velocities
    given: axes (doppler[, range]), Doppler (Hz) against the centre.

    rebuild: LeastSquares(bands) or MinimumMeanSquare(...). range_m: closest range of the points,
    None for the radar's reference range. Values of forward (u_r_m_s, u_a_m_s, y0_m) are per trial,
    zero for a stationary scene. Refuses motions that make the channels of ALL trials sample the
    same places, and warns of poor ones.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)

    def __init__(self, radar: BistaticRadar, rebuild: Rebuild | None = None, range_m: float | None = None) -> None:
        super().__init__()
        if rebuild is not None and not hasattr(rebuild, "refusal"):
            raise TypeError(f"rebuild must be LeastSquares(bands) or MinimumMeanSquare(...), got {rebuild!r}")
        self.radar, self.rebuild, self.range_m = radar, rebuild or LeastSquares(), range_m
        why = self.rebuild.refusal(radar.channels)
        if why is not None:
            raise ValueError(why)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Signal:
        motion = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        mind_condition(self.radar, motion, self.rebuild, signal.data.dtype)
        refuse_shifted(self.radar, signal.axis("pulse"))
        n = signal.axis("pulse").n
        doppler = doppler_axis(self.radar, n, self.rebuild.bands)
        if "range" in signal.names:
            return Signal(
                reconstruct_lines(signal.data, self.radar, motion, self.rebuild), (doppler, signal.axis("range"))
            )
        return Signal(reconstruct(signal.data, self.radar, motion, self.rebuild), (doppler,))


def refuse_shifted(radar: BistaticRadar, pulse: Axis) -> None:
    """Raise ValueError unless slow time is zero at pulse n // 2 and pulses come at the radar's
    rate: phases are counted from there.
    """
    expected = radar.pulse_axis(pulse.n)
    if (
        abs(pulse.start - expected.start) > 1e-6 * expected.step
        or abs(pulse.step - expected.step) > 1e-9 * expected.step
    ):
        raise ValueError(
            f"slow time must be zero at pulse {pulse.n // 2} of {pulse.n}, in steps of 1 / "
            f"{radar.prf_hz:g} s, got a first pulse at {pulse.start:g} s in steps of "
            f"{pulse.step:g} s; "
            "crop the same number of pulses from both ends, and give the radar's prf_hz"
        )


def doppler_axis(radar: BistaticRadar, n_pulse: int, bands: int) -> Axis:
    """Of a rebuilt spectrum: Doppler (Hz) against the centre; remembers the slow time that it came
    from.
    """
    step = radar.prf_hz / n_pulse
    return Axis(
        "doppler",
        bands * n_pulse,
        first_bin(n_pulse, bands) * step,
        step,
        "Hz",
        dual_start=-(bands * n_pulse // 2) / (bands * radar.prf_hz),
    )


def mind_condition(radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, dtype: torch.dtype) -> None:
    """Refuse, naming what causes it, where an inverse is singular in all trials; warn where it is
    poor in some. A prior has no such limit.
    """
    if not isinstance(rebuild, LeastSquares):
        return
    found = condition_number(radar, motion, rebuild.bands)
    limit = SINGULAR if dtype == torch.complex128 else SINGULAR_SINGLE
    if bool((found > limit).all()):
        then = (
            f"so that {rebuild.bands} bands cannot be told apart; rebuild fewer bands, use "
            "MinimumMeanSquare, or change the pulse rate"
        )
        raise ValueError(_sentence(radar, motion, rebuild.bands, float(found.min()), then))
    if bool((found > POOR).any()):
        worst = float(found.max())
        warnings.warn(
            _sentence(
                radar,
                motion,
                rebuild.bands,
                worst,
                "so that noise and errors of the velocity grow; rebuild fewer bands, or use MinimumMeanSquare",
            ),
            stacklevel=3,
        )


def _sentence(radar: BistaticRadar, motion: PointMotion, bands: int, worst: float, then: str) -> str:
    found = condition_number(radar, motion, bands)
    speed = motion.effective_m_s.detach().expand(found.shape).flatten()[int(found.flatten().argmax())]
    where = f"at a pulse rate of {radar.prf_hz:g} Hz and a speed past the target of {float(speed):.4g} m/s"
    return f"{where} the channels sample nearly the same places (condition number {worst:.3g}), {then}"
