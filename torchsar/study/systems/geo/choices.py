"""What moving points require of their processor, and the alternatives that it may choose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from torchsar.core import Alternate, Chain, Draws, Signal, use
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement, phase_error_db
from torchsar.metrics import error_db
from torchsar.metrics.moving_point import FocusedPoint, PeakCuts, point_responses
from torchsar.metrics.replicas import azimuth_response
from torchsar.multichannel import (
    CompressChannels,
    CorrectMigration,
    FlatBand,
    FocusAzimuth,
    Keystone,
    LeastSquares,
    MinimumMeanSquare,
    MultichannelUse,
    NoMigration,
    Reconstruct,
    RemoveTransmitRange,
    StaticBulk,
    multichannel_limits,
    multichannel_requirements,
)
from torchsar.multichannel.requirements import Estimator
from torchsar.multichannel.velocity import (
    AlongTrackAutofocus,
    GradientVelocity,
    Interferometry,
    LikelihoodVelocity,
    MovingPointVelocity,
    SignalIntensityRatio,
)
from torchsar.multichannel.velocity.migrating import MigratingLines
from torchsar.radar import receive_range
from torchsar.scene import ExactRange, TaylorRange
from torchsar.scene.moving import ReceiveRange
from torchsar.study.systems.geo.world import Level, Points
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured

_ESTIMATORS: dict[type, Estimator] = {
    SignalIntensityRatio: "sir",
    Interferometry: "ati",
    AlongTrackAutofocus: "ati",
    LikelihoodVelocity: "ml",
    GradientVelocity: "ml",
    MovingPointVelocity: "ml",
}
# integration time (s) of the source, for targets that are seen through a pattern
_PATTERN_S = 4.5
# range lines on which two-dimensional chains are compared; they hold the migration of any aperture
_LINES = 128
# samples of slow time and of the band on which neglected phases are evaluated
_TIMES, _BAND = 129, 17
_GIVEN = {name: f"given.{name}" for name in ("u_r_m_s", "u_a_m_s", "y0_m")}
_MIGRATIONS = {"none": NoMigration(), "static_bulk": StaticBulk(True), "keystone": Keystone(True)}


def limits(bench: Bench) -> dict[Limit, list[str]]:
    """Limits, each with the methods that it concerns."""
    found: dict[Limit, list[str]] = {}
    for name, chain in bench.chains.items():
        for limit in multichannel_limits(bench.radar, use_of(chain, bench)):
            found.setdefault(limit, []).append(name)
    return found


def requirements(bench: Bench) -> Sequence[Requirement]:
    """What simplifications neglect; nothing where no aperture forms."""
    use = use_of(bench.chains["recommended"], bench)
    return multichannel_requirements(bench.radar, use) if bench.radar.speed_m_s > use.u_a_m_s[1] else ()


def use_of(chain: Chain, bench: Bench) -> MultichannelUse:
    """How a chain uses the radar; the targets of the world bound the velocities."""
    world, stages = bench.world(), list(_stages(chain))
    rebuilds = [s for s in stages if isinstance(s, Reconstruct)]
    # without a reconstruction the intensity ratio tells bands apart
    rebuilds = rebuilds or [s for s in stages if isinstance(s, SignalIntensityRatio)]
    estimators = tuple(dict.fromkeys(_ESTIMATORS[type(stage)] for stage in stages if type(stage) in _ESTIMATORS))
    migrations = [stage.migration for stage in stages if isinstance(stage, CorrectMigration)]
    snr, lit = world.snr_db(bench.radar), world.integration_s
    return MultichannelUse(
        world.pulses,
        _PATTERN_S if lit is None else float(lit),
        rebuilds[-1].rebuild if rebuilds else LeastSquares(1),
        lit is None,
        *(_span(world, name) for name in ("u_r_m_s", "u_a_m_s")),
        y0_m=max(map(abs, _span(world, "azimuth_m"))),
        swath_m=0.0 if world.samples is None else max(map(abs, _span(world, "range_m"))),
        snr_db=None if snr is None else float(snr),
        clutter=world.sea is not None,
        estimators=estimators,
        deramped=all(isinstance(migration, Keystone) for migration in migrations),
        dtype=bench.dtype,
    )


def _span(world: Points, name: str) -> tuple[float, float]:
    values = [float(getattr(target, name)) for target in world.targets.values()]
    return min(values), max(values)


def _stages(chain: Chain) -> Iterable[Any]:
    """All stages, those inside of others too."""
    for stage in chain.stages.values():
        inner = stage.estimator if isinstance(stage, MigratingLines) else stage
        yield from inner.estimators.values() if isinstance(inner, Alternate) else (inner,)


def choices(bench: Bench) -> list[Choice]:
    """The decisions of a config, on its targets without noise, with their true velocities."""
    radar, channels = bench.radar, bench.radar.channels
    orders = [
        Alternative(f"order {order}", {"order": order}, {"image_error_db": _transmit_db(bench, order)}, "higher orders")
        for order in range(len(radar.transmit_range))
    ]
    orders.append(Alternative("all orders", {"order": None}, {}))
    migrations = [
        Alternative(name, {"kind": name}, {"image_error_db": _migration_db(bench, name)}, "migration that remains")
        for name in ("none", "static_bulk")
    ]
    migrations.append(Alternative("keystone", {"kind": "keystone", "whole_swath": True}, {}))
    series = [
        Alternative(
            f"order {n}", {"kind": "taylor", "order": n}, {"echo_error_db": _series_db(bench, n)}, "higher orders"
        )
        for n in (2, 4)
    ]
    rebuilds = [
        Alternative(f"least squares, {n} band{'s' * (n > 1)}", {"rebuild": LeastSquares(n)})
        for n in range(1, channels + 1)
    ]
    rebuilds.append(Alternative("least mean square, pattern, 5 bands", {"rebuild": MinimumMeanSquare(5)}))
    if (band := _bandwidth_hz(bench)) is not None:
        prior = MinimumMeanSquare(5, prior=FlatBand(band))
        rebuilds.append(Alternative("least mean square, flat band, 5 bands", {"rebuild": prior}))
    dimensions = [Alternative(name, {"dimensions": name}) for name in ("azimuth only", "range lines", "full chirps")]
    precisions = [Alternative(name, {"precision": name}) for name in ("complex64", "complex128")]
    exact = Alternative("exact", {"kind": "exact"}, {})
    return [
        Choice("order of the transmit range", "transmit_range_remove.order", orders, partial(_orders, bench)),
        Choice("range migration", "migration_correct.kind", migrations, partial(_migrated, bench)),
        Choice("reconstruction", "rebuild_bands", rebuilds, partial(_rebuilt, bench)),
        Choice("range to the receiver", "world.receive", [*series, exact], partial(_received, bench)),
        Choice("dimensions", "world.samples", dimensions, partial(_dimensions, bench)),
        Choice("precision", "precision", precisions, partial(_precisions, bench)),
    ]


def _bandwidth_hz(bench: Bench) -> float | None:
    stages = bench.chains["recommended"].stages.values()
    return next((stage.bandwidth_hz for stage in stages if isinstance(stage, FocusAzimuth)), None)


# predicted losses, of the worst target of the world


def _times(bench: Bench) -> Tensor:
    lit = bench.world().integration_s
    return (_PATTERN_S if lit is None else float(lit)) * torch.linspace(-0.5, 0.5, _TIMES, dtype=torch.float64)


def _histories(bench: Bench, model: ReceiveRange) -> Tensor:
    """Ranges to the receiver beyond the closest ones, (target, channel, pulse)."""
    world = bench.world()
    movers = world.points(1).movers(bench.radar, Draws(0)).each(lambda x: x.reshape(-1))
    return (model.range_m(movers, _times(bench), bench.radar) - movers.range_m).movedim(-1, 0)


def _transmit_db(bench: Bench, order: int) -> float:
    """By the orders of the transmit range that are left, over the time for which targets are lit."""
    left, time_s = bench.radar.transmit_range[order:], _times(bench)
    metres = sum((k * time_s ** (order + i) for i, k in enumerate(left, 1)), torch.zeros_like(time_s))
    return phase_error_db(2 * math.pi / bench.radar.wavelength_m * metres)


def _migration_db(bench: Bench, kind: str) -> float:
    """By the migration that is left over the band; a shift of pulses leaves none where the method
    knows the velocity, and the walk of the target where it does not.
    """
    radar, time_s = bench.radar, _times(bench)
    band = torch.linspace(-0.5, 0.5, _BAND, dtype=torch.float64) * 2 * math.pi * radar.pulse.bandwidth_hz
    left = _histories(bench, ExactRange())
    if kind == "static_bulk":
        at_rest = receive_range(time_s, 0.0, 0.0, 0.0, radar.reference_range_m, radar.speed_m_s, 0.0)
        left = torch.zeros_like(left) if _follows(bench) else left - at_rest
    return max(phase_error_db(band / radar.wave_speed_m_s * path[..., None]) for path in left)


def _follows(bench: Bench) -> bool:
    """Whether the recommended method corrects migration by an estimated velocity."""
    chain = bench.chains["recommended"]
    return any(isinstance(chain.stages[n], CorrectMigration) and bool(used) for n, used in chain.uses.items())


def _series_db(bench: Bench, order: int) -> float:
    """By the orders of the receive range that an echo leaves out."""
    left = _histories(bench, TaylorRange(order)) - _histories(bench, ExactRange())
    return max(phase_error_db(2 * math.pi / bench.radar.wavelength_m * path) for path in left)


# measured losses, of the worst target of the world


def _alone(bench: Bench, dtype: torch.dtype | None = None, fastest: bool = False, **changes: Any) -> Trials:
    """Clean echoes of the targets, or of the fastest one, azimuth only unless changed."""
    world = replace(bench.world(), sea=None, noise=Level(), impairments={}, samples=None, kind="compressed")
    if fastest:
        name = max(world.targets, key=lambda name: abs(float(world.targets[name].u_r_m_s)))
        world = replace(world, targets={name: world.targets[name]})
    if changes.get("samples") is None:
        world = replace(world, targets={name: replace(t, range_m=0.0) for name, t in world.targets.items()})
    draws = Draws(bench.config.seed, "trade", [0])
    return replace(world, **changes).trials_of(bench.radar, draws, dtype or bench.dtype)


def _image(
    bench: Bench,
    trials: Trials,
    rebuild: Any = None,
    migration: Any = None,
    order: int | None = None,
    full: bool = False,
    follow: bool = True,
) -> tuple[Signal, FocusedPoint]:
    """Images of the targets with their true velocities; migration None for azimuth-only data."""
    radar = bench.radar
    stages: dict[str, nn.Module] = {"compress": CompressChannels(radar, "flat")} if full else {}
    stages["remove"] = RemoveTransmitRange(radar, order)
    if migration is not None:
        stages["correct"] = use(CorrectMigration(radar, migration), **(_GIVEN if follow else {}))
    stages["rebuild"] = use(Reconstruct(radar, rebuild or LeastSquares(min(2, radar.channels))), **_GIVEN)
    stages["focus"] = use(FocusAzimuth(radar, _bandwidth_hz(bench)), **_GIVEN, range_m="given.range_m")
    chain = Chain(**stages)
    known = {f"given.{name}": trials.truth[name] for name in (*_GIVEN, "range_m")}
    trace = chain.trace(trials.clean, known)
    focused = FocusedPoint.of(chain, trace, radar)
    assert focused is not None
    return trace.signal, focused


def _worst_db(image: Signal, exact: Signal) -> float:
    """Largest difference of the images of a target."""
    two = [x.data.to(torch.complex128).reshape(len(x.data), -1, x.data.shape[-1]) for x in (image, exact)]
    two = [x if "range" in image.names else x.mT for x in two]
    return float(error_db(*two).max())


def _compared(bench: Bench, exact: Signal, work: Any) -> Measured:
    return Measured(work, lambda one, image: {"image_error_db": _worst_db(image, exact)})


def _orders(bench: Bench) -> Measured:
    trials = _alone(bench)
    return _compared(bench, _image(bench, trials)[0], lambda one: _image(bench, trials, order=one.keys["order"])[0])


def _migrated(bench: Bench) -> Measured:
    trials = _alone(bench, fastest=True, samples=_LINES)

    def run(one: Alternative) -> Signal:
        return _image(bench, trials, migration=_MIGRATIONS[one.keys["kind"]], follow=_follows(bench))[0]

    line, lines = _image(bench, _alone(bench, torch.complex128, fastest=True))[0], trials.clean.signal.axes[2]
    # without migration the response is that along azimuth times that along range
    beyond = lines.values() - trials.truth["range_m"][:, None]
    across = torch.sinc(beyond / (bench.radar.wave_speed_m_s / bench.radar.pulse.bandwidth_hz))
    exact = Signal(line.data[..., None] * across[:, None], (*line.axes, lines))
    return _compared(bench, exact, run)


def _precisions(bench: Bench) -> Measured:
    trials = {name: _alone(bench, getattr(torch, name)) for name in ("complex64", "complex128")}
    exact = _image(bench, trials["complex128"])[0]
    return _compared(bench, exact, lambda one: _image(bench, trials[one.keys["precision"]])[0])


def _rebuilt(bench: Bench) -> Measured:
    """False targets by each reconstruction."""
    trials = _alone(bench)

    def loss(one: Alternative, made: tuple[Signal, FocusedPoint]) -> Mapping[str, float]:
        found = point_responses(*made, trials.truth, trials.own.integration_s, bench.judging.orders)
        return {"mfta_db": float(found["mfta_db"].max())}

    return Measured(lambda one: _image(bench, trials, rebuild=one.keys["rebuild"]), loss)


def _received(bench: Bench) -> Measured:
    """Echoes by each model of the receive range."""
    models = {"order 2": TaylorRange(2), "order 4": TaylorRange(4), "exact": ExactRange()}
    exact = _alone(bench, torch.complex128).clean.signal.data

    def loss(one: Alternative, _: Trials) -> dict[str, float]:
        made = _alone(bench, torch.complex128, receive=models[one.name]).clean.signal.data
        return {"echo_error_db": float(error_db(made, exact).max())}

    return Measured(lambda one: _alone(bench, receive=models[one.name]), loss)


def _dimensions(bench: Bench) -> Measured:
    """The same targets by azimuth-only data, range-compressed lines and full chirps."""
    radar = bench.radar
    # echoes begin at the middle of the axis
    longer = _LINES + 2 * radar.pulse.n_samples(radar.sampling_hz)
    sizes = {"azimuth only": {}, "range lines": {"samples": _LINES}}
    sizes["full chirps"] = {"samples": longer, "kind": "full"}
    trials = {name: _alone(bench, fastest=True, **size) for name, size in sizes.items()}

    def run(one: Alternative) -> Signal:
        kind = one.keys["dimensions"]
        migration = None if kind == "azimuth only" else Keystone()
        return _image(bench, trials[kind], migration=migration, full=kind == "full chirps")[0]

    def width(image: Signal) -> Tensor:
        cuts = PeakCuts.of(image, torch.ones(len(image.data), dtype=torch.float64), 1.0)
        return azimuth_response(cuts.azimuth, 1.0)["irw_m"]

    exact = width(run(Alternative("full chirps", {"dimensions": "full chirps"})))

    def loss(one: Alternative, image: Signal) -> dict[str, float]:
        return {"width_change_percent": float((100 * (width(image) / exact - 1)).abs().max())}

    return Measured(run, loss)
