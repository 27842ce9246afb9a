"""Conventional imaging of the stationary scene from all channels over the whole swath.

The transmit range has been removed from the data, so that only the receive path remains. Consider
the channel at the along-track position dx_m. For a stationary point, its data are those of a
channel at position 0, delayed by dx_m / V_R in slow time, where V_R is the speed of the receiver.
This holds exactly, at every range frequency. The full Doppler band can therefore be reconstructed
with zero target velocity before any migration is corrected.

The reconstructed data are those of an unaliased stripmap. Waves travel the receive path only once.
A monostatic radar, whose waves travel it twice, has the same phases if the waves are twice as fast.
The monostatic omega-K algorithm with twice the wave speed therefore applies unchanged.

Reference:
    Remote Sens. 2020, 12, 1703, Figs. 6 and 7 (conventional processing) and section 4.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torch import Tensor

from torchsar.core import Axis, Signal, Stage, centred_ifft, checked_samples
from torchsar.focus import omega_k, omega_k_stolt
from torchsar.focus.requirements import Aperture, Limit, phase_error_db
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import (
    LeastSquares,
    Rebuild,
    check_condition,
    reconstruct,
    refuse_channels,
    refuse_shifted,
)
from torchsar.radar import BistaticRadar, StripmapRadar

FORMS: dict[str, Callable[..., Tensor]] = {"bulk": omega_k, "stolt": omega_k_stolt}


def two_way_radar(radar: BistaticRadar, bands: int, near_range_m: float) -> StripmapRadar:
    """Return a monostatic stripmap radar with the phases of the receive path.

    Its waves travel the path twice, at twice the wave speed.

    Args:
        radar: Radar parameters.
        bands: Number of reconstructed Doppler bands; the PRF of the result is bands * PRF.
        near_range_m: Range of the first sample in metres.

    Returns:
        A radar that looks broadside.
    """
    return StripmapRadar(
        carrier_hz=radar.carrier_hz,
        pulse=radar.pulse,
        sampling_hz=radar.sampling_hz,
        prf_hz=bands * radar.prf_hz,
        velocity_m_s=radar.speed_m_s,
        near_range_m=near_range_m,
        pointing_doppler_hz=0.0,
        wave_speed_m_s=2 * radar.wave_speed_m_s,
    )


def stationary_image(
    data: Tensor,
    radar: BistaticRadar,
    near_range_m: float,
    rebuild: Rebuild | None = None,
    form: str = "stolt",
    band_hz: float | None = None,
) -> Tensor:
    """Image the stationary scene from range-compressed channels.

    The image is as long as the record and wraps around in azimuth. A point of amplitude 1 and
    closest range R0 that is illuminated for T seconds has a peak of T sqrt(V_R^2 / (lambda R0)) and
    the phase -2 pi (R0 - R_ref) / lambda, with the speed V_R of the receiver and the reference
    range R_ref of the radar. A moving point of slant-range speed u_r and along-track speed u_a
    appears displaced by V_R u_r R0 / V^2 in azimuth, where V^2 = (V_R - u_a)^2 + u_r^2. It is
    defocused and accompanied by false targets. Differentiable in the data.

    Args:
        data: Range-compressed channels with the transmit range removed, shape (..., channel, pulse,
            range), complex.
        radar: Radar parameters.
        near_range_m: Range of the first sample in metres.
        rebuild: Reconstruction method, `LeastSquares(2)` by default.
        form: "stolt", exact at every range, or "bulk", with the migration of mid-swath for all
            ranges.
        band_hz: Processed Doppler bandwidth about zero in Hz, None for the whole reconstructed
            band of rebuild.bands * PRF.

    Returns:
        Image (..., azimuth, range), complex. Azimuth is x = V_R t with the slow time t, range is
        the closest range R0.

    Raises:
        TypeError: If the samples are not complex64 or complex128.
        ValueError: If there are no samples, or if `form` is unknown, the data do not have the
            channels of the radar, or there are fewer channels than the reconstruction needs.
    """
    data = checked_samples(data, "stationary_image", "channel, pulse, range", finite=False)
    rebuild = LeastSquares() if rebuild is None else rebuild
    spectrum = reconstruct(data, radar, PointMotion.of(radar, data.real), rebuild, with_range=True)
    return focus_stationary(spectrum, radar, near_range_m, rebuild.bands, form, band_hz)


def focus_stationary(
    spectrum: Tensor,
    radar: BistaticRadar,
    near_range_m: float,
    bands: int,
    form: str = "stolt",
    band_hz: float | None = None,
) -> Tensor:
    """Focus reconstructed Doppler spectra to an image of the stationary scene.

    This is the second half of `stationary_image`.

    Args:
        spectrum: Spectra of range lines in rising order of Doppler, zero Doppler at bin n // 2 of
            n = bands * pulse, shape (..., bands * pulse, range), complex.
        radar: Radar parameters.
        near_range_m: Range of the first sample in metres.
        bands: Number of reconstructed Doppler bands.
        form: "stolt" or "bulk", see `stationary_image`.
        band_hz: Processed Doppler bandwidth about zero in Hz, None for the whole reconstructed
            band.

    Returns:
        Image (..., azimuth, range), complex.

    Raises:
        ValueError: If `form` is unknown.
    """
    if form not in FORMS:
        raise ValueError(f"form of a stationary image must be one of {sorted(FORMS)}, got {form!r}")
    return FORMS[form](
        centred_ifft(spectrum, dim=-2), two_way_radar(radar, bands, near_range_m), doppler_hz=0.0, band_hz=band_hz
    )


class StationaryImage(Stage):
    """Stage that forms the conventional image of range-compressed channels; see `stationary_image`.

    >>> from torchsar import Draws, echo, multichannel, radar, scene
    >>> receiver = radar.BistaticRadar(1.25e9, radar.LinearFM(50e6, 10e-6), 60e6, 180, 300, 5000)
    >>> world = scene.BistaticWorld(scene.MovingPoints([0], [0], [30], [0]), scene.BandLimited(1.0))
    >>> channels = echo.simulate_bistatic(receiver, world, 360, 32, Draws(seed=1))[0].signal
    >>> image = multichannel.StationaryImage(receiver)(channels)
    >>> image.axis("azimuth").values()[image.data[:, 16].abs().argmax()].round().item()
    30.0

    The input has the axes (channel, pulse, range), the output the axes (azimuth, range) in metres.

    Args:
        radar: Radar parameters.
        rebuild: Reconstruction method, `LeastSquares(2)` by default.
        form: "stolt", exact at every range, or "bulk", with the migration of mid-swath for all
            ranges.
        band_hz: Processed Doppler bandwidth about zero in Hz, None for the whole reconstructed
            band of rebuild.bands * PRF.

    Raises:
        ValueError: If there are fewer channels than the reconstruction needs.
    """

    works_on = ("channel", "pulse", "range")

    def __init__(
        self, radar: BistaticRadar, rebuild: Rebuild | None = None, form: str = "stolt", band_hz: float | None = None
    ) -> None:
        super().__init__()
        self.radar, self.rebuild, self.form, self.band_hz = radar, rebuild or LeastSquares(), form, band_hz
        refuse_channels(radar, self.rebuild)

    def forward(self, signal: Signal) -> Signal:
        """Image the stationary scene from channels with the axes (channel, pulse, range).

        Returns:
            Image with the axes (azimuth, range) in metres.

        Raises:
            ValueError: If slow time is not zero at pulse n // 2, the pulse rate makes the
                reconstruction singular, or `form` is unknown.
        """
        refuse_shifted(self.radar, signal.axis("pulse"))
        still = PointMotion.of(self.radar, signal.data.real)
        check_condition(self.radar, still, self.rebuild, signal.data.dtype)
        return self.focused(reconstruct(signal.data, self.radar, still, self.rebuild, with_range=True), signal)

    def focused(self, spectrum: Tensor, signal: Signal) -> Signal:
        """Focus a Doppler spectrum that was reconstructed from `signal` by any method.

        Args:
            spectrum: Spectrum as in `focus_stationary`, shape (..., doppler, range), complex.
            signal: Channels from which the spectrum was reconstructed; their axes give those of the
                image.

        Returns:
            Image with the axes (azimuth, range) in metres.
        """
        _, pulse, range_ = signal.axes
        image = focus_stationary(spectrum, self.radar, range_.start, self.rebuild.bands, self.form, self.band_hz)
        return Signal(image, (stationary_axis(self.radar, pulse, self.rebuild.bands), range_))


def stationary_axis(radar: BistaticRadar, pulse: Axis, bands: int) -> Axis:
    """Return the azimuth axis x = V_R t in metres of the image, zero at sample n // 2 of n.

    V_R is the speed of the receiver and t the slow time.

    Args:
        radar: Radar parameters.
        pulse: Slow-time axis of the data.
        bands: Number of reconstructed Doppler bands; the image has bands * pulse samples.

    Returns:
        Azimuth axis of the image.
    """
    n = bands * pulse.n
    step = radar.speed_m_s / (bands * radar.prf_hz)
    return Axis("azimuth", n, -(n // 2) * step, step, "m")


def bulk_error_db(radar: BistaticRadar, bands: int, half_swath_m: float, integration_s: float) -> float:
    """Predict the error of a "bulk" image at the edge of the swath, for a point at rest.

    The form "bulk" of `stationary_image` corrects the migration of mid-swath at all ranges.

    Args:
        radar: Radar parameters.
        bands: Number of reconstructed Doppler bands.
        half_swath_m: Half width of the swath in metres.
        integration_s: Integration time in seconds.

    Returns:
        Relative error of the response of the point in dB.
    """
    middle = radar.reference_range_m
    two_way = two_way_radar(radar, bands, middle - half_swath_m)
    aperture = Aperture.of(two_way, middle, 0.0, radar.speed_m_s, 0.0, integration_s)
    return phase_error_db(aperture.bulk_residual_rad(half_swath_m))


def swath_limit(
    radar: BistaticRadar,
    half_swath_m: float,
    positions_m: Sequence[tuple[float, float]],
    range_m: float,
    integration_s: float,
) -> Limit:
    """Return how wide a swath must be so that its ships can be found.

    For each ship, the swath must hold the data that are extracted about it, its range curvature,
    and its range walk at a slant-range speed of up to lambda PRF / 2.

    Args:
        radar: Radar parameters.
        half_swath_m: Half width of the swath in metres.
        positions_m: Along-track position of each ship, and its range from the middle of the swath,
            in metres.
        range_m: Half extent in range of the data extracted about a ship in metres.
        integration_s: Integration time in seconds.

    Returns:
        Limit that compares `half_swath_m` with the least half width needed.
    """
    curve = (integration_s * radar.speed_m_s) ** 2 / (8 * radar.reference_range_m)
    walks = [
        abs(off) + radar.ambiguous_velocity_m_s / 2 * (abs(along) / radar.speed_m_s + integration_s / 2)
        for along, off in positions_m
    ]
    return Limit(
        "half of the swath about the ships",
        half_swath_m,
        range_m + curve + max(walks),
        "m",
        "warn",
        "ships beyond the part of the swath in which targets are sought are not found",
        "record more range samples, or bring the ships nearer to the middle",
        at_least=True,
    )
