"""What a flight requires of the simplifications of its images."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import torch
from torch import Tensor

from torchsar.focus.image_grid import ImageGrid
from torchsar.focus.requirements import Requirement
from torchsar.radar import LIGHT_M_S, AntennaPath, InverseRadar
from torchsar.scene import SideBeam


def warn_of_range_along_track(path: AntennaPath, images: Sequence[ImageGrid]) -> None:
    """Warn once if a flight goes along the range axis of an image rather than its azimuth axis.

    A flight that ends near its start, such as a circle, has no direction.

    Args:
        path: Path; of several trials the first is examined.
        images: Grids of the images.
    """
    places = path.of_trial((0,) * len(path.trials)).places
    flown = sum(place[-1] - place[0] for place in places).cpu()  # pyright: ignore[reportAttributeAccessIssue]
    length = sum(float(place.diff(dim=0).norm(dim=-1).sum()) for place in places)
    parts = [(grid.axes.cpu() @ flown).abs().tolist() for grid in images]
    if any(across > max(along, length / 2) for along, across in parts):
        heading = torch.atan2(flown[1], flown[0])
        warnings.warn(
            f"the flight goes {heading.rad2deg():.0f} degrees from axis x towards y, along the range axis of the "
            "image: widths 'in azimuth' are then those across the track; "
            f"range_axis_rad={heading - math.pi / 2:.4g} of the stage turns the image, while the scene keeps azimuth y "
            "and range x, as do errors of navigation",
            stacklevel=2,
        )


def flight_requirements(
    radar: InverseRadar, true: AntennaPath, recorded: AntennaPath, beam: SideBeam | None
) -> list[Requirement]:
    """Return the errors of simplifications over a flight, seen from the origin.

    They are the largest phases within an aperture, without constant and linear terms, which shift
    the image. The aperture is the whole record, or the time in which a beam illuminates a point.

    Args:
        radar: Carrier and pulse rate.
        true: True path; of several trials the first.
        recorded: Path that navigation records.
        beam: Beam of the antenna; None if the scene is always lit.

    Returns:
        Rows for a straight path, for the recorded one, for its speed, for an antenna at rest while
        an echo is on its way, and, where the length of a sweep is known, during a sweep: its phase
        is that of the largest range rate within the beam or the record, at the ends of a sweep. The
        range rate of the middle of the beam, or the mean of the record, times the carrier frequency
        over the chirp rate displaces the image.
    """
    held = [path.of_trial((0,) * len(path.trials)) for path in (true, recorded)]
    place, known = (path.places[-1].detach().cpu() for path in held)
    time = torch.arange(len(place), dtype=torch.float64) / radar.prf_hz
    basis = torch.stack([torch.ones_like(time), time], -1)
    start, velocity = torch.linalg.lstsq(basis, place).solution
    speed = float(velocity.norm())
    heading = velocity / max(speed, 1e-12)
    away = -(start + time.mean() * velocity)
    away = away - (away @ heading) * heading
    range_m = float(away.norm())
    sight = away / max(range_m, 1e-12)
    count = len(time)
    if beam is not None and speed > 0:
        width = math.radians(float(torch.as_tensor(beam.width_deg).max()))
        count = min(count, max(8, round(2 * range_m * math.tan(width / 2) / speed * radar.prf_hz)))
    dwell_s = count / radar.prf_hz

    def left_m(distance: Tensor) -> float:
        """Largest magnitude of a distance within an aperture, after its straight line is
        removed.
        """
        parts = distance.unfold(0, count, max(1, count // 2))
        line = basis[:count]
        return float((parts.mT - line @ torch.linalg.lstsq(line, parts.mT).solution).abs().max())

    bent, error = (left_m(x @ sight) for x in (place - basis @ torch.stack([start, velocity]), known - place))
    distance = place.norm(dim=-1)
    moved = left_m(torch.gradient(distance, spacing=(time,))[0] * distance / LIGHT_M_S)
    # speed error dv for a phase of pi / 4 at the ends of the aperture, 4 pi / lambda v dv
    # (T / 2)^2 / R
    tolerated = radar.wavelength_m * range_m / (4 * speed * dwell_s**2) if speed > 0 else math.inf
    off = abs(float(torch.linalg.lstsq(basis, known - place).solution[1] @ heading))
    turn, quarter = 4 * math.pi / radar.wavelength_m, math.pi / 4
    remedy = "autofocus (path_autofocus, strip_autofocus), which finds errors that change slowly over the aperture"
    allowed = f"{quarter / turn:.3g} m along the line of sight leave a phase of pi / 4"
    rows = (
        ("a straight path", f"deviations of {bent:.3g} m from a straight line", bent, "image along the recorded path"),
        ("the recorded path", f"errors of navigation of {error:.3g} m; {allowed}", error, remedy),
        ("an antenna at rest during an echo", f"motion while an echo is on its way, {moved:.3g} m", moved, "move it"),
    )
    found = [
        Requirement(name, f"{what} within {dwell_s:.3g} s", turn * x, x / radar.range_step_m, quarter, advice)
        for name, what, x, advice in rows
    ]
    if radar.pulse_s is not None:
        legs = torch.stack([v.detach().cpu().norm(dim=-1) for v in held[0].places]).mean(0)
        rate = float((legs[-1] - legs[0]) / (time[-1] - time[0]))
        largest = float(torch.gradient(legs, spacing=(time,))[0].abs().max())
        if beam is not None:
            squint, half = torch.as_tensor(beam.squint_deg).deg2rad(), torch.as_tensor(beam.width_deg).deg2rad() / 2
            rate = speed * math.sin(float(squint.mean()))
            largest = speed * math.sin(min(float((squint.abs() + half).max()), math.pi / 2))
        off_m = abs(rate) * radar.carrier_hz / radar.chirp_rate_hz_s
        what = (
            f"motion within {radar.pulse_s:.3g} s at a range rate of up to {largest:.3g} m/s, whose mean displaces the "
            f"image by {off_m:.3g} m in slant range"
        )
        ends = turn * largest * radar.pulse_s / 2
        at_rest = ("an antenna at rest during a sweep", what, ends, off_m / radar.range_step_m, quarter)
        found.append(Requirement(*at_rest, "correct_sweep_motion"))
    neglects = f"an error of {off:.3g} m/s; {tolerated:.3g} m/s leave a phase of pi / 4 at the ends of {dwell_s:.3g} s"
    return [*found, Requirement("the recorded speed", neglects, quarter * off / tolerated, math.nan, quarter, remedy)]
