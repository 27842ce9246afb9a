"""`torchsar trade` for turning targets: time against phase error of methods, iterations, precisions
and echo models.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from torchsar import plot
from torchsar.compensate import autofocus, correct_pulse_phase
from torchsar.core import Chain, Draws, Recording, Truth
from torchsar.echo import simulate_turntable
from torchsar.focus import CompressDechirped, azimuth_transform
from torchsar.metrics import entropy, phase_rmse
from torchsar.radar import InverseRadar
from torchsar.scene import Dechirped, PhaseOnly, TurntableWorld
from torchsar.study.build import build_impairments
from torchsar.study.cases import cases_of
from torchsar.study.config import Loaded
from torchsar.study.isal.build import build_radar, build_world, check
from torchsar.study.isal.judge import estimated_phase
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.isal.trials import received, whole_phase
from torchsar.study.methods import build_chains
from torchsar.study.settings.errors import ConfigError
from torchsar.study.tracing import traced
from torchsar.study.trading import Tables, timed, written

log = logging.getLogger("torchsar")


@dataclass(frozen=True)
class Row:
    """One alternative: median seconds a trial over the repeats, their spread, rms phase error (rad)
    and entropy above the ideal image (nats), means over trials.
    """

    name: str
    seconds: float
    spread_s: float
    error_rad: float
    entropy_above_ideal_nats: float


def trade(loaded: Loaded, out: Path | None) -> str:
    """Tables of methods, of iterations of `autofocus`, of precisions, and of the echo models, on
    the last case of a config; returns them as text.

    With `out`: config.yaml, trade.json, trade.txt and figures/ in that folder. Raises ConfigError
    for recordings, whose phases are not known.
    """
    if loaded.config.data.file is not None or loaded.config.world is None:
        raise ConfigError(
            f"{loaded.file}: trade compares with true phases, which a recording does not tell; "
            "take a config that simulates"
        )
    check(loaded)
    name, case = list(cases_of(loaded).items())[-1]
    return written(loaded, out, lambda: _tables(case), lambda tables: _text(name, tables), _figures)


def _figures(tables: Tables) -> dict[str, plot.Figure]:
    label = "residual phase (rad rms)"
    return {
        key: plot.trade(
            [r.name for r in tables[key]],
            [r.seconds for r in tables[key]],
            [r.error_rad for r in tables[key]],
            label,
            key,
        )
        for key in ("methods", "iterations", "precision")
    }


@dataclass(frozen=True)
class _Trials:
    """Simulated trials: their recording and truth, and the radar."""

    radar: InverseRadar
    recording: Recording
    truth: Truth

    @property
    def data(self) -> Tensor:
        return self.recording.signal.data

    def compressed(self) -> _Trials:
        """Dechirped pulses after range compression, the clean ones likewise."""
        stage = CompressDechirped(self.radar)
        clean = None if self.truth.clean is None else replace(self.truth.clean, signal=stage(self.truth.clean.signal))
        return _Trials(
            self.radar, replace(self.recording, signal=stage(self.recording.signal)), replace(self.truth, clean=clean)
        )

    def row(self, name: str, data: Tensor, work: Callable[[Tensor], Tensor], repeats: int) -> Row:
        """The alternative `work`: data to phases."""
        phase, times = timed(lambda: work(data), repeats)
        assert self.truth.clean is not None
        error = phase_rmse(phase, whole_phase(self.truth), received(self.truth))
        gained = entropy(azimuth_transform(correct_pulse_phase(data, phase))) - entropy(
            azimuth_transform(self.truth.clean.signal.data.to(data.dtype))
        )
        count = max(1, error.numel())
        log.info("%s: %.1f ms, %.3f rad", name, 1e3 * statistics.median(times) / count, float(error.mean()))
        return Row(
            name,
            statistics.median(times) / count,
            (max(times) - min(times)) / count,
            float(error.mean()),
            float(gained.mean()),
        )


def _tables(loaded: Loaded) -> dict[str, list[Row]]:
    """Raises ConfigError for what simulation or methods refuse."""
    try:
        return _made_tables(loaded)
    except (ValueError, TypeError, RuntimeError) as error:
        raise ConfigError(f"{loaded.file}: {' '.join(str(error).split())}") from error


@torch.no_grad()
def _made_tables(loaded: Loaded) -> dict[str, list[Row]]:
    world = build_world(loaded)
    still = replace(world, fidelity=PhaseOnly())
    made = _simulate(loaded, world, torch.complex64)
    flat = made if isinstance(world.fidelity, PhaseOnly) else _simulate(loaded, still, torch.complex64)
    tables = {
        "methods": list(_methods(loaded, made)),
        "iterations": list(_iterations(loaded, flat)),
        "precision": list(_precisions(loaded, still)),
    }
    if loaded.config.radar.pulse_s is not None:
        tables["echo"] = list(_echoes(loaded))
    return tables


def _simulate(loaded: Loaded, world: TurntableWorld, dtype: torch.dtype, count: int | None = None) -> _Trials:
    size, radar = loaded.config.world, build_radar(loaded)
    impairments = build_impairments(size.impairments, "world.impairments", loaded.file, TARGET_IMPAIRMENTS)
    recording, truth = simulate_turntable(
        radar,
        world,
        size.pulses,
        size.samples,
        Draws(loaded.config.seed, "trade", range(count or loaded.config.trade.trials)),
        impairments,
        dtype,
    )
    return _Trials(radar, recording, truth)


def _methods(loaded: Loaded, made: _Trials) -> Iterator[Row]:
    """Every method of the processor that works on the recording as it is, beside the image of those
    that see the clean one.
    """
    chains = build_chains(loaded, radar=made.radar)
    assert made.truth.clean is not None
    clean = [name for name in chains if loaded.config.processor[name].input == "clean"]
    ideal = entropy(traced(chains[clean[0]], made.truth.clean, clean[0]).signal) if clean else torch.tensor(math.nan)
    for name, chain in chains.items():
        if name not in clean:
            yield _method_row(name, chain, made, ideal, loaded.config.trade.repeats)


def _method_row(name: str, chain: Chain, made: _Trials, ideal: Tensor, repeats: int) -> Row:
    trace, times = timed(lambda: traced(chain, made.recording, name), repeats)
    truth = whole_phase(made.truth)
    error = phase_rmse(estimated_phase(chain, trace, truth), truth, received(made.truth))
    gained = entropy(trace.signal) - ideal if trace.signal.names == ("azimuth", "range") else torch.tensor(math.nan)
    count = max(1, error.numel())
    log.info("%s: %.1f ms, %.3f rad", name, 1e3 * statistics.median(times) / count, float(error.mean()))
    return Row(
        name,
        statistics.median(times) / count,
        (max(times) - min(times)) / count,
        float(error.mean()),
        float(gained.mean()),
    )


def _iterations(loaded: Loaded, made: _Trials) -> Iterator[Row]:
    """The recommended method with fewer iterations."""
    settings = loaded.config.trade
    deepest = max(settings.search)
    for search in settings.search:
        yield made.row(
            f"search {search}, polish 0",
            made.data,
            lambda x, s=search: autofocus(x, search=s, polish=0)["phase_rad"],
            settings.repeats,
        )
    for polish in settings.polish:
        yield made.row(
            f"search {deepest}, polish {polish}",
            made.data,
            lambda x, p=polish: autofocus(x, search=deepest, polish=p)["phase_rad"],
            settings.repeats,
        )


def _precisions(loaded: Loaded, world: TurntableWorld) -> Iterator[Row]:
    made = _simulate(loaded, world, torch.complex128)
    for name in loaded.config.trade.precisions:
        yield made.row(
            name, made.data.to(getattr(torch, name)), lambda x: autofocus(x)["phase_rad"], loaded.config.trade.repeats
        )


def _echoes(loaded: Loaded) -> Iterator[Row]:
    """Phases alone against dechirped pulses with the motion inside them: seconds of one echo, and
    what can be made of it.

    Of a dechirped config that is the recommended method's; else `autofocus` of the compressed
    pulses, without alignment of envelopes.
    """
    world = build_world(loaded)
    for name in ("phase_only", "dechirped"):
        own = isinstance(world.fidelity, Dechirped)
        fidelity = PhaseOnly() if name == "phase_only" else world.fidelity if own else Dechirped()
        made, times = timed(
            lambda fidelity=fidelity: _simulate(loaded, replace(world, fidelity=fidelity), torch.complex64, 2), 1
        )
        if name == "dechirped" and own:
            row = next(r for r in _methods(loaded, made) if r.name == "recommended")
        else:
            made = made if name == "phase_only" else made.compressed()
            row = made.row(name, made.data, lambda x: autofocus(x)["phase_rad"], 1)
        yield replace(row, name=name, seconds=times[0] / 2, spread_s=0.0)


_TITLES = {
    "methods": "METHODS of the processor",
    "iterations": "ITERATIONS of the recommended method",
    "precision": "PRECISION of the recommended method",
    "echo": "ECHO MODELS: time of one echo, and what the recommended method makes of it",
}


def _text(case: str, tables: Tables) -> str:
    parts = [f"case {case!r}" if case else "one case"]
    for key, rows in tables.items():
        parts += [
            "",
            _TITLES[key],
            f"{'alternative':<30}{'ms a trial':>12}{'spread':>9}{'error (rad rms)':>17}{'entropy above ideal':>21}",
        ]
        parts += _lines(rows)
    return "\n".join(parts)


def _lines(rows: Sequence[Row]) -> list[str]:
    return [
        f"{r.name:<30}{1e3 * r.seconds:>12.2f}{1e3 * r.spread_s:>9.2f}{r.error_rad:>17.4f}"
        f"{r.entropy_above_ideal_nats:>21.3f}"
        for r in rows
    ]
