"""Range compression, and removal of the transmit range from the phase of every pulse.

Reference:
    Remote Sens. 2020, 12, 1703, Eqs. (8)-(14), (31). The transmit range is the same for all
    channels, so that its removal with the ephemeris is exact (`remove_transmit_range`). Eq. (31)
    leaves its linear term in the data (`AzimuthScaling`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsar.core import Signal, Stage, checked_samples, per_trial, unit_phasor
from torchsar.focus import range_compress
from torchsar.focus.reference import REFERENCES
from torchsar.multichannel.motion import Number, PointMotion
from torchsar.multichannel.response import ChannelStage, checked_channels
from torchsar.radar import BistaticRadar
from torchsar.radar.bistatic import polynomial_range


def remove_transmit_range(
    data: Tensor, time_s: Tensor, coefficients: Sequence[float | Tensor], wavelength_m: float, with_range: bool = True
) -> Tensor:
    """Remove the transmit range from the phase, so that the phase of the receive path remains.

    >>> import torch
    >>> from torchsar import multichannel
    >>> time_s = torch.arange(4, dtype=torch.float64) / 180.0
    >>> channels = torch.exp(-2j * torch.pi * 10.0 * time_s / 0.24).expand(3, 4)  # 10 m/s, 0.24 m
    >>> left = multichannel.remove_transmit_range(channels, time_s, [10.0], 0.24, with_range=False)
    >>> left[0].real.round(decimals=6)
    tensor([1., 1., 1., 1.], dtype=torch.float64)

    Data are multiplied by exp(+j 2 pi / lambda (R_T(t) - R_T(0))) where the change of the transmit
    range is R_T(t) - R_T(0) = k1 t + k2 t^2 + .... This is exact, since the transmit range is
    common to all channels. Envelopes are not shifted: the receive window follows the transmit
    range, so that their positions depend on the receive path alone. Differentiable in data and
    coefficients.

    Args:
        data: Channels, shape (..., channel, pulse, range), or (..., channel, pulse) if `with_range`
            is False, complex.
        time_s: Slow time in seconds, float64 (pulse,).
        coefficients: Coefficients k1, k2, ... in m/s, m/s^2, ...: numbers or tensors (...,).
        wavelength_m: Carrier wavelength in metres.
        with_range: Whether the data have a range axis.

    Returns:
        Data of the same shape.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if there is not one time per pulse.
    """
    data = checked_samples(data, "remove_transmit_range", "pulse, range" if with_range else "pulse", finite=False)
    pulses = data.shape[-2] if with_range else data.shape[-1]
    if time_s.shape[-1:] != (pulses,):
        raise ValueError(
            f"remove_transmit_range needs time_s with one value for each of the {pulses} pulses, but its "
            f"shape is {tuple(time_s.shape)}; check with_range={with_range}, which determines the pulse axis"
        )
    path_m = polynomial_range([per_trial(k, 1, data) for k in coefficients], time_s)
    phasor = unit_phasor(path_m / wavelength_m, data.dtype)[..., None, :]
    return data * (phasor[..., None] if with_range else phasor)


def neglected_transmit_phase_rad(radar: BistaticRadar, order: int, integration_s: float) -> float:
    """Bound the phase due to the powers of slow time above `order` in the transmit range.

    The bound is the sum of the magnitudes of these terms at the ends of the integration time.

    Args:
        radar: Radar parameters.
        order: Highest power that is removed.
        integration_s: Integration time centred on t = 0 in seconds.

    Returns:
        Upper bound of the magnitude of the phase in radians.
    """
    half = integration_s / 2
    return (
        2
        * math.pi
        / radar.wavelength_m
        * sum(abs(k) * half**power for power, k in enumerate(radar.transmit_range, 1) if power > order)
    )


class RemoveTransmitRange(ChannelStage):
    """Stage that removes the transmit range with the ephemeris coefficients of the radar.

    See `remove_transmit_range`. A warning is given where the coefficients from k2 on that `order`
    leaves out contribute a phase above 0.3 rad at the ends of the data. Two coefficients (k1 t and
    k2 t^2) are enough for a geosynchronous transmitter at L band and apertures below 20 s; all
    others contribute less than 0.03 rad.

    Args:
        radar: Radar parameters.
        order: Number of coefficients to use, None for all.

    Raises:
        ValueError: If `order` is negative.
    """

    def __init__(self, radar: BistaticRadar, order: int | None = None) -> None:
        super().__init__(radar)
        if order is not None and order < 0:
            raise ValueError(
                f"order must be 0 or more, the number of transmit-range coefficients to remove, got {order}"
            )
        self.order = len(radar.transmit_range) if order is None else order

    def forward(self, signal: Signal) -> Signal:
        """Remove the transmit range from the phase of channels (channel, pulse[, range])."""
        pulse = signal.axis("pulse")
        left = neglected_transmit_phase_rad(self.radar, max(self.order, 1), pulse.n * pulse.step)
        # limit in rad, well below the pi / 4 at which a quadratic phase broadens the response
        if left > 0.3:
            warnings.warn(
                f"the transmit range beyond order {self.order} contributes a phase of {left:.2g} rad at "
                f"the ends of the data; raise the order to {len(self.radar.transmit_range)}",
                stacklevel=3,
            )
        return signal.with_data(
            remove_transmit_range(
                signal.data,
                pulse.values(signal.data.device),
                self.radar.transmit_range[: self.order],
                self.radar.wavelength_m,
                "range" in signal.names,
            )
        )


class AzimuthScaling(ChannelStage):
    """Stage that removes all but the linear term of the transmit range by azimuth chirp scaling.

    Prefer `RemoveTransmitRange`, which is exact and removes the linear term k1 t as well.

    >>> import torch
    >>> from torchsar.core import Signal
    >>> from torchsar.multichannel import AzimuthScaling
    >>> from torchsar.radar import BistaticRadar, LinearFM
    >>> radar = BistaticRadar(1.25e9, LinearFM(50e6, 10e-6), 60e6, 180.0, 300.0, 5000.0,
    ...     transmit_range=(0.1, 0.5))  # 0.1 m/s and 0.5 m/s^2
    >>> time_s = radar.pulse_axis(91).values()
    >>> turns = -(0.1 * time_s + 0.5 * time_s**2) / radar.wavelength_m
    >>> channels = Signal(torch.exp(2j * torch.pi * turns).expand(3, 91), radar.axes(91))
    >>> channels.data[1, ::45].angle().round(decimals=2)  # first, middle and last pulse
    tensor([-0.1600,  0.0000, -1.4700], dtype=torch.float64)
    >>> AzimuthScaling(radar)(channels).data[1, ::45].angle().round(decimals=2)  # k1 t remains
    tensor([ 0.6500,  0.0000, -0.6500], dtype=torch.float64)

    With the transmit range k1 t + k2 t^2 + ... over slow time t, data of channel m at the
    along-track position dx_m are multiplied by exp(j pi (q2 t'^2 + q3 t'^3 + q4 t'^4)), where t' =
    t - dx_m / v_e, v_e is the relative sensor velocity of Eq. (25), and q_i = 2 k_i / lambda. The
    shift dx_m / v_e leaves a phase error 4 pi k2 t dx_m / (lambda v_e), at most 0.006 rad at the
    ends of an aperture of 4.5 s in the geometry of the reference.

    The term k1 t remains in the data and moves the Doppler centre to (u_r - k1) / lambda for the
    slant-range speed u_r. `reconstruct(..., left_k1_m_s=k1)` takes it into account. Differentiable.

    Args:
        radar: Radar parameters.
        order: Highest power of slow time in the transmit range that is removed, 2 to 4.

    Raises:
        ValueError: If `order` lies outside 2 to 4.

    Reference:
        Remote Sens. 2020, 12, 1703, Eqs. (25), (31), (34).
    """

    def __init__(self, radar: BistaticRadar, order: int = 4) -> None:
        super().__init__(radar)
        if not 2 <= order <= 4:
            raise ValueError(
                "order must be 2, 3 or 4, since azimuth scaling removes orders 2 to 4 of the transmit range, "
                f"got {order}"
            )
        self.order = order

    def forward(self, signal: Signal, u_r_m_s: Number = 0.0, u_a_m_s: Number = 0.0) -> Signal:
        """Remove the transmit range, except its linear term, for the motion of each trial.

        Args:
            signal: Channels with the axes (channel, pulse[, range]).
            u_r_m_s: Slant-range speed in m/s, closing positive, shape (...,) or a number.
            u_a_m_s: Along-track speed in m/s, positive in the flight direction of the receiver,
                same shape.

        Returns:
            Channels on the same axes.

        Raises:
            ValueError: If the channels are not those of the radar.
        """
        data = checked_channels(signal.data, self.radar, "AzimuthScaling", ", ".join(signal.names), finite=False)
        motion = PointMotion.of(self.radar, data, u_r_m_s, u_a_m_s)
        delay = self.radar.channels_at(data.device) / motion.effective_m_s[..., None]
        time_s = signal.axis("pulse").values(data.device) - delay[..., None]
        path_m = polynomial_range((0.0, *self.radar.transmit_range[1 : self.order]), time_s)
        phasor = unit_phasor(path_m / self.radar.wavelength_m, data.dtype)
        return signal.with_data(data * (phasor[..., None] if "range" in signal.names else phasor))


class CompressChannels(Stage):
    """Range compression with the transmitted pulse; a unit echo has a unit peak at its range.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [0], [0]), scene.BandLimited(1.0))
    >>> recording, _ = echo.simulate_bistatic(receiver, world, 4, 2048, Draws(seed=1), kind="full")
    >>> channels = multichannel.CompressChannels(receiver)(recording.signal)
    >>> channels.data.abs().argmax(-1)[0]  # sample n // 2 lies at the reference range
    tensor([1024, 1024, 1024, 1024])

    An echo whose pulse is cut by an end of the range line is compressed with the samples that
    remain.

    Args:
        radar: Radar parameters.
        reference: Reference spectrum "matched", "flat" or "phase", see `focus.RangeCompress`.
            "flat" gives an exactly rectangular band and thus the response of data that are
            simulated directly in range-compressed form.

    Raises:
        ValueError: If `reference` is unknown.
    """

    works_on = ("channel", "pulse", "range")

    def __init__(self, radar: BistaticRadar, reference: str = "matched") -> None:
        super().__init__()
        if reference not in REFERENCES:
            raise ValueError(f"range reference {reference!r} is unknown; choose one of {sorted(REFERENCES)}")
        self.radar, self.reference = radar, reference

    def spectrum(self, n: int, device: torch.device | str | None = None) -> Tensor:
        """Return the reference spectrum of compression for lines of n samples, complex128 (n,)."""
        return REFERENCES[self.reference](self.radar.pulse, n, self.radar.sampling_hz, device)

    def forward(self, signal: Signal) -> Signal:
        """Compress full chirps (channel, pulse, range) in range; the axes stay the same."""
        return signal.with_data(range_compress(signal.data, self.spectrum(signal.data.shape[-1], signal.data.device)))
