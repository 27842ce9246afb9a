"""Azimuth reconstruction: from the aliased spectra of several channels to the full Doppler band.

One channel samples at the pulse rate, so that its spectrum at each alias frequency is a sum over
Doppler bands one PRF apart. Up to a constant phase, channel m at the along-track position dx_m is
the reference channel delayed by dx_m / v_e, with the relative sensor velocity v_e of Eq. (25). Its
response to band b has the factor exp(-j 2 pi b PRF dx_m / v_e), which differs between channels and
allows the bands to be separated.

Data are demodulated by the Doppler centre of the assumed motion. The reconstructed bands are
therefore centred on it to a fraction of a bin, and the result is a smooth function of the
velocities.

Reference:
    Remote Sens. 2020, 12, 1703, Eqs. (25), (26), (34)-(36). The constant phase is that of Eq. (34);
    the printed Eq. (27) has wrong signs.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchsar.core import (
    Axis,
    Signal,
    differentiable,
    fft_lines,
    host_largest,
    host_value,
    linear_phasor,
    linear_solve,
)
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import (
    ChannelStage,
    ElementPattern,
    FlatBand,
    Prior,
    band_matrix,
    checked_channels,
    doppler_centre_hz,
    doppler_offsets,
    first_bin,
    refuse_shifted,
    shared_response,
)
from torchsar.radar import BistaticRadar

# Condition number above which a warning is given, by choice: the noise gain of three bands of
# three channels is then 6.5 dB.
POOR = 5.0


def _check_bands(bands: int) -> None:
    """Raise ValueError unless the number of bands is a whole number of at least one."""
    if not (isinstance(bands, int) and bands >= 1):
        raise ValueError(f"a reconstruction needs a whole number of Doppler bands, at least one, got bands={bands}")


@dataclass(frozen=True)
class LeastSquares:
    """Reconstruction of Doppler bands by the pseudo-inverse of the channel responses.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> methods = multichannel.LeastSquares(2), multichannel.LeastSquares(3)  # bands
    >>> [round(multichannel.noise_gain_db(receiver, still, method).item(), 1) for method in methods]
    [0.5, 12.2]

    This is Eq. (36) for any number of channels. The pseudo-inverse is the inverse where there are
    as many bands as channels. Singular values below 1e-6 of the largest are damped, so that the
    weights stay finite where two channels sample the same positions. Prefer two bands for three
    channels: three bands amplify noise strongly near PRFs at which channels sample the same
    positions.

    Args:
        bands: Number of Doppler bands, at most the number of channels.

    Raises:
        ValueError: If `bands` is not a whole number of at least one.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (35), (36).
    """

    bands: int = 2

    def __post_init__(self) -> None:
        _check_bands(self.bands)

    def weights(self, radar: BistaticRadar, motion: PointMotion, n_pulse: int) -> Tensor:
        """Return the weights from channels to Doppler bands, complex128 (..., band, channel).

        They are the same for all Doppler bins of a band.
        """
        matrix = band_matrix(radar, motion, self.bands)
        normal = matrix.mH @ matrix
        # the floor acts on singular values below 1e-6 of the largest one
        floor = 1e-12 * self.bands * radar.channels
        return linear_solve(normal + floor * torch.eye(self.bands, dtype=normal.dtype, device=normal.device), matrix.mH)


@dataclass(frozen=True)
class MinimumMeanSquare:
    """Reconstruction of Doppler bands with least mean square error, for an expected power.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> still = multichannel.PointMotion.of(receiver, torch.zeros(()))
    >>> methods = multichannel.LeastSquares(3), multichannel.MinimumMeanSquare(3, snr_db=10.0)
    >>> [round(multichannel.noise_gain_db(receiver, still, method).item(), 1) for method in methods]
    [12.2, 0.3]

    The weights are A G^H (G A G^H + I / snr)^-1, with the channel responses G to the bands, the
    diagonal matrix A of the expected powers of the bands relative to the peak, and the power ratio
    snr of this peak to the noise. There may be more bands than channels.

    Args:
        bands: Number of Doppler bands.
        snr_db: Strongest expected power over the noise of a sample in dB.
        prior: Expected power over Doppler.

    Raises:
        ValueError: If `bands` is not a whole number of at least one, or `snr_db` lies outside +-120
            dB.
    """

    bands: int = 5
    snr_db: float = 40.0
    prior: Prior = ElementPattern()  # noqa: RUF009  # it is frozen

    def __post_init__(self) -> None:
        _check_bands(self.bands)
        if not abs(self.snr_db) <= 120:
            raise ValueError(
                f"snr_db of a least-mean-square reconstruction must lie within +-120 dB, got {self.snr_db}"
            )

    def weights(self, radar: BistaticRadar, motion: PointMotion, n_pulse: int) -> Tensor:
        """Return the weights from channels to Doppler bands for each Doppler bin of a band.

        The shape is (..., n_pulse, band, channel), complex128.
        """
        offset = doppler_offsets(n_pulse, self.bands, radar.prf_hz, motion.u_r_m_s.device).view(self.bands, n_pulse).T
        matrix = band_matrix(radar, motion, self.bands)[..., None, :, :]
        weighted = matrix * self.prior.power(offset, radar, motion)[..., None, :].to(matrix.dtype)
        noise = 10 ** (-self.snr_db / 10) * torch.eye(radar.channels, dtype=matrix.dtype, device=matrix.device)
        return linear_solve(weighted @ matrix.mH + noise, weighted).mH


# reconstruction method: the number of Doppler bands, and the weights that separate them
Rebuild = LeastSquares | MinimumMeanSquare


def noise_and_clutter(radar: BistaticRadar, lit_s: float | None, n_pulse: int, power_db: Tensor | float) -> Tensor:
    """Return the covariance across channels of white noise of unit variance and stationary clutter.

    Args:
        radar: Radar parameters.
        lit_s: Time in seconds for which clutter is lit with constant amplitude; None for the
            pattern of a channel.
        n_pulse: Number of pulses.
        power_db: Power of the clutter over the noise in dB, a number or shape (...,).

    Returns:
        Covariance per bin of the unitary FFT over the pulses, FFT order, complex128 (..., n_pulse,
        channel, channel).
    """
    band = None if lit_s is None else radar.speed_m_s**2 * lit_s / (radar.wavelength_m * radar.reference_range_m)
    # an antenna pattern has clutter in five bands
    prior, bands = ElementPattern() if band is None else FlatBand(band), 5
    motion = PointMotion.of(radar, torch.zeros((), dtype=torch.float64))
    power = prior.power(doppler_offsets(n_pulse, bands, radar.prf_hz).view(bands, n_pulse).T, radar, motion)
    shared = shared_response(radar, motion, n_pulse, bands, torch.complex128).T[..., None]
    response = shared * band_matrix(radar, motion, bands)
    clutter = torch.roll((response * power[:, None, :]) @ response.mH, first_bin(n_pulse, bands), 0)
    level = 10 ** (torch.as_tensor(power_db, dtype=torch.float64) / 10)
    mean = clutter.diagonal(dim1=-2, dim2=-1).real.mean()
    return clutter * (level[..., None, None, None] / mean) + torch.eye(radar.channels, dtype=clutter.dtype)


def largest_condition(dtype: torch.dtype) -> float:
    """Return the largest condition number of an inverse, by convention.

    An inverse in float64 may lose six of its sixteen digits, one in complex64 four of its seven.

    Args:
        dtype: Complex dtype of the data.

    Returns:
        1e6 or 1e4.
    """
    return 1e6 if dtype == torch.complex128 else 1e4


@differentiable("no")
def condition_number(radar: BistaticRadar, motion: PointMotion, bands: int) -> Tensor:
    """Return the condition number of the matrix of channel responses to the Doppler bands.

    >>> import torch
    >>> from torchsar.multichannel import PointMotion, condition_number
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> round(condition_number(radar, PointMotion.of(radar, torch.zeros(())), 3).item(), 1)
    10.2

    It is the ratio of the largest to the least singular value of the responses, infinite where the
    matrix is singular or has more bands than channels. Not differentiable.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        bands: Number of bands.

    Returns:
        Condition number, float64 (...,).
    """
    values = torch.linalg.svdvals(band_matrix(radar, motion, bands).detach())
    least, most = values[..., -1] if bands <= radar.channels else 0 * values[..., 0], values[..., 0]
    return torch.where(least > 1e-13 * most, most / least.clamp_min(torch.finfo(least.dtype).tiny), math.inf)


def noise_gain_db(radar: BistaticRadar, motion: PointMotion, rebuild: Rebuild, n_pulse: int = 64) -> Tensor:
    """Return the noise gain of a reconstruction relative to ideal uniform sampling.

    >>> import torch
    >>> from torchsar import multichannel, radar
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> motion = multichannel.PointMotion.of(receiver, torch.zeros(()), u_r_m_s=3.0)
    >>> round(multichannel.noise_gain_db(receiver, motion, multichannel.LeastSquares(2)).item(), 1)
    0.5

    It is the mean noise power of the reconstructed Doppler bins divided by the noise power that
    uniform sampling with the same number of channels would give: M / N trace(W W^H) for the weights
    W from M channels to N bands. It is infinite where the matrix of a least-squares reconstruction
    is singular: the weights are damped and finite there, but do not separate the bands.

    Args:
        radar: Radar parameters.
        motion: Motion of the point, shape (...,).
        rebuild: Reconstruction method.
        n_pulse: Number of pulses, for weights that differ between bins.

    Returns:
        Noise gain in dB, shape (...,).
    """
    weights = rebuild.weights(radar, motion, n_pulse)
    power = weights.abs().square().sum((-2, -1)) * (radar.channels / rebuild.bands)
    gain = 10 * torch.log10(power.mean(-1) if power.ndim > motion.trial_dims else power)
    if not isinstance(rebuild, LeastSquares):
        return gain
    limit = largest_condition(torch.complex128)
    return torch.where(condition_number(radar, motion, rebuild.bands) > limit, torch.inf, gain)


def reconstruct(
    data: Tensor,
    radar: BistaticRadar,
    motion: PointMotion,
    rebuild: Rebuild,
    left_k1_m_s: float = 0.0,
    *,
    with_range: bool = False,
) -> Tensor:
    """Reconstruct the full-band Doppler spectrum of points with a given motion.

    >>> import torch
    >>> from torchsar.multichannel import LeastSquares, PointMotion, reconstruct
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0)
    >>> data = torch.ones(3, 90, dtype=torch.complex64)
    >>> reconstruct(data, radar, PointMotion.of(radar, data.real), LeastSquares(2)).shape
    torch.Size([180])

    Differentiable in data and motion.

    Args:
        data: Channels with slow time zero at pulse n // 2, shape (..., channel, pulse), or (...,
            channel, pulse, range) if `with_range`, complex. The transmit range has been removed
            from the phase, except for a linear term where `left_k1_m_s` is given.
        radar: Radar parameters.
        motion: Motion of the points, shape (...,), which all range lines share.
        rebuild: Reconstruction method.
        left_k1_m_s: Rate k1 in m/s of the linear term k1 t of the transmit range, if this term is
            still in the phase; 0 if it was removed.
        with_range: Whether the data have a range axis.

    Returns:
        Spectrum about the Doppler centre of the motion, shape (..., bands * pulse[, range]),
        complex. Bins rise in Doppler from `first_bin(pulse, bands)`, phases refer to slow time
        zero, and the scale is that of the FFT of bands * pulse samples of a single channel.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if the data do not have the channels of the radar,
            or there are too few channels for the bands.
    """
    dims = "channel, pulse, range" if with_range else "channel, pulse"
    data = checked_channels(data, radar, "reconstruct", dims, finite=False)
    refuse_channels(radar, rebuild)
    if not with_range:
        data = data[..., None]
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
        made = (weights @ spectrum.flatten(-2)).unflatten(-1, spectrum.shape[-2:]).flatten(-3, -2)
    else:
        made = (weights @ spectrum.transpose(-3, -2)).transpose(-3, -2).flatten(-3, -2)
    return made if with_range else made[..., 0]


def separates(rebuild: Rebuild, channels: int) -> bool:
    """Test whether a reconstruction works with this number of channels.

    A prior lets any number of channels separate the bands.

    Args:
        rebuild: Reconstruction method.
        channels: Number of channels.

    Returns:
        False for more bands than channels without a prior.
    """
    return not isinstance(rebuild, LeastSquares) or rebuild.bands <= channels


def refuse_channels(radar: BistaticRadar, rebuild: Rebuild) -> None:
    """Raise ValueError if the radar has too few channels for a reconstruction.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction method.
    """
    if not separates(rebuild, radar.channels):
        raise ValueError(
            f"{rebuild.bands} Doppler bands cannot be separated by {radar.channels} "
            f"channel{'s' if radar.channels > 1 else ''}; rebuild at most {radar.channels}, or give a prior "
            "(MinimumMeanSquare)"
        )


class Reconstruct(ChannelStage):
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

    takes_empty = False

    def __init__(self, radar: BistaticRadar, rebuild: Rebuild | None = None, range_m: float | None = None) -> None:
        super().__init__(radar)
        if rebuild is not None and not hasattr(rebuild, "weights"):
            raise TypeError(f"rebuild must be LeastSquares(bands) or MinimumMeanSquare(...), got {rebuild!r}")
        self.rebuild, self.range_m = rebuild or LeastSquares(), range_m
        refuse_channels(radar, self.rebuild)

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0, y0_m: Number = 0.0) -> Signal:
        """Reconstruct the full Doppler band with the velocities of each trial.

        Velocities of zero suit a stationary scene. A warning is given where the reconstruction is
        ill-conditioned.

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
        made = reconstruct(signal.data, self.radar, motion, self.rebuild, with_range="range" in signal.names)
        return Signal(made, (doppler, *signal.axes[2:]))


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
    found = condition_number(radar, motion.each(Tensor.detach), rebuild.bands)
    limit = largest_condition(dtype)
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
