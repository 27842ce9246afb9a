"""Processing of moving points: its limits, the errors of simplifications, and its alternatives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Alternate, Chain, Draws, Signal
from torchsar.echo import bistatic_echo
from torchsar.focus.requirements import Limit, Requirement
from torchsar.metrics import azimuth_response, error_db
from torchsar.multichannel import (
    AlongTrackAutofocus,
    CorrectMigration,
    FlatBand,
    FocusAzimuth,
    GradientVelocity,
    Interferometry,
    Keystone,
    LeastSquares,
    LikelihoodVelocity,
    MigratingLines,
    MinimumMeanSquare,
    MovingPointVelocity,
    MultichannelUse,
    NoMigration,
    Reconstruct,
    RemoveTransmitRange,
    SignalIntensityRatio,
    StaticBulk,
    StationaryImage,
    multichannel_limits,
    multichannel_requirements,
)
from torchsar.multichannel.azimuth import known_motion_chain
from torchsar.multichannel.requirements import Estimator
from torchsar.scene import BandLimited, ExactRange, MovingPoints, TaylorRange
from torchsar.scene.lit_points import LitPoints
from torchsar.study.systems.geo.judge import FocusedPoint, PeakCuts, point_responses, worst_image_error_db
from torchsar.study.systems.geo.world import TRUTHS, Level, Points
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import (
    Alternative,
    Choice,
    DirectlySummed,
    Measured,
    beside_direct_sum,
    points_at_rest,
)
from torchsar.study.trials.system import by_limit

_ESTIMATORS: dict[type, Estimator] = {
    SignalIntensityRatio: "sir",
    Interferometry: "ati",
    AlongTrackAutofocus: "ati",
    LikelihoodVelocity: "ml",
    GradientVelocity: "ml",
    MovingPointVelocity: "ml",
}
# integration time (s) of the source, for targets that are illuminated through an antenna pattern
_PATTERN_S = 4.5
# _LINES: range lines on which two-dimensional chains are compared; they contain the migration of
# any aperture.
# _APERTURES: number of integration times that the pulses cover.
_LINES, _APERTURES = 128, 1.5
# corrections of range migration, and the rows of the requirements that describe their losses
_MIGRATIONS = {
    "none": (NoMigration(), {"kind": "no_migration"}, "no range migration correction"),
    "static_bulk": (
        StaticBulk(True),
        {"kind": "static_bulk", "whole_swath": True},
        "static bulk correction, velocity unknown",
    ),
    "keystone": (Keystone(True), {"kind": "keystone", "whole_swath": True}, ""),
}
_DIMENSIONS = ("azimuth only", "range lines", "full chirps")


def limits(bench: Bench) -> dict[Limit, list[str]]:
    """Return the limits of methods in this scene, with the methods that each concerns."""
    chains = bench.chains.items()
    return by_limit((one, name) for name, c in chains for one in multichannel_limits(bench.radar, use_of(c, bench)))


def requirements(bench: Bench) -> Sequence[Requirement]:
    """Return the errors of simplified processing; nothing if a target is as fast along track as the
    receiver, because no aperture forms then.
    """
    use = use_of(bench.chains["recommended"], bench)
    return multichannel_requirements(bench.radar, use) if bench.radar.speed_m_s > use.u_a_m_s[1] else ()


def use_of(chain: Chain, bench: Bench) -> MultichannelUse:
    """Return the properties of a chain on which its limits and requirements depend, besides the
    radar.

    These are its record, reconstruction, migration correction and estimators, and the ranges of
    velocities and positions of the simulated targets.
    """
    world, stages = bench.world(), list(_stages(chain))
    rebuilds = [s for s in stages if isinstance(s, Reconstruct)]
    # without a reconstruction stage, the intensity ratio separates the bands
    rebuilds = rebuilds or [s for s in stages if isinstance(s, SignalIntensityRatio)]
    estimators: tuple[Estimator, ...] = tuple(
        dict.fromkeys(_ESTIMATORS[type(stage)] for stage in stages if type(stage) in _ESTIMATORS)
    )
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
    """Generate all stages, including those inside of other stages."""
    for stage in chain.stages.values():
        inner = stage.estimator if isinstance(stage, MigratingLines) else stage
        yield from inner.estimators.values() if isinstance(inner, Alternate) else (inner,)


def choices(bench: Bench) -> list[Choice]:
    """Return the choices between alternatives, with losses for the targets of the config without
    noise and with known velocities.
    """
    world, radar, band = bench.world(), bench.radar, _bandwidth_hz(bench)
    movers = world.points(1).movers(radar, Draws(0))
    seen, focused = (LitPoints(movers, world.gate, radar, world.pulses, hz) for hz in (None, band))
    orders = [
        Alternative(
            f"order {n}",
            {"order": n},
            {"image_error_db": focused.transmit_order_db(n)},
            "higher orders",
            f"transmit range of order {n}",
        )
        for n in range(len(radar.transmit_range))
    ]
    migrations = [
        Alternative(
            kind,
            {"migration": _MIGRATIONS[kind][1]},
            {"image_error_db": focused.migration_db(kind == "static_bulk", known=_follows(bench))},
            "migration that remains",
            _MIGRATIONS[kind][2],
        )
        for kind in ("none", "static_bulk")
    ]
    series = [
        Alternative(
            f"order {n}",
            {"kind": "taylor_range", "order": n},
            {"echo_error_db": seen.receive_model_db(TaylorRange(n))},
            "higher orders",
        )
        for n in (2, 4)
    ]
    rebuilds: dict[str, Any] = {
        f"least squares, {n} band{'s' * (n > 1)}": LeastSquares(n) for n in range(1, radar.channels + 1)
    }
    rebuilds["least mean square, pattern, 5 bands"] = MinimumMeanSquare(5)
    if band is not None:
        rebuilds["least mean square, flat band, 5 bands"] = MinimumMeanSquare(5, prior=FlatBand(band))
    rebuilt = [Alternative(name, {"rebuild": one}) for name, one in rebuilds.items()]
    dimensions = [Alternative(name, {"dimensions": name}) for name in _DIMENSIONS]
    precisions = [Alternative(name, {"precision": name}) for name in ("complex64", "complex128")]
    orders.append(Alternative("all orders", {"order": None}, {}))
    migrations.append(Alternative("keystone", {"migration": _MIGRATIONS["keystone"][1]}, {}))
    series.append(Alternative("exact", {"kind": "exact_range"}, {}))
    return [
        Choice("order of the transmit range", "remove_transmit_range.order", orders, partial(_orders, bench)),
        Choice("range migration", "correct_migration.migration", migrations, partial(_migrated, bench)),
        Choice("reconstruction", "reconstruct", rebuilt, partial(_rebuilt, bench)),
        Choice("range to the receiver", "world.receive", series, partial(_received, bench)),
        Choice("dimensions", "world.samples", dimensions, partial(_dimensions, bench)),
        Choice("precision", "precision", precisions, partial(_precisions, bench)),
        beside_direct_sum(partial(_summed, bench), "ambiguities that reconstruction suppresses"),
    ]


def _bandwidth_hz(bench: Bench) -> float | None:
    stages = bench.chains["recommended"].stages.values()
    return next((stage.bandwidth_hz for stage in stages if isinstance(stage, FocusAzimuth)), None)


def _follows(bench: Bench) -> bool:
    """True if the recommended method corrects migration by an estimated velocity."""
    chain = bench.chains["recommended"]
    return any(isinstance(chain.stages[n], CorrectMigration) and bool(used) for n, used in chain.uses.items())


def _alone(bench: Bench, dtype: torch.dtype | None = None, fastest: bool = False, **changes: Any) -> Trials:
    """Simulate clean echoes of the targets, or of the fastest one; by default with azimuth only."""
    world = replace(bench.world(), sea=None, noise=Level(), impairments={}, samples=None, kind="compressed")
    if fastest:
        name = max(world.targets, key=lambda name: abs(float(world.targets[name].u_r_m_s)))
        world = replace(world, targets={name: world.targets[name]})
    if changes.get("samples") is None:
        world = replace(world, targets={name: replace(t, range_m=0.0) for name, t in world.targets.items()})
    return replace(world, **changes).trials_of(bench.radar, bench.draws("trade", [0]), dtype or bench.dtype)


def _image(
    bench: Bench, trials: Trials, band_hz: float | None = None, rebuild: Any = None, **settings: Any
) -> tuple[Signal, FocusedPoint]:
    """Image the targets with their true velocities, in the band that the config focuses."""
    best = LeastSquares(min(2, bench.radar.channels))
    chain = known_motion_chain(bench.radar, rebuild or best, band_hz or _bandwidth_hz(bench), **settings)
    trace = chain.trace(trials.clean, {f"given.{name}": trials.truth[name] for name in TRUTHS})
    focused = FocusedPoint.of(chain, trace, bench.radar)
    assert focused is not None
    return trace.signal, focused


def _compared(exact: Signal, work: Callable[[Alternative], Signal], share: float = 1.0) -> Measured:
    return Measured(work, lambda one, image: {"image_error_db": worst_image_error_db(image, exact)}, lambda one: share)


def _orders(bench: Bench) -> Measured:
    trials = _alone(bench)
    return _compared(_image(bench, trials)[0], lambda one: _image(bench, trials, order=one.keys["order"])[0])


def _cropped(bench: Bench) -> dict[str, Any]:
    """The part of the record in which targets are illuminated for the band that is focused.

    Replicas of other bands have a different migration.
    """
    world = bench.world()
    lit = _PATTERN_S if world.integration_s is None else float(world.integration_s)
    late = max(map(abs, _span(world, "azimuth_m"))) / bench.radar.speed_m_s
    pulses = math.ceil((_APERTURES * lit + 2 * late) * bench.radar.prf_hz)
    return {"gate": BandLimited(lit), "pulses": min(world.pulses, pulses)}


def _migrated(bench: Bench) -> Measured:
    """Measure the loss relative to the response along azimuth times that along range, which
    migration does not change.

    Only that band is focused which is illuminated at every range frequency. Exact imaging, such as
    the keystone transform, stretches the ends of the spectrum along azimuth in proportion to the
    frequency.
    """
    size, radar = _cropped(bench), bench.radar
    slowest = radar.speed_m_s - _span(bench.world(), "u_a_m_s")[1]
    lit_hz = slowest**2 * size["gate"].duration_s / (radar.wavelength_m * radar.reference_range_m)
    inside = 1 - 2 * radar.pulse.bandwidth_hz / radar.carrier_hz
    band = inside * min(lit_hz, _bandwidth_hz(bench) or math.inf)
    trials = _alone(bench, samples=max(_LINES, bench.world().samples or 0), **size)
    line, lines = _image(bench, _alone(bench, torch.complex128, **size), band)[0], trials.clean.signal.axes[2]
    beyond = lines.values() - trials.truth["range_m"][:, None]
    across = torch.sinc(beyond / (radar.wave_speed_m_s / radar.pulse.bandwidth_hz))
    exact = Signal(line.data[..., None] * across[:, None], (*line.axes, lines))
    return _compared(
        exact,
        lambda one: _image(bench, trials, band, migration=_MIGRATIONS[one.name][0], follow=_follows(bench))[0],
        size["pulses"] / bench.world().pulses,
    )


def _precisions(bench: Bench) -> Measured:
    trials = {name: _alone(bench, getattr(torch, name)) for name in ("complex64", "complex128")}
    return _compared(
        _image(bench, trials["complex128"])[0], lambda one: _image(bench, trials[one.keys["precision"]])[0]
    )


def _rebuilt(bench: Bench) -> Measured:
    """Measure the false targets of each reconstruction."""
    trials = _alone(bench)

    def loss(one: Alternative, made: tuple[Signal, FocusedPoint]) -> Mapping[str, float]:
        found = point_responses(*made, trials.truth, trials.own.world.integration_s, bench.judging.orders)
        return {"mfta_db": float(found["mfta_db"].max())}

    return Measured(lambda one: _image(bench, trials, rebuild=one.keys["rebuild"]), loss)


def _received(bench: Bench) -> Measured:
    """Measure the errors of the echoes by each model of the receive range."""

    def echo(one: Alternative, dtype: torch.dtype | None = None) -> Tensor:
        model = TaylorRange(one.keys["order"]) if one.keys["kind"] == "taylor_range" else ExactRange()
        return _alone(bench, dtype, receive=model).clean.signal.data

    exact = _alone(bench, torch.complex128, receive=ExactRange()).clean.signal.data
    return Measured(echo, lambda one, _: {"echo_error_db": float(error_db(echo(one, torch.complex128), exact).max())})


def _dimensions(bench: Bench) -> Measured:
    """Measure the response of the fastest target with azimuth-only data, range-compressed lines and
    full chirps.
    """
    # lines of full echoes are longer, because an echo begins in the middle of the axis
    longer = _LINES + 2 * bench.radar.pulse.n_samples(bench.radar.sampling_hz)
    sizes: tuple[dict[str, Any], ...] = ({}, {"samples": _LINES}, {"samples": longer, "kind": "full"})
    crop = _cropped(bench)
    share = crop["pulses"] / bench.world().pulses / len(bench.world().targets)
    trials = {name: _alone(bench, fastest=True, **crop, **size) for name, size in zip(_DIMENSIONS, sizes, strict=True)}

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

    return Measured(run, loss, lambda one: share)


def _summed(bench: Bench) -> DirectlySummed:
    """Image of points at rest with the bands that are reconstructed for known motion."""
    radar, size = bench.radar, _cropped(bench)
    gate, pulses, samples = size["gate"], size["pulses"], _LINES

    def echo(azimuth_m: Tensor, range_m: Tensor) -> Tensor:
        still = torch.zeros_like(range_m)
        movers = MovingPoints(still, still, azimuth_m, range_m).movers(radar, Draws(0))
        made = bistatic_echo(movers, radar, pulses, samples, gate=gate, dtype=torch.complex128)
        return RemoveTransmitRange(radar)(Signal(made, radar.axes(pulses, samples))).data

    return points_at_rest(
        *(radar, StationaryImage(radar, LeastSquares(min(2, radar.channels))), (pulses, samples), gate.duration_s),
        *(bench.draws(), bench.dtype, echo),
    )
