"""Alternatives for a strip: form of the focusing, precision, range history, jitter correction."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Truth
from torchsar.echo import simulate
from torchsar.echo.jitter import sample_unevenly
from torchsar.focus.patches import HALF, PointPatches
from torchsar.focus.requirements import EQUAL_WEIGHTS, Requirement, full_swath_m, requirements
from torchsar.metrics import error_after_gain_db, error_db
from torchsar.radar import StripmapRadar
from torchsar.repair.jitter import BandLimited, Exact, Lagrange
from torchsar.scene import Dwell, Hyperbola, Parabola, Points, StripmapWorld
from torchsar.study.names.registry import GROUPS
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import (
    PIXELS,
    Alternative,
    Choice,
    DirectlySummed,
    Measured,
    beside_direct_sum,
    points_of_a_strip,
)

# timing offsets in samples of a period of four, as in Tsvetkov 2017, and enough raw lines to
# measure the time
_OFFSETS, _LINES = (0.0, 0.18, -0.12, 0.07), 1024
FORMS = {
    "range_doppler": "range-Doppler",
    "omega_k": "bulk + refocus (omega_k)",
    "omega_k_stolt": EQUAL_WEIGHTS,
}


@dataclass(frozen=True)
class StripProbe:
    """Point targets at both edges and in the middle of the swath, without noise or impairments.

    Args:
        radar: Radar parameters.
        world: The points, seen with the true Doppler and velocity.
        size: Number of lines and number of samples in a line.
        edges_m: Ranges of the points in metres, relative to the middle of the fully compressed part
            of a line.
    """

    radar: StripmapRadar
    world: StripmapWorld
    size: tuple[int, int]
    edges_m: tuple[float, ...] = (0.0,)

    def between_edges(self) -> StripProbe:
        """Return this probe with points at both edges and the middle of the focused swath."""
        radar, size = self.radar, self.size
        margin = (HALF + 1) * radar.range_step_m
        near, far = full_swath_m(radar, radar.raw_axes(*size), *self.motion, self.dwell_s)
        middle = radar.near_range_m + max(0, size[1] - radar.pulse_samples) / 2 * radar.range_step_m
        edges = (min(0.0, near - middle + margin), 0.0, max(0.0, far - middle - margin))
        return replace(self, world=replace(self.world, scene=Points([0.0] * 3, [*edges])), edges_m=edges)

    @property
    def dwell_s(self) -> float:
        """Time in s for which targets are illuminated."""
        radar = self.radar
        known = getattr(self.world.beam, "dwell_s", None) or radar.integration_s
        return float(known or radar.aperture_s(radar.near_range_m))

    @property
    def motion(self) -> tuple[float, float]:
        """Doppler of the beam centre (Hz) and velocity (m/s), of the first trial."""
        world, radar = self.world, self.radar
        doppler = (radar.pointing_doppler_hz or 0.0) if world.doppler_hz is None else world.doppler_hz
        velocity = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
        first = [float(torch.as_tensor(x).reshape(-1)[0]) for x in (doppler, velocity)]
        return first[0], first[1]

    def recorded(self, dtype: torch.dtype, **changes: Any) -> tuple[Recording, Truth]:
        """Simulate the recording and its true values; `changes` replaces fields of the world."""
        return simulate(self.radar, replace(self.world, **changes), *self.size, Draws(0), dtype=dtype)

    def seen(self) -> tuple[Signal, PointPatches, tuple[Tensor, Tensor]]:
        """Simulate the points in double precision.

        Returns:
            The raw data; the patches of an image about the points; and the true Doppler of the beam
            centre (Hz) and velocity (m/s).
        """
        recording, truth = self.recorded(torch.complex128)
        of = truth.values
        known = (of["doppler_hz"], of["velocity_m_s"])
        at = (of["zero_doppler_s"], of["closest_range_m"])
        return recording.signal, PointPatches.about(self.radar, self.size, *at, *known), known

    def rows(self) -> tuple[Requirement, ...]:
        """Return the errors of each simplified focusing for this size, Doppler and velocity."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an aliased aperture is reported among the limits
            return requirements(self.radar, self.radar.raw_axes(*self.size), *self.motion)


def probe_of(bench: Bench) -> StripProbe:
    """Return point targets at the edges and in the middle of the swath of a config.

    They have the Doppler and velocity of the simulated world, or for a recording those that the
    recommended method estimates.
    """
    radar = bench.radar
    if bench.recording is None:
        world = bench.world()
        size, seen = (world.lines, world.samples), world.of(radar)
    else:
        used = bench.batch(Draws(0), methods=("recommended",)).outcomes["recommended"].judged.view
        pulse, sample = bench.recording.signal.axes
        size = (pulse.n, sample.n)
        doppler, velocity = float(used.doppler_hz or 0.0), float(used.velocity_m_s)
        dwell = radar.integration_s or 0.75 * radar.aperture_s(radar.near_range_m)
        seen = StripmapWorld(Points([0.0], [0.0]), Dwell(dwell), Hyperbola(), velocity, doppler)
    return StripProbe(radar, replace(seen, snr_db=None), size).between_edges()


def choices(bench: Bench, rows: Mapping[str, Requirement]) -> list[Choice]:
    """Return the choices between alternatives that a config has.

    Args:
        bench: Bench of the config.
        rows: What simplified focusing neglects, by name of the effect.
    """
    forms = [
        Alternative(name, {"stage": name}, {"image_error_db": rows[row].error_db}, rows[row].neglects, row)
        for name, row in FORMS.items()
    ]
    exact = Alternative("backprojection, complex128, times extrapolated from patches")
    precisions = [Alternative(name, {"precision": name}) for name in ("complex64", "complex128")]
    found = [
        Choice("focusing form", "stage", forms, partial(_forms, bench), exact),
        Choice("precision", "precision", precisions, partial(_precisions, bench)),
        beside_direct_sum(partial(_summed, bench), "change of migration over the swath"),
    ]
    if bench.recording is None:
        probe = probe_of(bench)
        lost = Parabola().neglected_db(bench.radar, *probe.motion, bench.radar.near_range_m, probe.dwell_s)
        histories = [
            Alternative("parabola", {"kind": "parabola"}, {"echo_error_db": lost}, "higher orders"),
            Alternative("hyperbola", {"kind": "hyperbola"}, {}),
        ]
        found.append(Choice("range history", "world.path", histories, partial(_histories, bench)))
    stages = (bench.config.processor["recommended"].stages or {}).values()
    if any("jitter" in entry["stage"] for entry in stages):
        correctors = [Alternative(name, {"corrector": c}) for name, c in _CORRECTORS.items()]
        found.append(Choice("jitter correction", "stage of the name jitter", correctors, partial(_jitter, bench)))
    return found


def _focused(bench: Bench, form: str, signal: Signal, known: tuple[Tensor, Tensor]) -> Tensor:
    """Focus a signal by a form, with given Doppler and velocity."""
    return GROUPS["focus"][form](bench.radar, "matched", velocity_m_s=known[1], doppler_hz=known[0])(signal).data


def _forms(bench: Bench) -> Measured:
    """Measure whole images by each form, relative to backprojection of patches around the
    points.
    """
    probe = probe_of(bench)
    raw, patches, known = probe.seen()
    signal, exact = raw.to(bench.dtype), patches.exact(raw, *known)

    def run(one: Alternative) -> Tensor:
        return _focused(bench, one.keys["stage"], signal, known) if one.keys else patches.exact(raw, *known)

    def loss(one: Alternative, image: Tensor) -> dict[str, float]:
        made = patches.cut(image) if one.keys else image
        return {"image_error_db": float(error_after_gain_db(made, exact).max())}

    return Measured(run, loss, lambda one: 1.0 if one.keys else exact.numel() / signal.data.numel())


def _form_of(bench: Bench) -> str:
    """Form of focusing of the recommended method."""
    names = [entry["stage"] for entry in (bench.config.processor["recommended"].stages or {}).values()]
    return next((name for name in names if name in FORMS), "omega_k")


def _summed(bench: Bench) -> DirectlySummed:
    """Image of points at random positions of the swath, by the recommended form."""
    probe, radar = probe_of(bench), bench.radar
    reach = max(0.0, probe.size[0] / radar.prf_hz - probe.dwell_s) / 2 * radar.velocity_m_s
    at = bench.draws().uniform("trade.points", (2, PIXELS))
    low, high = min(probe.edges_m), max(probe.edges_m)
    scene = Points(((2 * at[0] - 1) * reach).tolist(), (low + at[1] * (high - low)).tolist())
    recording, truth = replace(probe, world=replace(probe.world, scene=scene)).recorded(torch.complex128)
    raw, used, of = recording.signal, recording.signal.to(bench.dtype), truth.values
    places, known = (of["zero_doppler_s"], of["closest_range_m"]), (of["doppler_hz"], of["velocity_m_s"])
    return points_of_a_strip(radar, raw, *places, *probe.motion, lambda: _focused(bench, _form_of(bench), used, known))


def _precisions(bench: Bench) -> Measured:
    """Measure the recommended form in single precision, relative to double precision."""
    probe = probe_of(bench)
    raw, patches, known = probe.seen()
    form = _form_of(bench)
    signals = {name: raw.to(getattr(torch, name)) for name in ("complex64", "complex128")}
    exact = patches.cut(_focused(bench, form, raw, known))

    def loss(one: Alternative, image: Tensor) -> dict[str, float]:
        return {"image_error_db": float(error_after_gain_db(patches.cut(image), exact).max())}

    return Measured(lambda one: _focused(bench, form, signals[one.keys["precision"]], known), loss)


def _histories(bench: Bench) -> Measured:
    """Measure echoes of single points by each range history."""
    probe, paths = probe_of(bench), {"parabola": Parabola(), "hyperbola": Hyperbola()}
    alone = [replace(probe, world=replace(probe.world, scene=Points([0.0], [r]))) for r in probe.edges_m]

    def echoes(path: str) -> list[Tensor]:
        return [point.recorded(torch.complex128, path=paths[path])[0].signal.data for point in alone]

    exact = echoes("hyperbola")

    def loss(one: Alternative, _: Tensor) -> dict[str, float]:
        made = echoes(one.keys["kind"])
        return {"echo_error_db": max(float(error_db(a, b)) for a, b in zip(made, exact, strict=True))}

    return Measured(lambda one: probe.recorded(bench.dtype, path=paths[one.keys["kind"]])[0].signal.data, loss)


_CORRECTORS: dict[str, Any] = {
    "none": None,
    "Lagrange, 4 points": Lagrange(4),
    "Lagrange, 8 points": Lagrange(8),
    "band-limited, 8 points": BandLimited(8),
    "Lagrange, 12 points": Lagrange(12),
    "exact": Exact(),
}


def _jitter(bench: Bench) -> Measured:
    """Measure correctors of a known periodic jitter on the first lines of raw data."""
    raw = probe_of(bench).recorded(bench.dtype)[0].signal.data
    lit = raw.abs().square().sum(-1).argmax()
    raw = raw[max(0, int(lit) - _LINES // 2) :][:_LINES]
    offsets = torch.tensor(_OFFSETS, dtype=torch.float64)
    uneven = sample_unevenly(raw, offsets)

    def run(one: Alternative) -> Tensor:
        corrector = one.keys["corrector"]
        return uneven if corrector is None else corrector(uneven, offsets)

    return Measured(run, lambda one, fixed: {"data_error_db": float(error_db(fixed, raw))})
