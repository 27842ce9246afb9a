"""`torchsar trade` for moving targets before several channels: time against what each
simplification does to the image of a target whose velocities are known.
"""

from __future__ import annotations

import logging
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchsar import plot
from torchsar.core import Chain, Draws, Signal, use
from torchsar.metrics import error_db
from torchsar.metrics.replicas import azimuth_response
from torchsar.multichannel.azimuth import FocusAzimuth
from torchsar.multichannel.compress import CompressChannels
from torchsar.multichannel.migration import CorrectMigration, Keystone, Migration, NoMigration, StaticBulk
from torchsar.multichannel.reconstruct import Reconstruct
from torchsar.multichannel.response import FlatBand, LeastSquares, MinimumMeanSquare, Rebuild
from torchsar.multichannel.transmit import RemoveTransmitRange
from torchsar.scene import TaylorRange
from torchsar.study.config import Loaded
from torchsar.study.geo.build import TOLD, Echoes, Recorded, check
from torchsar.study.geo.judge import Focused, Profiles, response_metrics
from torchsar.study.geo.sections import GeoConfig, Trade
from torchsar.study.methods import build_chains
from torchsar.study.trading import Tables, timed, traded

log = logging.getLogger("torchsar")
_REBUILD = LeastSquares(2)
_TOLD_AS = {name: f"aux.{TOLD}{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}


@dataclass(frozen=True)
class Row:
    """One alternative: median seconds a trial over the repeats and their spread; figures of the
    image of a clean echo as `torchsar run` measures them, means over trials; peak over that of the
    first row; image_error_db: difference of the image from the first row's. None where it has none.
    """

    name: str
    seconds: float
    spread_s: float
    peak_db: float | None = None
    irw_azimuth_m: float | None = None
    pslr_azimuth_db: float | None = None
    mfta_db: float | None = None
    irw_range_m: float | None = None
    pslr_range_db: float | None = None
    condition_number: float | None = None
    noise_gain_db: float | None = None
    image_error_db: float | None = None


def trade(loaded: Loaded, out: Path | None) -> str:
    """Tables of range-history orders, dimensions, migration corrections, reconstructions and
    precisions on the first target of the first case; returns them as text.

    Velocities are the true ones, echoes free of noise and impairment. With `out`: config.yaml,
    trade.json, trade.txt and figures/ in that folder.
    """
    return traded(loaded, out, check, _tables, _TITLES, _COLUMNS, _figures)


@torch.no_grad()
def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    made = _Target.of(loaded)
    return {
        "history": list(made.histories()),
        "dimensions": list(made.dimensions()),
        "migration": list(made.migrations()),
        "rebuild": list(made.rebuilds()),
        "precision": list(made.precisions()),
    }


@dataclass(frozen=True)
class _Target:
    """The first target, to be imaged in several ways. bandwidth_hz: the processed band."""

    echoes: Echoes
    settings: Trade
    orders: int
    bandwidth_hz: float | None
    draws: Draws

    @staticmethod
    def of(loaded: Loaded) -> _Target:
        config = loaded.config
        assert isinstance(config, GeoConfig)
        echoes = Echoes.of(loaded)
        first = dict(list(echoes.targets.items())[:1])
        stages = build_chains(loaded, radar=echoes.radar)["recommended"].stages.values()
        band = next((stage.bandwidth_hz for stage in stages if isinstance(stage, FocusAzimuth)), None)
        alone = replace(echoes, targets=first, sea=None, impairments={}, snr_db=None, samples=None, kind="compressed")
        return _Target(
            alone, config.trade, config.metrics.orders, band, Draws(config.seed, "trade", range(config.trade.trials))
        )

    def _recorded(self, samples: int | None = None, dtype: torch.dtype | None = None, **changes: Any) -> Recorded:
        return replace(self.echoes, samples=samples, **changes).recorded(self.draws, dtype=dtype)

    def _chain(
        self,
        rebuild: Rebuild = _REBUILD,
        migration: Migration | None = None,
        order: int | None = None,
        full: bool = False,
        followed: bool = True,
    ) -> Chain:
        """The chain with velocities told; migration: None for azimuth-only data; followed: it takes
        out that of the target, else that of a point at rest.
        """
        radar = self.echoes.radar
        stages: dict[str, nn.Module] = {"compress": CompressChannels(radar, "flat")} if full else {}
        stages["remove"] = RemoveTransmitRange(radar, order)
        if migration is not None:
            stages["correct"] = use(CorrectMigration(radar, migration), **(_TOLD_AS if followed else {}))
        stages["rebuild"] = use(Reconstruct(radar, rebuild), **_TOLD_AS)
        stages["focus"] = use(FocusAzimuth(radar, self.bandwidth_hz), **_TOLD_AS, range_m=f"aux.{TOLD}range_m")
        return Chain(**stages)

    def histories(self) -> Iterator[Row]:
        """Orders of the transmit range that the processor takes out, and range series of the echo,
        against what is exact.
        """
        recorded = self._recorded()
        first = self._made("exact", self._chain(), recorded)
        yield first.row
        for order in self.settings.transmit_orders:
            if order < len(self.echoes.radar.transmit_range):
                yield self._made(f"transmit range of order {order}", self._chain(order=order), recorded, first).row
        for order in self.settings.receive_orders:
            yield self._made(
                f"echo with a receive range of order {order}",
                self._chain(),
                self._recorded(receive=TaylorRange(order)),
                first,
            ).row

    def dimensions(self) -> Iterator[Row]:
        """Azimuth alone, range-compressed lines, full chirps."""
        samples = self.settings.samples
        yield self._made("azimuth only", self._chain(), self._recorded()).row
        yield self._made(f"{samples} range lines", self._chain(migration=Keystone()), self._recorded(samples)).row
        longer = samples + 2 * self.echoes.radar.pulse.n_samples(
            self.echoes.radar.sampling_hz
        )  # echoes begin at the middle of the axis
        yield self._made(
            f"full chirps, {longer} samples",
            self._chain(migration=Keystone(), full=True),
            self._recorded(longer, kind="full"),
        ).row

    def migrations(self) -> Iterator[Row]:
        """Corrections of range migration by the target's own motion, and by that of a point at
        rest.
        """
        recorded = self._recorded(self.settings.samples)
        kinds = {
            "keystone": (Keystone(), True),
            "keystone, one reference range": (Keystone(False), True),
            "static bulk": (StaticBulk(True), True),
        }
        kinds |= {
            "keystone, as if at rest": (Keystone(), False),
            "static bulk, as if at rest": (StaticBulk(True), False),
            "none": (NoMigration(), False),
        }
        first = None
        for name, (migration, followed) in kinds.items():
            made = self._made(name, self._chain(migration=migration, followed=followed), recorded, first)
            first = first or made
            yield made.row

    def rebuilds(self) -> Iterator[Row]:
        """Reconstructions by inverses of several bands and by priors."""
        recorded, channels = self._recorded(), self.echoes.radar.channels
        kinds: dict[str, Rebuild] = {
            f"least squares, {bands} band{'s' if bands > 1 else ''}": LeastSquares(bands)
            for bands in self.settings.bands
            if bands <= channels
        }
        kinds["least mean square, pattern, 5 bands"] = MinimumMeanSquare(5)
        if self.bandwidth_hz is not None:
            kinds["least mean square, flat band, 5"] = MinimumMeanSquare(5, prior=FlatBand(self.bandwidth_hz))
        for name, rebuild in kinds.items():
            try:
                yield self._made(name, self._chain(rebuild), recorded).row
            except ValueError as error:  # singular for this target
                log.warning("warning: %s: %s", name, error)

    def precisions(self) -> Iterator[Row]:
        """Single against double precision, echo and chain."""
        first = None
        for name in sorted(self.settings.precisions):
            made = self._made(name, self._chain(), self._recorded(dtype=getattr(torch, name)), first)
            first = first or made
            yield made.row

    def _made(self, name: str, chain: Chain, recorded: Recorded, first: _Made | None = None) -> _Made:
        trace, times = timed(lambda: chain.trace(recorded.unimpaired), self.settings.repeats)
        focused = Focused.of(chain, trace, self.echoes.radar)
        assert focused is not None
        figures = {
            **focused.metrics(),
            **response_metrics(trace.signal, focused, recorded.truth, self.echoes.integration_s, self.orders),
        }
        level = _peak(trace.signal)
        compared = {} if first is None else {"peak_db": float((level - first.level).mean())}
        if first is not None and first.image.data.shape == trace.signal.data.shape:
            compared["image_error_db"] = _error_db(trace.signal, first.image)
        count = len(self.draws.trials or ())
        row = Row(
            name, statistics.median(times) / count, (max(times) - min(times)) / count, **compared, **_kept(figures)
        )
        log.info("%s: %.1f ms", name, 1e3 * row.seconds)
        return _Made(row, level, trace.signal)


@dataclass(frozen=True)
class _Made:
    row: Row
    level: Tensor
    image: Signal


def _kept(figures: Mapping[str, Tensor]) -> dict[str, float]:
    return {
        key: float(value.mean())
        for key, value in figures.items()
        if key in Row.__dataclass_fields__ and bool(torch.isfinite(value).all())
    }


def _peak(image: Signal) -> Tensor:
    """Interpolated peak (row,), dB."""
    cuts = Profiles.of(image, torch.ones(image.trials, dtype=torch.float64), 1.0)
    return 20 * torch.log10(azimuth_response(cuts.azimuth, 1.0)["peak"].abs())


def _error_db(image: Signal, truth: Signal) -> float:
    two = [
        x.data.to(torch.complex128) if "range" in x.names else x.data.to(torch.complex128)[..., None]
        for x in (image, truth)
    ]
    return float(error_db(*two).mean())


_TITLES = {
    "history": "ORDERS OF THE RANGE HISTORY, azimuth only",
    "dimensions": "ONE OR TWO DIMENSIONS",
    "migration": "RANGE MIGRATION",
    "rebuild": "RECONSTRUCTIONS",
    "precision": "PRECISION",
}
_COLUMNS = {
    "peak_db": ("peak (dB)", ".2f"),
    "irw_azimuth_m": ("azimuth (m)", ".3f"),
    "pslr_azimuth_db": ("PSLR (dB)", ".2f"),
    "mfta_db": ("MFTA (dB)", ".1f"),
    "irw_range_m": ("range (m)", ".3f"),
    "pslr_range_db": ("range PSLR (dB)", ".2f"),
    "condition_number": ("condition", ".3g"),
    "noise_gain_db": ("noise gain (dB)", ".2f"),
    "image_error_db": ("image error (dB)", ".1f"),
}
_SHOWN = {
    "history": ("irw_azimuth_m", "width in azimuth (m)"),
    "dimensions": ("mfta_db", "largest false target (dB)"),
    "migration": ("irw_azimuth_m", "width in azimuth (m)"),
    "rebuild": ("mfta_db", "largest false target (dB)"),
    "precision": ("mfta_db", "largest false target (dB)"),
}


def _figures(tables: Tables) -> dict[str, plot.Figure]:
    return {key: _figure(rows, *_SHOWN[key], key) for key, rows in tables.items()}


def _figure(rows: Sequence[Row], name: str, label: str, title: str) -> plot.Figure:
    kept = [row for row in rows if getattr(row, name) is not None]
    return plot.trade(
        [row.name for row in kept], [row.seconds for row in kept], [getattr(row, name) for row in kept], label, title
    )
