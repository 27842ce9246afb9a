"""The radar of Table 1 of Remote Sens. 2020, 12, 1703.

Effects of pulse rate and velocities in a GEO spaceborne-airborne bistatic radar: figures 2 to 4
and 8 of Remote Sens. 2020, 12, 1703.

The pulse rate of the satellite must leave a swath free of its own pulses. In the channels of the
receiver a moving target causes a delay, which depends on its along-track speed, and a phase, which
depends on its slant-range speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.multichannel import PointMotion
from torchsar.multichannel.response import doppler_centre_hz, shared_response
from torchsar.radar import BistaticRadar, LinearFM, Orbit, TimingDiagram, timing_diagram
from torchsar.radar.bistatic import receive_range
from torchsar.radar.timing import off_nadir_ground_m
from torchsar.reproduce.item import Check, Item, number, parameters, statement

# values of Table 1; pulse length and sampling are chosen, and the printed numbers follow from a
# speed of 3e8 m/s
RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    wave_speed_m_s=3e8,
)
# integration time, Doppler bandwidth of this time, height of the satellite, off-nadir angle
INTEGRATION_S, BANDWIDTH_HZ, HEIGHT_M, OFF_NADIR_DEG = 4.5, 337.5, 36_500e3, 7.0
ORBIT = Orbit.at_height(HEIGHT_M, inclination_deg=60.0, raan_deg=195.5, argument_of_perigee_deg=270.0)
# Taylor coefficients (m/s, m/s2, m/s3) of the transmit range for an orbit of this height, by choice
TRANSMIT_RANGE = (-243.0, 0.02, 5e-7)


def _table_1(small: bool, path: Path) -> list[Check]:
    rows = {
        "carrier (GHz)": (1.25, 1e-9 * RADAR.carrier_hz),
        "pulse rate (Hz)": (180.0, RADAR.prf_hz),
        "bandwidth (MHz)": (50.0, 1e-6 * RADAR.pulse.bandwidth_hz),
        "integration time (s)": (4.5, INTEGRATION_S),
        "inclination (deg)": (60.0, ORBIT.inclination_deg),
        "right ascension of the ascending node (deg)": (195.5, ORBIT.raan_deg),
        "argument of perigee (deg)": (270.0, ORBIT.argument_of_perigee_deg),
        "off-nadir angle (deg)": (7.0, OFF_NADIR_DEG),
        "range of the scene (km)": (5.0, 1e-3 * RADAR.reference_range_m),
        "speed of the receiver (m/s)": (300.0, RADAR.speed_m_s),
        "channels": (3, RADAR.channels),
        "spacing of the channels (m)": (0.8, RADAR.channel_m[1] - RADAR.channel_m[0]),
    }
    return parameters(rows, 1e-6)


# width of the swath of figure 2 (m)
SWATH_M = 500e3
# chosen: pulse length, guard time, length of the nadir echo (s)
PULSE_S, GUARD_S, NADIR_S = 10e-6, 50e-6, 200e-6
LEFT_K1_M_S = -243.0  # coefficient k1 of the transmit range, if it is left in the data


def _timing(small: bool) -> TimingDiagram:
    """Timing diagram for pulse rates of 160 to 200 Hz and ground ranges around the middle of the
    swath.
    """
    step_hz, step_m = (0.5, 20e3) if small else (0.025, 5e3)
    return timing_diagram(
        HEIGHT_M,
        torch.arange(160.0, 200.0, step_hz, dtype=torch.float64),
        torch.arange(4600e3, 6200e3, step_m, dtype=torch.float64),
        PULSE_S,
        GUARD_S,
        NADIR_S,
    )


def _motion(u_r: Tensor | float, u_a: Tensor | float) -> PointMotion:
    return PointMotion.of(RADAR, torch.zeros(()), u_r, u_a)


def _phase_shift_rad(point: PointMotion, left_k1_m_s: float = 0.0) -> Tensor:
    """Phase of each channel at zero Doppler relative to the reference channel, (..., channel): the
    constant factor of Eq. (34).
    """
    at_centre = torch.angle(shared_response(RADAR, point, 1, 1, torch.complex128, left_k1_m_s))[..., 0]
    return at_centre + 2 * math.pi * doppler_centre_hz(RADAR, point, left_k1_m_s)[..., None] * _delay_s(point)


def _delay_s(point: PointMotion) -> Tensor:
    """Delay of each channel relative to the reference channel, dx_m / v_e, (..., channel)."""
    return RADAR.channels_at() / point.effective_m_s[..., None]


def _draw_parameters(speed: Tensor, point: PointMotion, name: str, path: Path) -> None:
    """Draw Figures 3 and 4: v_e, and delay and phase of channel 3."""
    label = f"{name} (m/s)"
    shifts = {
        "transmit range removed": _phase_shift_rad(point)[:, 2],
        f"k1 = {LEFT_K1_M_S:g} m/s left in": _phase_shift_rad(point, LEFT_K1_M_S)[:, 2],
    }
    shifts = {key: value - value[speed.abs().argmin()] for key, value in shifts.items()}
    shown = {
        "relative sensor velocity": (label, "v_e (m/s)", {"": point.effective_m_s}),
        "azimuth delay": (label, "delay (ms)", {"": 1e3 * _delay_s(point)[:, 2]}),
        "phase shift against 0 m/s": (label, "phase (rad)", shifts),
    }
    _draw(speed, shown, path)


def _draw(speed: Tensor, shown: Mapping[str, tuple[str, str, Mapping[str, Tensor]]], path: Path) -> None:
    """Draw panels by title: labels of the axes, and curves over the speed by name."""
    x = plot.array(speed)
    parts = [
        {
            "series": {name: (x, plot.array(y)) for name, y in series.items()},
            "xlabel": xlabel,
            "ylabel": ylabel,
            "title": title,
        }
        for title, (xlabel, ylabel, series) in shown.items()
    ]
    plot.save(plot.panels(parts), path, columns=3)


def _worst_phase_rad(u_r: Tensor | float, u_a: Tensor | float) -> Tensor:
    """Largest phase difference in rad between a moving point and one at rest within the integration
    time.

    The term u_r t, which only displaces the image, is left out.
    """
    time = torch.linspace(-INTEGRATION_S / 2, INTEGRATION_S / 2, 201, dtype=torch.float64)
    point = _motion(u_r, u_a).each(lambda value: value[..., None])
    moving, at_rest = (
        receive_range(time, r, a, 0.0, RADAR.reference_range_m, RADAR.speed_m_s, 0.0)
        for r, a in ((point.u_r_m_s, point.u_a_m_s), (0.0, 0.0))
    )
    return 2 * math.pi / RADAR.wavelength_m * (moving + point.u_r_m_s * time - at_rest).abs().amax(-1)


def _speeds(small: bool) -> Tensor:
    """Speeds of 0 to 20 m/s; the reduced form is the same."""
    return torch.linspace(0, 20, 41, dtype=torch.float64)


def _figure_2(diagram: TimingDiagram, path: Path) -> list[Check]:
    # parts of the diagram that are lost: to nadir echoes (1), and to transmitted pulses (2)
    lost = torch.maximum(diagram.nadir.double(), 2 * diagram.transmit.double())
    axes = {"x": plot.array(diagram.prf_hz), "y": plot.array(diagram.ground_m / 1e3), "z": plot.array(lost.mT)}
    title = f"clear swaths of {SWATH_M / 1e3:g} km nearest to {OFF_NADIR_DEG:g} degrees off nadir (white)"
    labels = ("pulse rate (Hz)", "ground from nadir (km)", "0 clear, 1 nadir echo, 2 transmitted pulse")
    (figure,) = plot.heat_map([{"title": title, **axes}], *labels, limits=(0.0, 2.0))
    # distance (m) between the middle of the nearest clear swath and the ground at 7 degrees off
    # nadir, for each pulse rate
    aim, fits = off_nadir_ground_m(HEIGHT_M, OFF_NADIR_DEG), diagram.swath_fits(SWATH_M)
    middles = diagram.ground_m + SWATH_M / 2 - aim
    nearest = middles[torch.where(fits, middles.abs(), torch.inf).argmin(-1)]
    rows = zip(diagram.prf_hz.tolist(), nearest.tolist(), fits.any(-1), strict=True)
    swaths = {prf: near for prf, near, fit in rows if fit}
    first, step = (float(x) for x in (diagram.ground_m[0], diagram.ground_m[1] - diagram.ground_m[0]))
    for prf, away in swaths.items():
        if prf % 2 < 1e-9:  # draw white lines at every second pulse rate only
            column = int((diagram.prf_hz == prf).nonzero())
            ends = [(aim + away - first + side * SWATH_M / 2) / step for side in (-1, 1)]
            figure.axes[0].plot([column, column], ends, color="white", linewidth=1.0)
    plot.save(figure, path)
    nearby = min(swaths, key=lambda prf: abs(prf - RADAR.prf_hz))
    fit = fits.any(-1)
    begins, ends = (~fit[1:] & fit[:-1]).nonzero()[:, 0] + 1, (fit[1:] & ~fit[:-1]).nonzero()[:, 0]
    blind = [
        f"{float(diagram.prf_hz[i]):.1f} to {float(diagram.prf_hz[j]):.1f}" for i, j in zip(begins, ends, strict=False)
    ]
    share = 100 * len(swaths) / len(diagram.prf_hz)
    ours = f"{share:.0f} % of the rates leave it, all but {', '.join(blind)} Hz"
    return [
        statement("regions of pulse rates that leave 500 km clear", "are selected in 160 to 200 Hz", share > 50, ours),
        number("pulse rate among them nearest to that of the simulations (Hz)", 180.0, nearby, 0.05),
    ]


def _figure_3(speed: Tensor, path: Path) -> list[Check]:
    point = _motion(0.0, speed)
    _draw_parameters(speed, point, "u_a", path)
    velocity, shift = point.effective_m_s, float(_phase_shift_rad(point)[:, 2].abs().max())
    return [
        number("relative velocity at rest (m/s)", 300.0, float(velocity[0]), 0.5),
        number("relative velocity at 20 m/s along track (m/s)", 280.0, float(velocity[-1]), 0.5),
        statement("phase shift", "independent of the along-track velocity", shift < 1e-3, f"at most {shift:.1g} rad"),
    ]


def _figure_4(speed: Tensor, path: Path) -> list[Check]:
    point = _motion(speed, 0.0)
    _draw_parameters(speed, point, "u_r", path)
    change = 100 * float((_delay_s(point)[-1, 2] / _delay_s(point)[0, 2] - 1).abs())
    shift = float(_phase_shift_rad(point)[-1, 2])
    ours = f"at 20 m/s the delay changes by {change:.2f} %, the phase by {shift:.2f} rad"
    claim = "a small effect on velocity and delay, a clear one on the phase"
    return [statement("slant-range velocity", claim, change < 1 < abs(shift), ours)]


def _figure_8(speed: Tensor, path: Path) -> list[Check]:
    phases = _phase_shift_rad(_motion(speed, 0.0))
    shown = {
        "largest error by u_a": ("u_a (m/s)", {"": _worst_phase_rad(0.0, speed)}),
        "largest error by u_r": ("u_r (m/s)", {"": _worst_phase_rad(speed, 0.0)}),
        "imbalance of channels by u_r": (
            "u_r (m/s)",
            {f"channel {m + 1}": phases[:, m] for m in range(RADAR.channels)},
        ),
    }
    _draw(speed, {title: (label, "phase (rad)", series) for title, (label, series) in shown.items()}, path)
    along, across = (float(_worst_phase_rad(*u)) for u in ((0.0, 10.0), (10.0, 0.0)))
    imbalance = float(_phase_shift_rad(_motion(10.0, 0.0))[2].abs())
    ours = f"at 10 m/s {along:.1f} rad along track, {across:.2f} rad in slant range; imbalance {imbalance:.2f} rad"
    claim = "larger by the along-track velocity; the slant-range velocity unbalances the channels"
    return [statement("phase errors", claim, along > across and imbalance > 0.5, ours)]


ITEMS = (
    Item("Table 1", "parameters of the simulation", bool, _table_1),
    Item("Figure 2", "timing diagram: pulse rates that leave a swath clear", of=_timing, make=_figure_2),
    Item("Figure 3", "effects of the along-track velocity on the channels", of=_speeds, make=_figure_3),
    Item("Figure 4", "effects of the slant-range velocity on the channels", of=_speeds, make=_figure_4),
    Item("Figure 8", "phase errors by the velocity of the target", of=_speeds, make=_figure_8),
)
