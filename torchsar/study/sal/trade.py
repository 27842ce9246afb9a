"""`torchsar trade` for triangular-sweep ladars: time against error of echo models, estimators,
their settings, and precisions.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import torch

from torchsar import plot
from torchsar.compensate.radial import mirror_product, segmented_interference, spectrum_correlation
from torchsar.compensate.radial.mirror import Intercept
from torchsar.core import Chain, Draws, Estimate, Recording, Signal, Stage, Trace, Truth, use
from torchsar.metrics import error_db
from torchsar.radar import TriangularLadar
from torchsar.scene import EverySample, Fidelity, LinearInSweep, OnePerPeriod, OnePerSweep, QuadraticInSweep
from torchsar.study.cases import cases_of, refuse_recordings
from torchsar.study.config import Loaded
from torchsar.study.methods import build_chains
from torchsar.study.sal.build import Ladar, check
from torchsar.study.sal.judge import SWEEPS, course_of, motion_metrics
from torchsar.study.sal.sections import Trade
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import traced
from torchsar.study.trading import Tables, timed, written

log = logging.getLogger("torchsar")
_LADDER: dict[str, Fidelity] = {
    "every_sample": EverySample(),
    "every_sample, flight time": EverySample(()),
    "quadratic_in_sweep": QuadraticInSweep(),
    "linear_in_sweep": LinearInSweep(),
    "linear_in_sweep, no residual video": LinearInSweep(("flight", "residual_video")),
    "linear_in_sweep, parabola": LinearInSweep(("flight", "hyperbola")),
    "one_per_sweep": OnePerSweep(),
    "one_per_period": OnePerPeriod(),
}


@dataclass(frozen=True)
class Row:
    """One alternative: median seconds a trial over the repeats, their spread, rms error of the
    velocity (m/s) and of the range without constant and slope (m), means over trials; of an echo
    the difference (dB) from the one that follows every sample, which has -inf.
    """

    name: str
    seconds: float
    spread_s: float
    velocity_rmse_m_s: float | None
    range_error_detrended_rms_m: float
    echo_error_db: float | None = None


def trade(loaded: Loaded, out: Path | None) -> str:
    """Tables of echo models, methods, settings of estimators and precisions on the first case of a
    config; returns them as text.

    With `out`: config.yaml, trade.json, trade.txt and figures/ in that folder. Echo models are
    compared without noise, on separated sweeps.
    """
    refuse_recordings(loaded)
    check(loaded)
    name, case = next(iter(cases_of(loaded).items()))
    return written(loaded, out, lambda: _tables(case), lambda tables: _text(name, tables), _figures)


def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    """Raises ConfigError for what simulation or methods refuse."""
    try:
        with torch.no_grad():
            bench = _Bench.of(loaded)
            return {
                "echo": list(bench.echoes()),
                "methods": list(bench.methods()),
                "settings": list(bench.settings()),
                "precision": list(bench.precisions()),
            }
    except (ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from error


@dataclass(frozen=True)
class _Bench:
    """A case with its simulated trials."""

    loaded: Loaded
    ladar: Ladar
    chains: Mapping[str, Chain]
    recording: Recording
    truth: Truth

    @staticmethod
    def of(loaded: Loaded) -> _Bench:
        ladar = Ladar.of(loaded)
        recording, truth = ladar.recorded(_draws(loaded))
        return _Bench(loaded, ladar, build_chains(loaded, radar=ladar.radar), recording, truth)

    @property
    def repeats(self) -> int:
        return self.loaded.config.trade.repeats

    def row(self, name: str, times: Sequence[float], chain: Chain, trace: Trace, truth: Truth, count: int) -> Row:
        found = {
            key: float(value.mean())
            for key, value in motion_metrics(
                course_of(chain, trace, truth, self.ladar.radar, False), self.ladar.radar
            ).items()
        }
        median = statistics.median(times) / count
        log.info("%s: %.1f ms", name, 1e3 * median)
        return Row(
            name,
            median,
            (max(times) - min(times)) / count,
            found.get("velocity_rmse_m_s"),
            found["range_error_detrended_rms_m"],
        )

    def echoes(self) -> Iterator[Row]:
        """Time of one echo, its difference from the yardstick, and what the recommended method
        makes of it, without noise and turbulence of its level.
        """
        ladar = replace(
            self.ladar,
            record=None,
            world=replace(self.ladar.world, snr_db=None),
            radar=replace(self.ladar.radar, detection="complex"),
        )
        chain, exact = _of_sweeps(self.chains["recommended"]), None
        for name, level in _LADDER.items():
            there = replace(ladar, world=replace(ladar.world, fidelity=level))
            (recording, truth), times = timed(lambda there=there: there.recorded(_draws(self.loaded, 1)), 1)
            exact = recording if exact is None else exact
            trace = traced(chain, recording, "recommended")
            # the echo without motion is made beside
            row = self.row(name, times, chain, trace, truth, 2)
            yield replace(row, echo_error_db=float(error_db(recording.signal.data, exact.signal.data).mean()))

    def methods(self) -> Iterator[Row]:
        """Every method of the processor that works on the recording as it is."""
        for name, chain in self.chains.items():
            if self.loaded.config.processor[name].input != "clean":
                trace, times = timed(lambda chain=chain, name=name: traced(chain, self.recording, name), self.repeats)
                yield self.row(name, times, chain, trace, self.truth, self.recording.signal.trials.numel())

    def settings(self) -> Iterator[Row]:
        """Estimators alone, with other tapers, paddings and upsamplings, on the window of the
        recommended method.
        """
        sweeps, settings = self.sweeps(self.recording), self.loaded.config.trade
        for name, work in _alternatives(settings, self.window_m).items():
            yield self.estimator_row(name, work, sweeps)

    def precisions(self) -> Iterator[Row]:
        """The mirror product in both precisions."""
        sweeps = self.sweeps(self.recording)
        for name in self.loaded.config.trade.precisions:
            yield self.estimator_row(
                name,
                partial(mirror_product, window_m=self.window_m),
                sweeps.with_data(sweeps.data.to(getattr(torch, name))),
            )

    @property
    def window_m(self) -> tuple[float, float] | None:
        windows = [
            getattr(stage, "window_m", None)
            for stage in self.chains["recommended"].stages.values()
            if "velocity_m_s" in getattr(stage, "provides", ())
        ]
        return windows[0] if windows else None

    def sweeps(self, recording: Recording) -> Signal:
        """What enters the estimator of the recommended method."""
        chain = self.chains["recommended"]
        trace = traced(chain, recording, "recommended")
        return next(
            trace.inputs[name]
            for name, stage in chain.stages.items()
            if "velocity_m_s" in getattr(stage, "provides", ())
        )

    def estimator_row(self, name: str, work: Callable[..., Estimate], sweeps: Signal) -> Row:
        stage = _Alone(work, self.ladar.radar)
        chain = Chain(velocity=stage)
        trace, times = timed(lambda: chain.trace(sweeps), self.repeats)
        return self.row(name, times, chain, trace, self.truth, sweeps.trials.numel())


class _Alone(Stage):
    """An estimator as a function (data, radar, pulse) of sweeps, as a stage."""

    works_on = SWEEPS
    provides = ("velocity_m_s",)

    def __init__(self, work: Callable[..., Estimate], radar: TriangularLadar) -> None:
        super().__init__()
        self.work, self.radar = work, radar

    def forward(self, signal: Signal) -> Estimate:
        return self.work(signal.data, self.radar, signal.axis("pulse"))


def _alternatives(settings: Trade, window_m: tuple[float, float] | None) -> dict[str, Callable[..., Estimate]]:
    """Estimators of the velocity with one setting changed after the other."""
    found: dict[str, Callable[..., Estimate]] = {}
    for taper in settings.tapers:
        found[f"mirror product, taper {taper:g}"] = partial(mirror_product, window_m=window_m, taper=taper)
    for intercept in get_args(Intercept):
        found[f"mirror product, intercept {intercept}"] = partial(
            mirror_product, window_m=window_m, intercept=intercept
        )
    for padding in settings.paddings:
        found[f"segmented, padding {padding}"] = partial(segmented_interference, window_m=window_m, padding=padding)
    found["segmented, Hann"] = partial(segmented_interference, window_m=window_m, hann=True)
    for upsampling in settings.upsamplings:
        found[f"correlation, upsampling {upsampling}"] = partial(
            spectrum_correlation, window_m=window_m, upsampling=upsampling
        )
    return found


def _of_sweeps(chain: Chain) -> Chain:
    """The part of a chain that begins with separated sweeps."""
    names = list(chain.stages)
    first = next((i for i, name in enumerate(names) if getattr(chain.stages[name], "works_on", ()) == SWEEPS), 0)
    return Chain(**{name: use(chain.stages[name], **chain.uses[name]) for name in names[first:]})


def _draws(loaded: Loaded, count: int | None = None) -> Draws:
    return Draws(loaded.config.seed, "trade", range(count or loaded.config.trade.trials))


_TITLES = {
    "echo": (
        "ECHO MODELS, without noise: time of one echo, its difference from the yardstick, "
        "and what the recommended method makes of it"
    ),
    "methods": "METHODS of the processor",
    "settings": "SETTINGS of estimators, alone",
    "precision": "PRECISION of the mirror product",
}


def _text(case: str, tables: Tables) -> str:
    parts = [f"case {case!r}" if case else "one case"]
    for key, rows in tables.items():
        echo = "echo (dB)" if key == "echo" else ""
        parts += [
            "",
            _TITLES[key],
            (
                f"{'alternative':<38}{'ms a trial':>12}{'spread':>9}{'velocity (mm/s rms)':>21}"
                f"{'range (nm, detrended)':>23}{echo:>12}"
            ).rstrip(),
        ]
        parts += [_line(row) for row in rows]
    return "\n".join(parts)


def _line(r: Row) -> str:
    velocity = "–" if r.velocity_rmse_m_s is None else f"{1e3 * r.velocity_rmse_m_s:.4f}"
    echo = "" if r.echo_error_db is None else "exact" if r.echo_error_db < -300 else f"{r.echo_error_db:.1f}"
    return (
        f"{r.name:<38}{1e3 * r.seconds:>12.2f}{1e3 * r.spread_s:>9.2f}{velocity:>21}"
        f"{1e9 * r.range_error_detrended_rms_m:>23.3f}{echo:>12}"
    ).rstrip()


def _figures(tables: Tables) -> dict[str, plot.Figure]:
    label = "range error without constant and slope (dB over 1 nm rms)"
    error_db = {
        key: [20 * math.log10(max(1e9 * r.range_error_detrended_rms_m, 1e-3)) for r in rows]
        for key, rows in tables.items()
    }
    return {
        key: plot.trade([r.name for r in rows], [r.seconds for r in rows], error_db[key], label, key)
        for key, rows in tables.items()
    }
