"""Figures of antennas on any path: images of every case, true paths and errors of navigation."""

from __future__ import annotations

import numpy as np

from torchsar import plot
from torchsar.study.output.pictures import Drawn, first_named
from torchsar.study.settings.cases import titled, word_of
from torchsar.study.trials.batch import Result

# caption of the figure of paths
_PATHS = (
    "The first trial. The error of the line of sight is that of half the path over the middle of the scene, "
    "recorded and corrected minus true, without constant and linear terms, which hardly change the focus."
)


def images(case: str, result: Result) -> Drawn:
    """Draw the images of all methods, the ideal one first."""
    shown = first_named(result.images)
    caption = (
        f"The first trial, in dB: 0.1 % of the samples of '{next(iter(shown))}' exceed 0 dB, the same level for all "
        "methods."
    )
    yield f"images_{word_of(case)}", titled("Images by every method", case), caption, plot.images(shown, 45.0)


def paths(case: str, result: Result) -> Drawn:
    """Draw how the true path deviates from a straight line, and what is left of its errors."""
    trials = result.first.trials
    time = plot.array(trials.recording.signal.axes[-2].offsets())
    parts = []
    for name in ("transmitter", "receiver"):
        if f"true_{name}_m" in trials.truth:
            place = plot.array(trials.truth[f"true_{name}_m"].reshape(-1, len(time), 3)[0])
            line = np.stack([time, np.ones_like(time)], -1)
            bent = place - line @ np.linalg.lstsq(line, place, rcond=None)[0]
            series = {axis: (time, bent[:, i]) for i, axis in enumerate("xyz")}
            parts.append(_panel(f"true path of the {name} minus a straight line", "distance (m)", series))
    series = {
        name: (time, 1e3 * plot.array(outcome.judged.view[0]))
        for name, outcome in result.first.outcomes.items()
        if name != "ideal" and not outcome.failed
    }
    parts.append(_panel("error of the line of sight that is left", "error (mm)", series))
    yield f"paths_{word_of(case)}", titled("Paths", case), _PATHS, plot.panels(parts)


def _panel(title: str, ylabel: str, series: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, object]:
    return {"series": series, "xlabel": "time (s)", "ylabel": ylabel, "title": title}
