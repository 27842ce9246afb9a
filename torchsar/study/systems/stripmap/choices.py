"""What a strip may choose: the form of the focusing, precision, range history, jitter correction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Recording, Signal, Truth
from torchsar.echo import simulate
from torchsar.echo.jitter import sample_unevenly
from torchsar.focus import Backproject
from torchsar.focus.requirements import Requirement, full_swath_m, phase_error_db, requirements
from torchsar.metrics import error_db
from torchsar.radar import StripmapRadar
from torchsar.repair.jitter import BandLimited, Exact, Lagrange
from torchsar.scene import Dwell, Hyperbola, Parabola, Points, StripmapWorld
from torchsar.study.names.registry import FOCUS
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured

# half of the lines and cells of the patches on which images are compared: they hold the main lobe
# and a dozen side lobes at any usual sampling
_HALF = 16
# a period of four timing offsets (samples) as in Tsvetkov 2017, and raw lines enough to time them
_OFFSETS, _LINES = (0.0, 0.18, -0.12, 0.07), 1024
FORMS = {"range_doppler": "range-Doppler", "omega_k": "bulk + refocus (omega_k)", "omega_k_stolt": ""}


@dataclass(frozen=True)
class SmoothBand:
    """Weight of one PRF of Doppler with a raised-cosine roll-off over its outer eighths.

    A sharp end would put Fresnel ripple of its own on the yardstick; targets that are lit within
    the inner three quarters of the PRF keep their full weight.
    """

    width_hz: float

    def weight(self, since_s: Tensor, doppler_offset_hz: Tensor) -> Tensor:
        outer = ((doppler_offset_hz.abs() - 3 * self.width_hz / 8) / (self.width_hz / 8)).clamp(0, 1)
        return 0.5 * (1 + torch.cos(math.pi * outer))


@dataclass(frozen=True)
class Probe:
    """Point targets at both edges and in the middle of the swath, without noise or impairments.

    Args:
        radar: The instrument.
        world: The points, seen with the true Doppler and velocity.
        size: Lines and samples.
    """

    radar: StripmapRadar
    world: StripmapWorld
    size: tuple[int, int]

    @staticmethod
    def of(bench: Bench) -> Probe:
        """With Doppler and velocity of the world, or of a recording as the recommended method
        estimates them.
        """
        radar = bench.radar
        if bench.recording is None:
            world = bench.world()
            size, seen = (world.lines, world.samples), world.of(radar)
        else:
            used = bench.batch(Draws(0), methods=("recommended",)).outcomes["recommended"].judged.view
            size = tuple(axis.n for axis in bench.recording.signal.axes)
            doppler, velocity = float(used.doppler_hz or 0.0), float(used.velocity_m_s)
            dwell = radar.integration_s or 0.75 * radar.aperture_s(radar.near_range_m)
            seen = StripmapWorld(Points([0.0], [0.0]), Dwell(dwell), Hyperbola(), velocity, doppler)
        probe = Probe(radar, replace(seen, scene=Points([0.0], [0.0]), snr_db=None), size)
        axes, margin = radar.raw_axes(*size), (_HALF + 1) * radar.range_step_m
        dwell = getattr(seen.beam, "dwell_s", None) or radar.integration_s or radar.aperture_s(radar.near_range_m)
        near, far = full_swath_m(radar, axes, *probe.motion, dwell)
        # positions count from the middle of the fully compressed part of a line
        middle = radar.near_range_m + max(0, size[1] - radar.pulse_samples) / 2 * radar.range_step_m
        edges = [min(0.0, near - middle + margin), 0.0, max(0.0, far - middle - margin)]
        return replace(probe, world=replace(probe.world, scene=Points([0.0] * 3, edges)))

    @property
    def motion(self) -> tuple[float, float]:
        """Doppler of the beam centre (Hz) and velocity (m/s), of the first trial."""
        world, radar = self.world, self.radar
        doppler = (radar.pointing_doppler_hz or 0.0) if world.doppler_hz is None else world.doppler_hz
        velocity = radar.velocity_m_s if world.velocity_m_s is None else world.velocity_m_s
        return _first(doppler), _first(velocity)

    def recorded(self, dtype: torch.dtype, **changes: Any) -> tuple[Recording, Truth]:
        return simulate(self.radar, replace(self.world, **changes), *self.size, Draws(0), dtype=dtype)

    def rows(self) -> tuple[Requirement, ...]:
        """What each simplification neglects for this size, Doppler and velocity."""
        return requirements(self.radar, self.radar.raw_axes(*self.size), *self.motion)


def _first(x: Tensor | float) -> float:
    return float(torch.as_tensor(x).reshape(-1)[0])


def choices(bench: Bench, rows: Mapping[str, Requirement]) -> list[Choice]:
    """The decisions of a config; rows: what simplifications neglect, by effect."""

    forms = [
        Alternative(
            name,
            {"stage": name},
            {"image_error_db": rows[row].error_db} if row else {},
            rows[row].neglects if row else "",
        )
        for name, row in FORMS.items()
    ]
    exact = Alternative("backprojection, complex128, times extrapolated from patches")
    found = [Choice("focusing form", "stage", forms, partial(_forms, bench), exact)]
    precisions = [Alternative(name, {"precision": name}) for name in ("complex64", "complex128")]
    found.append(Choice("precision", "precision", precisions, partial(_precisions, bench)))
    histories = [
        Alternative("parabola", {"kind": "parabola"}, {"echo_error_db": _parabola_db(bench)}, "higher orders"),
        Alternative("hyperbola", {"kind": "hyperbola"}, {}),
    ]
    if bench.recording is None:
        found.append(Choice("range history", "world.path", histories, partial(_histories, bench)))
    stages = (bench.config.processor["recommended"].stages or {}).values()
    if any(entry["stage"].startswith("jitter_") for entry in stages):
        correctors = [Alternative(name, {"corrector": c}) for name, c in _CORRECTORS.items()]
        found.append(Choice("jitter correction", "stage of the name jitter", correctors, partial(_jitter, bench)))
    return found


def _forms(bench: Bench) -> Measured:
    """Whole images by each form against backprojection of patches about the points."""
    probe = Probe.of(bench)
    recording, truth = probe.recorded(torch.complex128)
    known = {key: truth.values[key] for key in ("velocity_m_s", "doppler_hz")}
    spots = _spots(probe, truth)
    signal = recording.signal.to(bench.dtype)
    exact = _stacked([_yardstick(recording, spot, known) for spot in spots])

    def run(one: Alternative) -> Tensor:
        if not one.keys:
            return _stacked([_yardstick(recording, spot, known) for spot in spots])
        return FOCUS[one.keys["stage"]](probe.radar, "matched", known["velocity_m_s"], known["doppler_hz"])(signal).data

    def loss(one: Alternative, image: Tensor) -> dict[str, float]:
        patches = _patches(image, spots) if one.keys else image
        return {"image_error_db": _worst_db(patches, exact)}

    def share(one: Alternative) -> float:
        return 1.0 if one.keys else exact.numel() / signal.data.numel()

    return Measured(run, loss, share)


def _precisions(bench: Bench) -> Measured:
    """The recommended form in single precision against double precision."""
    probe = Probe.of(bench)
    recording, truth = probe.recorded(torch.complex128)
    names = [entry["stage"] for entry in (bench.config.processor["recommended"].stages or {}).values()]
    form = next((name for name in names if name in FORMS), "omega_k")
    stage = FOCUS[form](probe.radar, "matched", truth.values["velocity_m_s"], truth.values["doppler_hz"])
    signals = {name: recording.signal.to(getattr(torch, name)) for name in ("complex64", "complex128")}
    spots, exact = _spots(probe, truth), stage(signals["complex128"]).data

    def run(one: Alternative) -> Tensor:
        return stage(signals[one.keys["precision"]]).data

    def loss(one: Alternative, image: Tensor) -> dict[str, float]:
        return {"image_error_db": _worst_db(_patches(image, spots), _patches(exact, spots))}

    return Measured(run, loss)


def _parabola_db(bench: Bench) -> float:
    """Error of the echo of the nearest target by a parabola about its closest approach."""
    radar, (doppler, velocity) = bench.radar, Probe.of(bench).motion
    slant, sine = radar.near_range_m, radar.sin_squint(doppler, velocity)
    closest = slant * torch.sqrt(1 - sine**2)
    dwell = getattr(bench.world().beam, "dwell_s", radar.aperture_s(slant))
    since = slant * sine / velocity + dwell * torch.linspace(-0.5, 0.5, 65, dtype=torch.float64)
    ranges = [path.range_m(since, closest, torch.tensor(velocity)) for path in (Hyperbola(), Parabola())]
    return phase_error_db(4 * math.pi / radar.wavelength_m * (ranges[1] - ranges[0]))


def _histories(bench: Bench) -> Measured:
    """Echoes by each range history, point by point."""
    probe, paths = Probe.of(bench), {"parabola": Parabola(), "hyperbola": Hyperbola()}
    exact = _by_point(probe, Hyperbola())

    def run(one: Alternative) -> Tensor:
        return probe.recorded(bench.dtype, path=paths[one.keys["kind"]])[0].signal.data

    def loss(one: Alternative, _: Tensor) -> dict[str, float]:
        made = _by_point(probe, paths[one.keys["kind"]])
        return {"echo_error_db": max(float(error_db(a, b)) for a, b in zip(made, exact, strict=True))}

    return Measured(run, loss)


def _by_point(probe: Probe, path: Any) -> list[Tensor]:
    scene = probe.world.scene
    assert isinstance(scene, Points)
    alone = [Points([x], [r]) for x, r in zip(scene.azimuth_m, scene.range_m, strict=True)]
    return [probe.recorded(torch.complex128, path=path, scene=one)[0].signal.data for one in alone]


_CORRECTORS: dict[str, Any] = {
    "none": None,
    "Lagrange, 4 points": Lagrange(4),
    "Lagrange, 8 points": Lagrange(8),
    "band-limited, 8 points": BandLimited(8),
    "Lagrange, 12 points": Lagrange(12),
    "exact": Exact(),
}


def _jitter(bench: Bench) -> Measured:
    """Correctors of a known periodic jitter on the first lines of raw data."""
    raw = Probe.of(bench).recorded(bench.dtype)[0].signal.data
    lit = raw.abs().square().sum(-1).argmax()
    raw = raw[max(0, int(lit) - _LINES // 2) :][:_LINES]
    offsets = torch.tensor(_OFFSETS, dtype=torch.float64)
    uneven = sample_unevenly(raw, offsets)

    def run(one: Alternative) -> Tensor:
        corrector = one.keys["corrector"]
        return uneven if corrector is None else corrector(uneven, offsets)

    return Measured(run, lambda one, fixed: {"data_error_db": float(error_db(fixed, raw))})


def _spots(probe: Probe, truth: Truth) -> list[tuple[int, int]]:
    """Line and cell at which images show the points."""
    values, radar = truth.values, probe.radar
    frame = radar.pointing_doppler_hz
    at = radar.image_position(
        values["zero_doppler_s"],
        values["closest_range_m"],
        values["doppler_hz"] if frame is None else frame,
        values["velocity_m_s"],
    )
    axes = radar.image_axes(radar.raw_axes(*probe.size))
    lines, cells = (axis.index_of(x).round().long().tolist() for axis, x in zip(axes, at, strict=True))
    return [(min(max(line, _HALF), probe.size[0] - _HALF), cell) for line, cell in zip(lines, cells, strict=True)]


def _yardstick(recording: Recording, spot: tuple[int, int], known: Mapping[str, Tensor]) -> Tensor:
    lines, cells = ((i - _HALF, i + _HALF) for i in spot)
    doppler, band = known["doppler_hz"], SmoothBand(recording.radar.prf_hz)
    stage = Backproject(
        recording.radar, "matched", known["velocity_m_s"], doppler, lines=lines, cells=cells, aperture=band
    )
    return stage(Signal(recording.signal.data, recording.signal.axes)).data


def _patches(image: Tensor, spots: Sequence[tuple[int, int]]) -> Tensor:
    return _stacked([image[i - _HALF : i + _HALF, j - _HALF : j + _HALF] for i, j in spots])


def _stacked(patches: Sequence[Tensor]) -> Tensor:
    return torch.stack([patch.to(torch.complex128) for patch in patches])


def _worst_db(patches: Tensor, exact: Tensor) -> float:
    """Largest error of a patch, with the one complex gain that fits all patches best: focusers
    differ by a constant of their transforms.
    """
    gain = (patches.conj() * exact).sum() / patches.abs().square().sum()
    return float(error_db(patches * gain, exact).max())
