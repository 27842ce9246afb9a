"""`torchsar trade` for ships on a sea: time against errors of segments, lines, removal and
precision, on the first scene of the recommended flow.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from torchsar import plot
from torchsar.core import Draws
from torchsar.multichannel.scene_image import ImageMovers
from torchsar.multichannel.transmit import RemoveTransmitRange
from torchsar.study.config import Loaded
from torchsar.study.ocean.build import Sighted, check
from torchsar.study.ocean.judge import Judged, Reference, judged
from torchsar.study.ocean.stages import MoversImage
from torchsar.study.ocean.trials import Bench
from torchsar.study.trading import Tables, timed, traded

log = logging.getLogger("torchsar")


@dataclass(frozen=True)
class Row:
    """One alternative: median seconds a scene and their spread; root mean squares of errors over
    ships that move, means of levels. None where no ship has them.
    """

    name: str
    seconds: float
    spread_s: float
    u_r_error_m_s: float | None = None
    u_a_error_m_s: float | None = None
    position_error_m: float | None = None
    sea_error_db: float | None = None
    hole_db: float | None = None
    found: float | None = None


def trade(loaded: Loaded, out: Path | None) -> str:
    """Tables of the recommended flow with one setting changed at a time, on the first scene of the
    first case; returns them as text.

    With `out`: config.yaml, trade.json, trade.txt and figures/ in that folder.
    """
    return traded(loaded, out, check, _tables, _TITLES, _COLUMNS, _figures)


@torch.no_grad()
def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    made = _Flow.of(loaded)
    return {
        "segment": list(made.segments()),
        "lines": list(made.lines()),
        "removal": list(made.removals()),
        "precision": list(made.precisions()),
    }


@dataclass(frozen=True)
class _Flow:
    """The scene and the recommended flow."""

    bench: Bench
    flow: ImageMovers
    sighted: Sighted
    reference: Reference

    @staticmethod
    def of(loaded: Loaded) -> _Flow:
        bench = Bench.of(loaded)
        image = bench.ways["recommended"].image
        if not isinstance(image, MoversImage):
            raise ValueError(
                "trade compares flows, and the method 'recommended' makes an image of everything at "
                "rest; end its chain with movers_image"
            )
        sighted = bench.ocean.sighted(Draws(loaded.config.seed, "trade"))
        return _Flow(
            bench,
            image.flow,
            sighted,
            Reference.of(bench.ocean.radar, sighted, RemoveTransmitRange(bench.ocean.radar), bench.extraction),
        )

    def segments(self) -> Iterator[Row]:
        for length in self.bench.config.trade.segments_s:
            yield self._row(f"segments of {length:g} s", extraction=replace(self.flow.extraction, segment_s=length))

    def lines(self) -> Iterator[Row]:
        for half in self.bench.config.trade.half_ranges_m:
            yield self._row(f"lines within {half:g} m", extraction=replace(self.flow.extraction, range_m=half))

    def removals(self) -> Iterator[Row]:
        yield self._row("echo subtracted", removal="subtract")
        yield self._row("set to zero", removal="zero")

    def precisions(self) -> Iterator[Row]:
        for name in self.bench.config.trade.precisions:
            yield self._row(name, dtype=getattr(torch, name))

    def _row(self, name: str, dtype: torch.dtype | None = None, **changes: Any) -> Row:
        """The flow with other settings."""
        flow, radar = self.flow, self.bench.ocean.radar
        kept: dict[str, Any] = {
            "extraction": flow.extraction,
            "detector": flow.detector,
            "rebuild": flow.image.rebuild,
            "removal": flow.removal,
            "u_a_half_m_s": flow.u_a_half_m_s,
        }
        other, remove = ImageMovers(radar, **{**kept, **changes}), RemoveTransmitRange(radar)
        recorded = self.sighted.recording.signal
        data = remove(recorded if dtype is None else recorded.with_data(recorded.data.to(dtype)))
        began = time.perf_counter()
        made, times = timed(lambda: other(data), self.bench.config.trade.repeats)
        log.info("%s: %.1f s", name, time.perf_counter() - began)
        still = other.image(self.reference.still)
        return _row_of(
            name,
            times,
            judged(made, still, self.reference, self.bench.config.metrics.match_m, True),
            [n for n, ship in self.sighted.ships.items() if ship.moves],
        )


def _row_of(name: str, times: Sequence[float], of: Judged, moving: Sequence[str]) -> Row:
    row: dict[str, float] = {}
    for key in _COLUMNS:
        values = [of.ships[ship][key] for ship in moving if key in of.ships[ship]]
        if values:
            row[key] = (
                math.sqrt(sum(v * v for v in values) / len(values)) if "error_m" in key else sum(values) / len(values)
            )
    return Row(name, sorted(times)[len(times) // 2], max(times) - min(times), **row)


_TITLES = {
    "segment": "LENGTH OF SEGMENTS",
    "lines": "LINES OF A BODY",
    "removal": "REMOVAL",
    "precision": "PRECISION OF SAMPLES",
}
_COLUMNS = {
    "u_r_error_m_s": ("u_r error (m/s)", ".3f"),
    "u_a_error_m_s": ("u_a error (m/s)", ".3f"),
    "position_error_m": ("place error (m)", ".2f"),
    "sea_error_db": ("sea error (dB)", ".1f"),
    "hole_db": ("hole (dB)", ".1f"),
    "found": ("found", ".2f"),
}


def _figures(tables: Tables) -> Mapping[str, plot.Figure]:
    """Time against the error of the sea, where ships move."""
    shown = {key: [row for row in rows if row.sea_error_db is not None] for key, rows in tables.items()}
    return {
        key: plot.trade(
            [r.name for r in rows],
            [r.seconds for r in rows],
            [r.sea_error_db for r in rows],
            "error of the sea (dB)",
            _TITLES[key].lower(),
        )
        for key, rows in shown.items()
        if rows
    }
