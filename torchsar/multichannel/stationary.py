"""The conventional chain: one image of everything at rest, from all channels over the whole swath.

For a point at rest channel m is the reference channel delayed by dx_m / V_R, exactly and at every
range frequency, so that the bands are rebuilt with u = 0 before any migration is corrected. What
follows is ordinary focusing of an unaliased stripmap: a path that is travelled once is one that is
travelled both ways where waves are twice as fast, so that omega-K serves as it is. Source: Remote
Sens. 2020, 12, 1703, Figs. 6 and 7 (conventional method); brief 001, Algorithm 4.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from torchsar.core import Axis, Signal, Stage, centred_ifft
from torchsar.focus import omega_k, omega_k_stolt
from torchsar.multichannel.motion import PointMotion
from torchsar.multichannel.reconstruct import mind_condition, reconstruct_lines, refuse_shifted
from torchsar.multichannel.response import LeastSquares, Rebuild
from torchsar.radar import BistaticRadar, StripmapRadar

FORMS: dict[str, Callable[..., Tensor]] = {"bulk": omega_k, "stolt": omega_k_stolt}


def two_way_radar(radar: BistaticRadar, bands: int, near_range_m: float) -> StripmapRadar:
    """The stripmap radar with the phases of the receive path: waves twice as fast, pulse rate bands
    * PRF, looking abeam.
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
    """Image (..., azimuth, range) of what is at rest, azimuth x = V_R t and range the closest range
    R0. data: (..., channel, pulse, range), transmit range removed.

    rebuild: `LeastSquares(2)` by default. form: "stolt", exact at every range, or "bulk", migration
    of the middle of the swath for all (omega-K, brief 004). band_hz: processed Doppler band about
    zero, None for all bands * PRF. A unit point that is lit for T seconds has a peak of T
    sqrt(V_R^2 / (lambda R0)) and the phase -2 pi (R0 - R_ref) / lambda. The image is as long as the
    record and wraps around along azimuth. Moving points appear displaced by V_R u_r R0 / V^2,
    blurred, and repeated. Differentiable in the data.
    """
    rebuild = LeastSquares() if rebuild is None else rebuild
    spectrum = reconstruct_lines(data, radar, PointMotion.of(radar, data.real), rebuild)
    return focus_stationary(spectrum, radar, near_range_m, rebuild.bands, form, band_hz)


def focus_stationary(
    spectrum: Tensor,
    radar: BistaticRadar,
    near_range_m: float,
    bands: int,
    form: str = "stolt",
    band_hz: float | None = None,
) -> Tensor:
    """The second half of `stationary_image`: Doppler spectra (..., bands * pulse, range), bins
    about zero, to an image.
    """
    if form not in FORMS:
        raise ValueError(f"form of a stationary image must be one of {sorted(FORMS)}, got {form!r}")
    return FORMS[form](
        centred_ifft(spectrum, dim=-2), two_way_radar(radar, bands, near_range_m), doppler_hz=0.0, band_hz=band_hz
    )


class StationaryImage(Stage):
    """`stationary_image`: range-compressed channels in, an image (azimuth, range) in metres out.

    Refuses pulse rates at which the channels cannot tell bands apart.
    """

    works_on = ("channel", "pulse", "range")

    def __init__(
        self, radar: BistaticRadar, rebuild: Rebuild | None = None, form: str = "stolt", band_hz: float | None = None
    ) -> None:
        super().__init__()
        self.radar, self.rebuild, self.form, self.band_hz = radar, rebuild or LeastSquares(), form, band_hz
        why = self.rebuild.refusal(radar.channels)
        if why is not None:
            raise ValueError(why)

    def forward(self, signal: Signal) -> Signal:
        refuse_shifted(self.radar, signal.axis("pulse"))
        mind_condition(self.radar, PointMotion.of(self.radar, signal.data.real), self.rebuild, signal.data.dtype)
        return self.focused(
            reconstruct_lines(signal.data, self.radar, PointMotion.of(self.radar, signal.data.real), self.rebuild),
            signal,
        )

    def focused(self, spectrum: Tensor, signal: Signal) -> Signal:
        """The image of a spectrum (..., doppler, range) that was rebuilt of `signal` in some way,
        bins about zero Doppler.
        """
        _, pulse, range_ = signal.axes
        image = focus_stationary(spectrum, self.radar, range_.start, self.rebuild.bands, self.form, self.band_hz)
        return Signal(image, (stationary_axis(self.radar, pulse, self.rebuild.bands), range_))


def stationary_axis(radar: BistaticRadar, pulse: Axis, bands: int) -> Axis:
    """x = V_R t (m) of the image, as many samples as pulses at bands * PRF, zero at sample
    n // 2.
    """
    n = bands * pulse.n
    step = radar.speed_m_s / (bands * radar.prf_hz)
    return Axis("azimuth", n, -(n // 2) * step, step, "m")
