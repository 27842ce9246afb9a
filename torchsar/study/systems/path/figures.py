"""Figures of antennas on any path: images of all methods, the geometry from above, the paths."""

from __future__ import annotations

import numpy as np

from torchsar import plot
from torchsar.focus.path_image import last_image
from torchsar.radar import AntennaPath
from torchsar.study.output.report import Drawn, first_named
from torchsar.study.trials.batch import Result


def images(result: Result) -> Drawn:
    """Draw the images of all methods, the ideal one first."""
    shown = first_named(result.images)
    caption = (
        f"The first trial, in dB: 0.1 % of the samples of '{next(iter(shown))}' exceed 0 dB, the same level for all "
        "methods."
    )
    yield "images", "Images by every method", caption, plot.images(shown, 45.0)


def paths(result: Result, rounding: float = 1e-9) -> Drawn:
    """Draw the deviations of the true path from a straight line, and its remaining errors.

    A panel whose values differ from zero by rounding only is left out.
    """
    trials = result.first.trials
    if not trials.truth:  # no errors were added to the recording
        return
    time = plot.array(trials.recording.signal.axes[-2].offsets())
    shown: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for name in ("transmitter", "receiver"):
        if f"true_{name}_m" in trials.truth:
            place = plot.array(trials.truth[f"true_{name}_m"].reshape(-1, len(time), 3)[0])
            line = np.stack([time, np.ones_like(time)], -1)
            bent = place - line @ np.linalg.lstsq(line, place, rcond=None)[0]
            shown[f"true path of the {name} minus a straight line", "distance (m)"] = dict(zip("xyz", bent.T))
    shown["error of the line of sight that is left", "error (mm)"] = {
        name: 1e3 * plot.array(outcome.judged.view[0])
        for name, outcome in result.first.outcomes.items()
        if name != "ideal" and not outcome.failed
    }
    parts = [
        {
            "series": {name: (time, y) for name, y in of.items()},
            "xlabel": "time (s)",
            "ylabel": label,
            "title": title,
        }
        for (title, label), of in shown.items()
        if any(np.nanmax(np.abs(y), initial=0.0) > rounding for y in of.values())
    ]
    if not parts:
        return
    caption = (
        "The first trial. The error of the line of sight is that of half the path over the middle of the scene, "
        "recorded and corrected minus true, without constant and linear terms, which hardly change the focus."
    )
    yield "paths", "Paths", caption, plot.panels(parts)


def geometry(result: Result) -> Drawn:
    """Draw the paths of the antennas and the imaged area from above, with the line of sight."""
    stage = last_image(result.bench.chains["recommended"].stages.values())
    aux = result.first.trials.recording.aux
    if stage is None or "transmitter_m" not in aux:
        return
    antennas = AntennaPath.recorded(aux)
    antennas = antennas.of_trial((0,) * len(antennas.trials))
    names = (
        ("path of the transmitter", "path of the receiver") if len(antennas.places) > 1 else ("path of the antenna",)
    )
    ends = (slice(None, None, max(1, n - 1)) for n in stage.grid.counts)
    corners = plot.array(stage.grid.pixels_m(*ends)[..., :2].reshape(-1, 2))
    ring = corners[[0, 1, 3, 2, 0]] if len(corners) == 4 else corners
    flown = {name: plot.array(place[:, :2]) for name, place in zip(names, antennas.places, strict=True)}
    sight = np.stack([flown[names[0]].mean(0), corners.mean(0)])
    lines = {**flown, "imaged area": ring, "line of sight": sight}
    series = {name: (line[:, 0], line[:, 1]) for name, line in lines.items()}
    caption = (
        "The first trial from above: paths, the imaged area of the recommended method, and the mean line of sight."
    )
    part = {"series": series, "xlabel": "x (m)", "ylabel": "y (m)", "title": "geometry from above"}
    yield "geometry", "Geometry from above", caption, plot.panels([part])
