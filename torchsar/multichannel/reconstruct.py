"""Azimuth reconstruction: from the aliased spectra of several channels to the full Doppler band.

Data are demodulated by the Doppler centre of the assumed motion. The reconstructed bands are
therefore centred on it to a fraction of a bin, and the result is a smooth function of the
velocities.

Reference:
    Remote Sens. 2020, 12, 1703, Eqs. (34)-(36).
"""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchsar.core import Axis, Signal, Stage, checked_samples, fft_lines, host_largest, host_value, linear_phasor
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
    """Reconstruct the full-band Doppler spectrum of points with a given motion.

    Differentiable in data and motion.

    Args:
        data: Channels with slow time zero at pulse n // 2, shape (..., channel, pulse), complex.
            The transmit range has been removed from the phase, except for a linear term where
            `left_k1_m_s` is given.
        radar: Radar parameters.
        motion: Motion of the points, shape (...,).
        rebuild: Reconstruction method.
        left_k1_m_s: Rate k1 in m/s of the linear term k1 t of the transmit range, if this term is
            still in the phase; 0 if it was removed.

    Returns:
        Spectrum about the Doppler centre of the motion, shape (..., bands * pulse), complex. Bins
        rise in Doppler from `first_bin(pulse, bands)`, phases refer to slow time zero, and the
        scale is that of the FFT of bands * pulse samples of a single channel.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the data do not have the channels of the radar,
            or there are too few channels for the bands.
    """
    data = checked_samples(data, "reconstruct", "channel, pulse", finite=False)
    return reconstruct_lines(data[..., None], radar, motion, rebuild, left_k1_m_s)[..., 0]


def reconstruct_lines(
    data: Tensor, radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, left_k1_m_s: float = 0.0
) -> Tensor:
    """Reconstruct the full-band Doppler spectra of range lines that share one motion.

    This is `reconstruct` for data with a range axis.

    Args:
        data: Channels with slow time zero at pulse n // 2, shape (..., channel, pulse, range),
            complex. The transmit range has been removed from the phase, except for a linear term
            where `left_k1_m_s` is given.
        radar: Radar parameters.
        motion: Motion of the points, shape (...,).
        rebuild: Reconstruction method.
        left_k1_m_s: Rate k1 in m/s of the linear term k1 t of the transmit range, if this term is
            still in the phase; 0 if it was removed.

    Returns:
        Spectra about the Doppler centre of the motion, shape (..., bands * pulse, range), complex.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the data do not have the channels of the radar,
            or there are too few channels for the bands.
    """
    data = checked_samples(data, "reconstruct_lines", "channel, pulse, range", finite=False)
    if data.shape[-3] != radar.channels:
        raise ValueError(
            f"reconstruction expects {radar.channels} channels as in the radar's channel_m, got data "
            f"with {data.shape[-3]}; select the same channels in radar and data"
        )
    refuse_channels(radar, rebuild)
    n, dtype = data.shape[-2], data.dtype
    # the FFT of the demodulated data begins with the lowest bin of the lowest band
    turns = -doppler_centre_hz(radar, motion, left_k1_m_s) / radar.prf_hz - first_bin(n, rebuild.bands) % n / n
    spectrum = fft_lines(data * linear_phasor(turns, -(n // 2), n, dtype)[..., None, :, None])
    # pulse 0 was sampled n // 2 pulses before slow time zero
    late = linear_phasor(torch.tensor(n // 2 / n, dtype=torch.float64, device=data.device), 0.0, n, dtype)
    spectrum = (
        spectrum * (shared_response(radar, motion, n, rebuild.bands, dtype, left_k1_m_s).conj() * late)[..., None]
    )
    weights = rebuild.weights(radar, motion, n).to(dtype) * rebuild.bands
    if weights.ndim == motion.trial_dims + 2:
        return (weights @ spectrum.flatten(-2)).unflatten(-1, spectrum.shape[-2:]).flatten(-3, -2)
    return (weights @ spectrum.transpose(-3, -2)).transpose(-3, -2).flatten(-3, -2)


def refuse_channels(radar: BistaticRadar, rebuild: Rebuild) -> None:
    """Raise ValueError if the radar has too few channels for a reconstruction.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction method.
    """
    why = rebuild.refusal(radar.channels)
    if why is not None:
        raise ValueError(why)


class Reconstruct(Stage):
    """Stage that reconstructs the full Doppler band of points with given velocities.

    The input has the axes (channel, pulse[, range]), the output the axes (doppler[, range]) with
    Doppler in Hz relative to the Doppler centre of the points.

    Args:
        radar: Radar parameters.
        rebuild: `LeastSquares(bands)` (default) or `MinimumMeanSquare(...)`.
        range_m: Closest range of the points in metres, None for the reference range of the radar.

    Raises:
        TypeError: If `rebuild` is no reconstruction method.
        ValueError: If there are too few channels for the bands.
    """

    works_on = ("channel", "pulse")
    also_on = (("channel", "pulse", "range"),)
    takes_empty = False

    def __init__(self, radar: BistaticRadar, rebuild: Rebuild | None = None, range_m: float | None = None) -> None:
        super().__init__()
        if rebuild is not None and not hasattr(rebuild, "refusal"):
            raise TypeError(f"rebuild must be LeastSquares(bands) or MinimumMeanSquare(...), got {rebuild!r}")
        self.radar, self.rebuild, self.range_m = radar, rebuild or LeastSquares(), range_m
        refuse_channels(radar, self.rebuild)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Signal:
        """Reconstruct the full Doppler band with the velocities of each trial.

        Velocities of zero suit a stationary scene.

        A warning is given where the reconstruction is ill-conditioned.

        Args:
            signal: Channels with the axes (channel, pulse[, range]) and the transmit range removed
                from the phase.
            u_r_m_s: Slant-range speed in m/s, closing positive, shape (...,) or a number.
            u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver,
                same shape.
            y0_m: Along-track position at t = 0 in metres, same shape.

        Returns:
            Spectrum with the axes (doppler[, range]).

        Raises:
            ValueError: If the least-squares matrix is singular in all trials, or slow time is not
                zero at pulse n // 2.
        """
        motion = PointMotion.of(self.radar, signal.data, u_r_m_s, u_a_m_s, y0_m, self.range_m)
        check_condition(self.radar, motion, self.rebuild, signal.data.dtype)
        refuse_shifted(self.radar, signal.axis("pulse"))
        doppler = doppler_axis(self.radar, signal.axis("pulse").n, self.rebuild.bands)
        made = reconstruct_lines if "range" in signal.names else reconstruct
        return Signal(made(signal.data, self.radar, motion, self.rebuild), (doppler, *signal.axes[2:]))


def refuse_shifted(radar: BistaticRadar, pulse: Axis) -> None:
    """Raise ValueError unless slow time is zero at pulse n // 2 and pulses come at the radar's PRF.

    Reconstruction and focusing count phases from slow time zero.

    Args:
        radar: Radar parameters.
        pulse: Slow-time axis of the data.
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
            "if pulses were cropped, crop as many from the other end; otherwise check prf_hz of the radar"
        )


def doppler_axis(radar: BistaticRadar, n_pulse: int, bands: int) -> Axis:
    """Return the Doppler axis of a reconstructed spectrum in Hz relative to the Doppler centre.

    Args:
        radar: Radar parameters.
        n_pulse: Number of pulses.
        bands: Number of reconstructed bands.

    Returns:
        The axis, which also stores the slow time of the data.
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


def check_condition(radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, dtype: torch.dtype) -> None:
    """Check the condition number of a least-squares reconstruction.

    A warning is given where it exceeds 5 in some trials. `MinimumMeanSquare` has no such limit.

    Args:
        radar: Radar parameters.
        motion: Motion of the points, shape (...,).
        rebuild: Reconstruction method.
        dtype: Dtype of the data.

    Raises:
        ValueError: If the condition number exceeds 1e6 (1e4 in complex64) in all trials. The
            message states the pulse rate and the speed of the receiver past the target.
    """
    if not isinstance(rebuild, LeastSquares):
        return
    found = condition_number(radar, motion, rebuild.bands)
    limit = SINGULAR if dtype == torch.complex128 else SINGULAR_SINGLE
    singular, worst = host_value((found > limit).all(), False), host_largest(found, 0.0)
    if not singular and not worst > POOR:
        return
    speed = motion.effective_m_s.detach().expand(found.shape).flatten()[int(found.flatten().argmax())]
    seen = (
        f"at a pulse rate of {radar.prf_hz:g} Hz and a speed past the target of {float(speed):.4g} m/s the channels "
        f"sample nearly the same positions (condition number {float(found.min()) if singular else worst:.3g}), so that"
    )
    if singular:
        raise ValueError(
            f"{seen} {rebuild.bands} bands cannot be separated; rebuild fewer bands, use MinimumMeanSquare, or change "
            "the pulse rate"
        )
    then = "noise and errors of the velocity grow; rebuild fewer bands, or use MinimumMeanSquare"
    warnings.warn(f"{seen} {then}", stacklevel=3)
