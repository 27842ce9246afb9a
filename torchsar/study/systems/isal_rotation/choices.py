"""What a rotating target requires of its processor, and the alternatives that it may choose."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate.rotation import (
    EntropyObjective,
    ImageEntropy,
    coarse_rotation,
    descend_rotation,
    genetic_rotation,
    phase_fit_rotation,
    uneven_rotation,
)
from torchsar.core import Draws, Estimate
from torchsar.core.warp import k_of_shape, shape_of, warp
from torchsar.focus import DopplerLines, ExplicitSum, Gridding, Resampling, matched_fourier, range_phase
from torchsar.focus.ladar_requirements import Limit
from torchsar.focus.requirements import Requirement, phase_error_db
from torchsar.focus.rotation_requirements import rotation_limits, rotation_requirements
from torchsar.metrics import error_db, rotation_bounds
from torchsar.scene import PhaseOnly, Points
from torchsar.study.systems.isal.world import echo_choice
from torchsar.study.systems.isal_rotation.world import Rotating, first_values, k_of
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import Alternative, Choice, Measured
from torchsar.study.trials.system import Noise

# products of pulses, lines and range cells up to which the sum itself is the yardstick
_EXPLICIT = 3e8
# largest width of kernels that are compared
_TAPS = (2, 3, 4, 5, 6, 7, 8)
# lines so fine that a peak between two of them loses less than 0.01 dB
_FINE = DopplerLines(16.0)
# a genetic search that is short enough to compare: population, generations, part of the truth to
# each side
_GENETIC = (10, 4, 0.1)


def limits(bench: Bench) -> tuple[Limit, ...]:
    """Limits of the first trial of a run."""
    world, radar = bench.world(), bench.radar
    x, y, amplitude = _scatterers(bench)
    omega, k, yc = _rotation(world)
    std = world.noise_std(amplitude)
    known = {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "n_pulse": world.pulses, "free_centre": False}
    # the centre known: with a free one the bound is larger where the ranges are few
    bound = float(rotation_bounds(x, y, amplitude, std, omega, k, yc, **known)["omega_rad_s"]) if std > 0 else None
    return rotation_limits(radar, world.pulses, omega, k.tolist(), x, y + yc, amplitude, std, bound)


def requirements(bench: Bench) -> Sequence[Requirement]:
    """What each simplification neglects in the first trial of a run."""
    x, y, _ = _scatterers(bench)
    omega, k, yc = _rotation(bench.world())
    reach = (float(x.abs().max()), float((y + yc).abs().max()))
    return rotation_requirements(bench.radar, bench.world().pulses, omega, k.tolist(), *reach)


def choices(bench: Bench) -> list[Choice]:
    """Order of the rotation, range term, transform, estimator, and echo model."""
    most = max(4, 1 + len(_rotation(bench.world())[1]))
    orders = [_order(bench, order) for order in range(1, most + 1)]
    kernels = {f"gridding, {taps} taps": Gridding(taps=taps) for taps in _TAPS}
    transforms = [
        *(
            Alternative(f"{kind} interpolation", _resampling(kind), None, "the edge of the Doppler band")
            for kind in _KINDS
        ),
        *(Alternative(name, _gridding(one), _aliased(one)) for name, one in kernels.items()),
        Alternative("the sum itself", {"transform": {"kind": "explicit_sum"}}, {}),
    ]
    range_terms = [
        Alternative("azimuth only", {"range_term": False}, {"peak_loss_db": _range_term_db(bench)}, "the range term"),
        Alternative("azimuth and range", {"range_term": True}, {}),
    ]
    found = [Alternative(name, {"estimator": work}) for name, work in _ESTIMATORS.items()]
    return [
        Choice("order of the rotation", "rotation.order", orders, partial(_orders, bench)),
        Choice("range term", "range_phase", range_terms, partial(_range_terms, bench)),
        Choice("transform", "matched_fourier.transform", transforms, partial(_transforms, bench)),
        Choice("estimator of the rotation", "estimator", found, partial(_estimates, bench)),
        echo_choice(bench),
    ]


_KINDS = ("linear", "spline")


def _resampling(interpolation: str) -> dict[str, Any]:
    return {"transform": {"kind": "resampling", "interpolation": interpolation}}


def _gridding(one: Gridding) -> dict[str, Any]:
    return {"transform": {"kind": "gridding", "taps": one.taps, "eps": None, "oversampling": None}}


def _aliased(one: Gridding) -> dict[str, float]:
    """Predicted error of gridding: that of its kernel, and rounding of single precision."""
    return {"image_error_db": 20 * math.log10(math.hypot(one.kernel.error, torch.finfo(torch.float32).eps))}


def _scatterers(bench: Bench) -> list[Tensor]:
    """Cross range, range (m) and amplitude in the first trial of a run, (target,) each."""
    scene = bench.world().of(bench.radar).scene.scatterers(Draws(bench.config.seed, "run", [0]))
    values = {"x": scene.azimuth_m, "y": scene.range_m, "a": scene.amplitude}
    return first_values(values, "x", "y", "a")


def _rotation(world: Rotating) -> tuple[float, Tensor, float]:
    """Rate, k1, k2, ... and range centre deviation of the first trial."""
    omega, yc = (
        float(torch.as_tensor(v).reshape(-1)[0]) for v in (world.rotation.omega_rad_s, world.centre_deviation_m)
    )
    return omega, k_of(world.rotation), yc


def _times(bench: Bench) -> Tensor:
    return torch.arange(bench.world().pulses, dtype=torch.float64) / bench.radar.prf_hz


def _order(bench: Bench, order: int) -> Alternative:
    """The rotation cut to an order, with the error of the response of the outermost scatterer."""
    (omega, k, _), time_s = _rotation(bench.world()), _times(bench)
    left = warp(time_s, k) - warp(time_s, _cut(k, order, bench))
    across = float(_scatterers(bench)[0].abs().max())
    loss = phase_error_db(4 * math.pi / bench.radar.wavelength_m * across * omega * left)
    exact = order > len(k)
    return Alternative(f"order {order}", {"order": order}, {} if exact else {"image_error_db": loss}, "higher orders")


def _cut(k: Tensor, order: int, bench: Bench) -> Tensor:
    """The warp of an order that lies nearest in least squares over the record: its first Legendre
    terms, or itself where it has no more.
    """
    duration_s = bench.world().pulses / bench.radar.prf_hz
    if order > k.shape[-1]:
        return k
    return k_of_shape(shape_of(k, duration_s)[..., : order - 1], duration_s) if order > 1 else k[..., :0]


def _range_term_db(bench: Bench) -> float:
    """Loss of the peak of the scatterer farthest from the centre, in dB, by its range term without
    the line in the warp that only shifts it.
    """
    (omega, k, yc), y = _rotation(bench.world()), _scatterers(bench)[1]
    phi = warp(_times(bench), k)
    phase = 2 * math.pi / bench.radar.wavelength_m * float((y + yc).abs().max()) * (omega * phi).square()
    line = torch.stack([torch.ones_like(phi), phi / phi.abs().max().clamp_min(1e-300)], -1)
    phase = phase - line @ torch.linalg.lstsq(line, phase[:, None]).solution[:, 0]
    return -20 * math.log10(max(float(torch.polar(torch.ones_like(phase), phase).mean().abs()), 1e-15))


def _alone(bench: Bench, along: float, across: float) -> Trials:
    """Range-compressed pulses of one scatterer, without noise and errors."""
    world = replace(
        bench.world(),
        scene={"edge": Points([across], [along])},
        noise=Noise(),
        motion=(),
        start_phase=(),
        impairments={},
    )
    world = replace(world, fidelity=PhaseOnly(), scene_seed=None)
    return world.trials_of(bench.radar, Draws(0), torch.complex128)


def _without_range_term(bench: Bench, trials: Trials) -> Tensor:
    truth, signal = trials.truth, trials.clean.signal
    about = (signal.axis("range").values(), bench.radar.wavelength_m, bench.radar.prf_hz)
    return range_phase(signal.data, *about, truth["omega_rad_s"], truth["warp_k"], truth["yc_m"])


def _orders(bench: Bench) -> Measured:
    """Images of the outermost scatterer by the true rotation cut to each order."""
    x, y, _ = _scatterers(bench)
    far = int(x.abs().argmax())
    trials = _alone(bench, float(y[far]), float(x[far]))
    data, k = _without_range_term(bench, trials), trials.truth["warp_k"]
    exact = matched_fourier(data, k, bench.radar.prf_hz)
    whole = bench.trials(_draws(bench)).clean.signal.data

    def run(one: Alternative) -> Tensor:
        return matched_fourier(whole, _cut(k, one.keys["order"], bench), bench.radar.prf_hz)

    def loss(one: Alternative, _: Tensor) -> dict[str, float]:
        made = matched_fourier(data, _cut(k, one.keys["order"], bench), bench.radar.prf_hz)
        return {"image_error_db": float(error_db(made, exact))}

    return Measured(run, loss)


def _range_terms(bench: Bench) -> Measured:
    """Images of the scatterer farthest from the centre with and without its range term."""
    x, y, _ = _scatterers(bench)
    far = int((y + _rotation(bench.world())[2]).abs().argmax())
    trials = _alone(bench, float(y[far]), float(x[far]))
    k, data = trials.truth["warp_k"], {False: trials.clean.signal.data, True: _without_range_term(bench, trials)}
    top = {key: float(matched_fourier(x, k, bench.radar.prf_hz, lines=_FINE).abs().max()) for key, x in data.items()}
    whole = bench.trials(_draws(bench))

    def run(one: Alternative) -> Tensor:
        made = _without_range_term(bench, whole) if one.keys["range_term"] else whole.clean.signal.data
        return matched_fourier(made, k, bench.radar.prf_hz)

    return Measured(run, lambda one, _: {"peak_loss_db": 20 * math.log10(top[True] / top[one.keys["range_term"]])})


def _transforms(bench: Bench) -> Measured:
    """The matched Fourier transform of whole trials by each transform."""
    trials = bench.trials(_draws(bench))
    exact, k = _without_range_term(bench, trials).to(torch.complex128), trials.truth["warp_k"]
    best = ExplicitSum() if 2 * exact.numel() * exact.shape[-2] <= _EXPLICIT else Gridding(eps=1e-12, oversampling=2.0)
    truth, data = matched_fourier(exact, k, bench.radar.prf_hz, transform=best), exact.to(bench.dtype)

    def run(one: Alternative) -> Tensor:
        keys = one.keys["transform"]
        if keys["kind"] == "explicit_sum":
            return matched_fourier(exact, k, bench.radar.prf_hz, transform=best)
        made = Gridding(taps=keys["taps"]) if keys["kind"] == "gridding" else Resampling(keys["interpolation"])
        return matched_fourier(data, k, bench.radar.prf_hz, transform=made)

    return Measured(run, lambda one, image: {"image_error_db": float(error_db(image.to(truth), truth).max())})


def _draws(bench: Bench) -> Draws:
    return Draws(bench.config.seed, "trade", range(bench.config.trade.trials))


Known = Mapping[str, Any]
Estimator = Callable[[Tensor, Known, Mapping[str, Tensor]], Estimate]


def _entropy(data: Tensor, known: Known, variables: str) -> ImageEntropy:
    about = {key: value for key, value in known.items() if key not in ("yc_m", "order")}
    settings = EntropyObjective(order=known["order"], yc_m=known["yc_m"] or 0.0, variables=variables)
    return ImageEntropy(data, settings, **about)


def _descent(data: Tensor, known: Known, truth: Mapping[str, Tensor]) -> Estimate:
    """From 0.95 of the truth."""
    objective = _entropy(data, known, "shape")
    return descend_rotation(objective, objective.start(0.95 * truth["omega_rad_s"], 0.95 * truth["warp_k"], None))


def _genetic(data: Tensor, known: Known, truth: Mapping[str, Tensor]) -> Estimate:
    """In a box about the truth."""
    population, generations, part = _GENETIC
    objective = _entropy(data, known, "raw")
    centre = torch.cat([truth["omega_rad_s"][..., None], truth["warp_k"]], -1)
    box = part * torch.where(centre != 0, centre.abs(), 1)
    size = {"population": population, "generations": generations}
    return genetic_rotation(objective, centre - box, centre + box, draws=Draws(1), **size)


_ESTIMATORS: dict[str, Estimator] = {
    "coarse": lambda data, known, _: coarse_rotation(data, **known),
    "phase fit": lambda data, known, _: phase_fit_rotation(data, **known),
    "recommended, 30 scatterers": lambda data, known, _: uneven_rotation(data, **known, scatterers=30),
    "recommended, 1 round": lambda data, known, _: uneven_rotation(data, **known, rounds=1),
    "recommended": lambda data, known, _: uneven_rotation(data, **known),
    "recommended, complex128": lambda data, known, _: uneven_rotation(data.to(torch.complex128), **known),
    "descent from 0.95 of the truth": _descent,
    "genetic 10 x 4, +-10 % about the truth": _genetic,
}


def _estimates(bench: Bench) -> Measured:
    """Estimators on the config's own trials, without errors of phase."""
    trials, radar = bench.trials(_draws(bench)), bench.radar
    signal, truth = trials.clean.signal, trials.truth
    stages = (bench.config.processor["recommended"].stages or {}).values()
    yc = next((entry.get("yc_m") for entry in stages if str(entry["stage"]).startswith("rotation")), None)
    known = {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "range_m": signal.axis("range").values()}
    known |= {"yc_m": yc, "order": max(2, truth["warp_k"].shape[-1] + 1)}

    def loss(one: Alternative, estimate: Estimate) -> dict[str, float]:
        rows = {}
        if one.name != "coarse":  # which does not look at the rate
            rows["omega_error_percent"] = _rms(100 * (estimate["omega_rad_s"] / truth["omega_rad_s"] - 1))
        for i, k in enumerate(truth["warp_k"].unbind(-1)[:2]):
            if bool((k != 0).all()):
                rows[f"k{i + 1}_error_percent"] = _rms(100 * (estimate["warp_k"][..., i] - k) / k.abs())
        return rows

    return Measured(lambda one: one.keys["estimator"](signal.data, known, truth), loss)


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())
