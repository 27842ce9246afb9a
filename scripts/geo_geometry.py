"""Effects of orbit, pulse rate and velocities in a GEO spaceborne-airborne bistatic radar: figures
2 to 4 and 8 of Remote Sens. 2020, 12, 1703.

    python scripts/geo_geometry.py [--out geo_geometry] [--small]

The pulse rate of the satellite must leave a swath free of its own pulses, and the range to it
changes slowly over its orbit. In the channels of the receiver a moving target causes a delay, which
depends on its along-track speed, and a phase, which depends on its slant-range speed.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.multichannel import PointMotion
from torchsar.multichannel.response import doppler_centre_hz, shared_response
from torchsar.radar import (
    BistaticRadar,
    LinearFM,
    Orbit,
    TimingDiagram,
    range_coefficients,
    receive_range,
    seen_point,
    timing_diagram,
)
from torchsar.radar.orbit import EARTH_GRAVITY_M3_S2
from torchsar.radar.timing import off_nadir_ground_m

RADAR = BistaticRadar(
    1.25e9,
    LinearFM(50e6, 10e-6),
    sampling_hz=60e6,
    prf_hz=180.0,
    speed_m_s=300.0,
    reference_range_m=5000.0,
    wave_speed_m_s=3e8,
)
HEIGHT_M, OFF_NADIR_DEG, SWATH_M, INTEGRATION_S = 36_500e3, 7.0, 500e3, 4.5
ORBIT = Orbit.at_height(HEIGHT_M, inclination_deg=60.0, raan_deg=195.5, argument_of_perigee_deg=270.0)
PULSE_S, GUARD_S, NADIR_S = 10e-6, 50e-6, 200e-6  # the paper gives none of them
LEFT_K1_M_S = -243.0  # of the transmit range, where it stays in the data
RATES = (160.0, 168.0, 180.0, 188.0, 196.0)
SPEEDS = (0.0, 5.0, 10.0, 15.0, 20.0)
EXPECTED = {  # as the paper prints it or its text says; (own): from a separate calculation
    "v_e at u_a = 0 (m/s)": "300",
    "v_e at u_a = 20 (m/s)": "280",
    "delay at u_a = 0 (ms)": "2.667 (own)",
    "delay at u_a = 20 (ms)": "2.857 (own)",
    "change of delay at u_r = 20 (%)": "< 0.5 (own)",
    "phase a m/s of u_r (rad)": "0.0699 (own)",
    "phase error at u_a = 10 (rad)": "78 (own)",
}


def timing(small: bool) -> TimingDiagram:
    """Pulse rates of 160 to 200 Hz over the ground about the middle of the swath."""
    step_hz, step_m = (0.5, 20e3) if small else (0.025, 5e3)
    return timing_diagram(
        HEIGHT_M,
        torch.arange(160.0, 200.0, step_hz, dtype=torch.float64),
        torch.arange(4600e3, 6200e3, step_m, dtype=torch.float64),
        PULSE_S,
        GUARD_S,
        NADIR_S,
    )


def nearest_swaths(diagram: TimingDiagram) -> dict[float, float]:
    """By pulse rate (Hz) that has one, how far from 7 degrees off nadir the middle of the nearest
    clear swath lies (m).
    """
    middles = diagram.ground_m + SWATH_M / 2 - off_nadir_ground_m(HEIGHT_M, OFF_NADIR_DEG)
    fits = diagram.swath_fits(SWATH_M)
    nearest = middles[torch.where(fits, middles.abs(), torch.inf).argmin(-1)]
    return {
        float(prf): float(near) for prf, near, fit in zip(diagram.prf_hz, nearest, fits.any(-1), strict=True) if fit
    }


def draw_timing(diagram: TimingDiagram, out: Path) -> None:
    """Figure 2: what is lost to nadir echoes (1) and to transmitted pulses (2); white lines: the
    nearest clear swath at every second pulse rate.
    """
    lost = torch.maximum(diagram.nadir.double(), 2 * diagram.transmit.double())
    title = f"clear swaths of {SWATH_M / 1e3:g} km nearest to {OFF_NADIR_DEG:g} degrees off nadir (white)"
    part = {
        "title": title,
        "x": plot.array(diagram.prf_hz),
        "y": plot.array(diagram.ground_m / 1e3),
        "z": plot.array(lost.mT),
    }
    (figure,) = plot.heat_map(
        [part],
        "pulse rate (Hz)",
        "ground from nadir (km)",
        "0 clear, 1 nadir echo, 2 transmitted pulse",
        limits=(0.0, 2.0),
    )
    first, step = (float(x) for x in (diagram.ground_m[0], diagram.ground_m[1] - diagram.ground_m[0]))
    for prf, away in nearest_swaths(diagram).items():
        middle = off_nadir_ground_m(HEIGHT_M, OFF_NADIR_DEG) + away - first
        if prf % 2 < 1e-9:
            column = int((diagram.prf_hz == prf).nonzero())
            figure.axes[0].plot(
                [column, column],
                [(middle - SWATH_M / 2) / step, (middle + SWATH_M / 2) / step],
                color="white",
                linewidth=1.0,
            )
    plot.save(figure, out / "figure_02.png")


def coefficients(n: int) -> tuple[Tensor, dict[str, Tensor]]:
    """Times of an orbit (s) and k1..k4 there (time, order), by the direction of the look: across
    the path, ahead, and between.
    """
    time = torch.linspace(
        0, 2 * math.pi * math.sqrt(float(ORBIT.semi_major_m) ** 3 / EARTH_GRAVITY_M3_S2), n, dtype=torch.float64
    )
    looks = {
        f"squint {squint:g} deg": seen_point(*ORBIT.state(time), OFF_NADIR_DEG, squint) for squint in (0.0, 45.0, 90.0)
    }
    return time, {name: range_coefficients(ORBIT, point, time) for name, point in looks.items()}


def draw_coefficients(time: Tensor, found: dict[str, Tensor], out: Path) -> None:
    parts = []
    limits = ((-400.0, 250.0), None, (-7e-7, 15e-7), None)  # room for the legend
    for i, (unit, ylim) in enumerate(zip(("m/s", "m/s2", "m/s3", "m/s4"), limits, strict=True)):
        series = {name: (plot.array(time / 3600), plot.array(k[:, i])) for name, k in found.items()}
        parts.append(
            {
                "series": series,
                "xlabel": "time along the orbit (h)",
                "ylabel": f"k{i + 1} ({unit})",
                "title": f"k{i + 1}",
                "ylim": ylim,
            }
        )
    plot.save(plot.panels(parts), out / "coefficients.png")


def motion(u_r: Tensor | float, u_a: Tensor | float) -> PointMotion:
    return PointMotion.of(RADAR, torch.zeros(()), u_r, u_a)


def phase_shift_rad(point: PointMotion, left_k1_m_s: float = 0.0) -> Tensor:
    """Phase of each channel at zero Doppler against the reference, the constant factor of Eq.

    (34), (..., channel).
    """
    at_centre = torch.angle(shared_response(RADAR, point, 1, 1, torch.complex128, left_k1_m_s))[..., 0]
    return at_centre + 2 * math.pi * doppler_centre_hz(RADAR, point, left_k1_m_s)[..., None] * delay_s(point)


def delay_s(point: PointMotion) -> Tensor:
    """Delay of each channel against the reference, dx_m / v_e, (..., channel)."""
    return RADAR.channels_at() / point.effective_m_s[..., None]


def draw_parameters(speed: Tensor, point: PointMotion, name: str, path: Path) -> None:
    """Figures 3 and 4: v_e, and delay and phase of channel 3."""
    x, label = plot.array(speed), f"{name} (m/s)"
    shifts = {
        "transmit range removed": phase_shift_rad(point)[:, 2],
        f"k1 = {LEFT_K1_M_S:g} m/s left in": phase_shift_rad(point, LEFT_K1_M_S)[:, 2],
    }
    shifts = {key: value - value[speed.abs().argmin()] for key, value in shifts.items()}
    values = [
        ({"": point.effective_m_s}, "v_e (m/s)", "relative sensor velocity"),
        ({"": 1e3 * delay_s(point)[:, 2]}, "delay (ms)", "azimuth delay"),
        (shifts, "phase (rad)", "phase shift against 0 m/s"),
    ]
    parts = [
        {
            "series": {key: (x, plot.array(y)) for key, y in series.items()},
            "xlabel": label,
            "ylabel": unit,
            "title": title,
        }
        for series, unit, title in values
    ]
    plot.save(plot.panels(parts), path, columns=3)


def worst_phase_rad(u_r: Tensor | float, u_a: Tensor | float) -> Tensor:
    """Largest phase within the integration time by which a filter for points at rest misses a
    moving one that it puts where it appears.
    """
    time = torch.linspace(-INTEGRATION_S / 2, INTEGRATION_S / 2, 201, dtype=torch.float64)
    point = motion(u_r, u_a).each(lambda value: value[..., None])
    moving, at_rest = (
        receive_range(time, r, a, 0.0, RADAR.reference_range_m, RADAR.speed_m_s, 0.0)
        for r, a in ((point.u_r_m_s, point.u_a_m_s), (0.0, 0.0))
    )
    return 2 * math.pi / RADAR.wavelength_m * (moving + point.u_r_m_s * time - at_rest).abs().amax(-1)


def draw_errors(speed: Tensor, out: Path) -> None:
    """Figure 8: phase errors within the integration time, and phases of the channels."""
    x = plot.array(speed)
    imbalance = phase_shift_rad(motion(speed, 0.0))
    channels = {f"channel {m + 1}": (x, plot.array(imbalance[:, m])) for m in range(RADAR.channels)}
    parts = [
        {
            "series": {"": (x, plot.array(worst_phase_rad(0.0, speed)))},
            "xlabel": "u_a (m/s)",
            "ylabel": "phase (rad)",
            "title": "largest error by u_a",
        },
        {
            "series": {"": (x, plot.array(worst_phase_rad(speed, 0.0)))},
            "xlabel": "u_r (m/s)",
            "ylabel": "phase (rad)",
            "title": "largest error by u_r",
        },
        {"series": channels, "xlabel": "u_r (m/s)", "ylabel": "phase (rad)", "title": "imbalance of channels by u_r"},
    ]
    plot.save(plot.panels(parts), out / "figure_08.png", columns=3)


def show_timing(diagram: TimingDiagram) -> None:
    swaths = nearest_swaths(diagram)
    print(f"{'clear swath of 500 km':34}" + "".join(f"{f'{prf:g} Hz':>12}" for prf in RATES))
    print(
        f"{'its middle beyond 7 degrees (km)':34}"
        + "".join(f"{swaths[prf] / 1e3:>12.0f}" if prf in swaths else f"{'none':>12}" for prf in RATES)
    )
    print("published: pulse rates of 160 to 200 Hz are chosen, 180 Hz is used\n")


def show_orbit(found: dict[str, Tensor]) -> None:
    print(f"{'transmit range':34}{'k1 (m/s)':>12}{'k2 (m/s2)':>12}{'k3 (m/s3)':>12}{'k4 (m/s4)':>12}")
    for name, k in found.items():
        print(f"{f'largest, {name}':34}" + "".join(f"{float(x):>12.4g}" for x in k.abs().amax(0)))
    every = torch.stack(list(found.values()))
    half, to_rad = INTEGRATION_S / 2, 2 * math.pi / RADAR.wavelength_m
    phases = [to_rad * float(every[..., i].abs().max()) * half ** (i + 1) for i in range(4)]
    print(f"{'phase at 2.25 s (rad)':34}" + "".join(f"{phase:>12.3g}" for phase in phases))
    print(
        "published: |k2| at most about 0.03, phase of k3 below 1e-4 pi = 3.1e-4 rad; expected: "
        "|k1| to 376, k2 -0.0146 to 0.0208, phase of k3 2.7e-4 rad"
    )


def show_channel() -> None:
    """Figures 3, 4 and 8 in numbers."""
    speed = torch.tensor(SPEEDS, dtype=torch.float64)
    tables = {"u_a": motion(0.0, speed), "u_r": motion(speed, 0.0)}
    print(f"\n{'channel 3':34}" + "".join(f"{f'{u:g} m/s':>12}" for u in SPEEDS))
    for name, point in tables.items():
        rows = {
            "v_e (m/s)": point.effective_m_s,
            "delay (ms)": 1e3 * delay_s(point)[:, 2],
            "phase shift (rad)": phase_shift_rad(point)[:, 2],
        }
        rows["largest phase error (rad)"] = worst_phase_rad(*((0.0, speed) if name == "u_a" else (speed, 0.0)))
        for row, values in rows.items():
            print(f"{f'{name}: {row}':34}" + "".join(f"{float(x) + 0.0:>12.4f}" for x in values))
    along, radial = tables["u_a"], tables["u_r"]
    delay = [1e3 * delay_s(point)[:, 2] for point in (along, radial)]
    ours = [
        along.effective_m_s[0],
        along.effective_m_s[-1],
        delay[0][0],
        delay[0][-1],
        100 * (delay[1][-1] / delay[1][0] - 1).abs(),
        phase_shift_rad(radial)[1, 2] / SPEEDS[1],
        worst_phase_rad(0.0, speed)[2],
    ]
    print(f"\n{'':34}{'ours':>12}{'expected':>18}")
    for (name, expected), value in zip(EXPECTED.items(), ours, strict=True):
        print(f"{name:34}{float(value):>12.4f}{expected:>18}")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("geo_geometry"), help="folder of the figures")
    parser.add_argument("--small", action="store_true", help="coarser grids")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)

    diagram = timing(options.small)
    draw_timing(diagram, options.out)
    show_timing(diagram)
    time, found = coefficients(37 if options.small else 361)
    show_orbit(found)
    draw_coefficients(time, found, options.out)
    speed = torch.linspace(0, 20, 41, dtype=torch.float64)
    draw_parameters(speed, motion(0.0, speed), "u_a", options.out / "figure_03.png")
    draw_parameters(speed, motion(speed, 0.0), "u_r", options.out / "figure_04.png")
    draw_errors(speed, options.out)
    show_channel()


if __name__ == "__main__":
    main()
