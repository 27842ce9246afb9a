"""Processing of a rotating target: its limits, the errors of simplifications, and its
alternatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchsar.compensate import EntropyObjective, ImageEntropy, coarse_rotation, entropy_rotation, uneven_rotation
from torchsar.core import Draws, Estimate
from torchsar.focus import DopplerLines, ExplicitSum, Gridding, Resampling, matched_fourier, range_phase
from torchsar.focus.requirements import Limit, Requirement
from torchsar.focus.rotation_requirements import (
    order_loss_db,
    range_term_loss_db,
    rotation_limits,
    rotation_requirements,
)
from torchsar.metrics import error_db, rotation_bounds
from torchsar.radar.warp import cut_warp, warp
from torchsar.scene import PhaseOnly, Points
from torchsar.study.systems.isal import echo_choices
from torchsar.study.trials.batch import Trials
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import (
    Alternative,
    Choice,
    DirectlySummed,
    Measured,
    beside_direct_sum,
    turning_target,
)
from torchsar.study.trials.system import Noise

# number of orders of the rotation that are compared; there are more if the rotation of the target
# has more
_ORDERS = 4
# image lines that are so fine that a peak between two of them loses less than 0.01 dB
_FINE = DopplerLines(16.0)
# names of estimators that start near the truth
_DESCENT, _GENETIC = "descent from 0.95 of the truth", "genetic 10 x 4, +-10 % about the truth"


def limits(bench: Bench) -> tuple[Limit, ...]:
    """Return the limits of methods for the target in the first trial of a run."""
    world, radar = bench.world(), bench.radar
    x, y, amplitude = _scatterers(bench)
    omega, k, yc = _rotation(world)
    std = world.noise_std(amplitude)
    known = {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "n_pulse": world.pulses, "free_centre": False}
    # the bound is that for a known centre; with a free centre, it is larger if there are few ranges
    bound = float(rotation_bounds(x, y, amplitude, std, omega, k, yc, **known)["omega_rad_s"]) if std > 0 else None
    return rotation_limits(radar, world.pulses, omega, k.tolist(), x, y + yc, amplitude, std, bound)


def requirements(bench: Bench) -> Sequence[Requirement]:
    """Return the errors of each simplified processing for the target in the first trial."""
    x, y, _ = _scatterers(bench)
    omega, k, yc = _rotation(bench.world())
    reach = (float(x.abs().max()), float((y + yc).abs().max()))
    return rotation_requirements(bench.radar, bench.world().pulses, omega, k.tolist(), *reach)


def choices(bench: Bench) -> list[Choice]:
    """Return the choices between alternatives: order of the rotation, range term of the phase,
    transform along slow time, estimator of the rotation, and echo model.
    """
    orders = [_order(order, bench) for order in range(1, max(_ORDERS, 1 + len(_rotation(bench.world())[1])) + 1)]
    # largest width of the kernels that are compared
    kernels = {f"gridding, {taps} taps": Gridding(taps=taps) for taps in (2, 3, 4, 5, 6, 7, 8)}
    transforms = [
        *(
            Alternative(
                f"{kind} interpolation",
                {"transform": {"kind": "resampling", "interpolation": kind}},
                None,
                "the edge of the Doppler band",
            )
            for kind in ("linear", "spline")
        ),
        *(
            Alternative(
                name,
                {"transform": {"kind": "gridding", "taps": one.taps, "eps": None, "oversampling": None}},
                _aliased(one),
            )
            for name, one in kernels.items()
        ),
        Alternative("the sum itself", {"transform": {"kind": "explicit_sum"}}, {}),
    ]
    lever, off_cell = _levers(bench)
    range_terms = [
        Alternative(
            "azimuth only", {"range_term": False}, _range_term_loss(bench, lever), "the range term", "azimuth only"
        ),
        Alternative("azimuth and range", {"range_term": True}, _range_term_loss(bench, off_cell), "range in a cell"),
    ]
    found = [Alternative(name, {"estimator": work}) for name, work in _ESTIMATORS.items()]
    return [
        Choice("order of the rotation", "uneven_rotation.order", orders, partial(_orders, bench)),
        Choice("range term", "range_phase", range_terms, partial(_range_terms, bench)),
        Choice("transform", "matched_fourier.transform", transforms, partial(_transforms, bench)),
        beside_direct_sum(partial(_summed, bench), "migration, range in a cell"),
        Choice("estimator of the rotation", "estimator", found, partial(_estimates, bench)),
        *echo_choices(bench),
    ]


def _order(order: int, bench: Bench) -> Alternative:
    """Alternative with the rotation truncated to an order, and the loss of the outermost
    scatterer.
    """
    (omega, k, _), world, radar = _rotation(bench.world()), bench.world(), bench.radar
    lost, across = {}, float(_scatterers(bench)[0].abs().max())
    if order <= min(len(k), _ORDERS):
        about = (world.pulses / radar.prf_hz, omega, across, radar.wavelength_m)
        lost = {"peak_loss_db": order_loss_db(k, order, *about)}
    return Alternative(f"order {order}", {"order": order}, lost, "higher orders", f"warp of order {order}")


def _aliased(one: Gridding) -> dict[str, float]:
    """Predicted error of gridding: that of its kernel, and rounding errors of single precision."""
    return {"image_error_db": 20 * math.log10(math.hypot(one.kernel.error, torch.finfo(torch.float32).eps))}


def _scatterers(bench: Bench) -> list[Tensor]:
    """Cross range, range (m) and amplitude in the first trial of a run, (target,) each."""
    scene = bench.world().of(bench.radar).scene.scatterers(bench.draws("run", [0]))
    return [x.reshape(-1, x.shape[-1])[0].cpu() for x in (scene.azimuth_m, scene.range_m, scene.amplitude)]


def _rotation(world: Any) -> tuple[float, Tensor, float]:
    """Rotation rate, k1, k2, ... and range centre deviation of the first trial."""
    omega, yc = (
        float(torch.as_tensor(v).reshape(-1)[0]) for v in (world.rotation.omega_rad_s, world.centre_deviation_m)
    )
    k = world.rotation.warp_k(torch.zeros(0, dtype=torch.float64))
    return omega, k.reshape(-1, k.shape[-1])[0] if k.numel() else k.reshape(-1)[:0], yc


def _levers(bench: Bench) -> tuple[float, float]:
    """Largest distances (m) of scatterers from the centre of rotation, and from the middles of
    range cells.
    """
    y, cell = _scatterers(bench)[1], bench.radar.range_step_m
    return float((y + _rotation(bench.world())[2]).abs().max()), float((y - cell * (y / cell).round()).abs().max())


def _range_term_loss(bench: Bench, lever_m: float) -> dict[str, float]:
    omega, k, _ = _rotation(bench.world())
    time_s = torch.arange(bench.world().pulses, dtype=torch.float64) / bench.radar.prf_hz
    return {"peak_loss_db": range_term_loss_db(warp(time_s, k), omega, lever_m, bench.radar.wavelength_m)}


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


def _peak_losses(
    bench: Bench, target: int, best: Alternative, made: Callable[[Trials, Alternative], tuple[Tensor, Tensor]]
) -> Measured:
    """Measure the loss of the peak of one scatterer. `made` returns the data and the warp of an
    alternative.
    """
    (x, y, _), prf = _scatterers(bench), bench.radar.prf_hz
    alone, whole = _alone(bench, float(y[target]), float(x[target])), bench.trials(_draws(bench))

    def peak(one: Alternative) -> float:
        return float(matched_fourier(*made(alone, one), prf, lines=_FINE).abs().max())

    top = peak(best)
    return Measured(
        lambda one: matched_fourier(*made(whole, one), prf),
        lambda one, _: {"peak_loss_db": 20 * math.log10(top / peak(one))},
    )


def _orders(bench: Bench) -> Measured:
    """Measure images of the outermost scatterer with the true rotation truncated to each order."""

    duration_s = bench.world().pulses / bench.radar.prf_hz

    def made(trials: Trials, one: Alternative) -> tuple[Tensor, Tensor]:
        k = trials.truth["warp_k"]
        return _without_range_term(bench, trials), cut_warp(k, one.keys.get("order", 1 + k.shape[-1]), duration_s)

    return _peak_losses(bench, int(_scatterers(bench)[0].abs().argmax()), Alternative("all orders"), made)


def _range_terms(bench: Bench) -> Measured:
    """Measure images of the scatterer farthest from the centre with and without its range term."""

    def made(trials: Trials, one: Alternative) -> tuple[Tensor, Tensor]:
        data = trials.clean.signal.data
        if "range_term" not in one.keys:
            data = data.abs().to(data.dtype)
        elif one.keys["range_term"]:
            data = _without_range_term(bench, trials)
        return data, trials.truth["warp_k"]

    far = int((_scatterers(bench)[1] + _rotation(bench.world())[2]).abs().argmax())
    return _peak_losses(bench, far, Alternative("all pulses in phase"), made)


def _transforms(bench: Bench) -> Measured:
    """Measure each way to compute the matched Fourier transform on whole trials."""
    trials = bench.trials(_draws(bench))
    exact, k = _without_range_term(bench, trials).to(torch.complex128), trials.truth["warp_k"]
    # the sum itself is the reference up to this number of products of pulses, lines and range cells
    best = ExplicitSum() if 2 * exact.numel() * exact.shape[-2] <= 3e8 else Gridding(eps=1e-12, oversampling=2.0)
    truth, data = matched_fourier(exact, k, bench.radar.prf_hz, transform=best), exact.to(bench.dtype)

    def run(one: Alternative) -> Tensor:
        keys = one.keys["transform"]
        if keys["kind"] == "explicit_sum":
            return matched_fourier(exact, k, bench.radar.prf_hz, transform=best)
        made = Gridding(taps=keys["taps"]) if keys["kind"] == "gridding" else Resampling(keys["interpolation"])
        return matched_fourier(data, k, bench.radar.prf_hz, transform=made)

    return Measured(run, lambda one, image: {"image_error_db": float(error_db(image.to(truth), truth).max())})


def _summed(bench: Bench) -> DirectlySummed:
    """Image of white noise by the true rotation of the first trial."""
    (omega, k, yc), radar, world, lines = _rotation(bench.world()), bench.radar, bench.world(), DopplerLines()
    range_m, count = radar.raw_axes(world.pulses, world.samples)[1].values(), lines.number(world.pulses)
    phi = warp(torch.arange(world.pulses + 1, dtype=torch.float64) / radar.prf_hz, k)
    # lines lie at equal steps of Doppler at the mean rate
    doppler = (torch.arange(count, dtype=torch.float64) - count // 2) / (lines.oversampling * phi[-1])
    cross = radar.wavelength_m * doppler / (2 * omega)
    about = (range_m, radar.wavelength_m, radar.prf_hz, omega, k, yc)
    return turning_target(
        *(radar, omega * phi[:-1], cross, yc, world.samples, bench.draws()),
        lambda noise: matched_fourier(range_phase(noise.to(bench.dtype), *about), k, radar.prf_hz, lines=lines),
    )


def _draws(bench: Bench) -> Draws:
    return bench.draws("trade", range(bench.config.trade.trials))


def _descent_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, *, order: int, yc_m: float | None, **known: Any
) -> Estimate:
    """Descent of the image entropy that starts at 0.95 of the true values."""
    figure = ImageEntropy(data, EntropyObjective(order=order, yc_m=yc_m or 0.0, variables="shape"), **known)
    return entropy_rotation(figure, "descent", figure.start(0.95 * omega_rad_s, 0.95 * warp_k))


def _genetic_near_truth(
    data: Tensor, omega_rad_s: Tensor, warp_k: Tensor, *, order: int, yc_m: float | None, **known: Any
) -> Estimate:
    """A genetic algorithm within 10 % of the true values, short enough to compare."""
    figure = ImageEntropy(data, EntropyObjective(order=order, yc_m=yc_m or 0.0), **known)
    centre = torch.cat([omega_rad_s[..., None], warp_k], -1)
    half = 0.1 * torch.where(centre != 0, centre.abs(), 1)
    box = (centre - half, centre + half)
    return entropy_rotation(figure, "genetic", box, draws=Draws(1), population=10, generations=4)


_ESTIMATORS: dict[str, Callable[..., Estimate]] = {
    "coarse": coarse_rotation,
    "phase fit": partial(coarse_rotation, fits=4),
    "recommended, 30 scatterers": partial(uneven_rotation, scatterers=30),
    "recommended, 1 round": partial(uneven_rotation, rounds=1),
    "recommended": uneven_rotation,
    "recommended, complex128": lambda data, **known: uneven_rotation(data.to(torch.complex128), **known),
    _DESCENT: _descent_near_truth,
    _GENETIC: _genetic_near_truth,
}


def _estimates(bench: Bench) -> Measured:
    """Measure the estimators on the trials of the config, without phase errors."""
    trials, radar = bench.trials(_draws(bench)), bench.radar
    signal, truth = trials.clean.signal, trials.truth
    stages = (bench.config.processor["recommended"].stages or {}).values()
    yc = next((entry.get("yc_m") for entry in stages if "rotation" in str(entry["stage"])), None)
    known = {"wavelength_m": radar.wavelength_m, "prf_hz": radar.prf_hz, "range_m": signal.axis("range").values()}
    known |= {"yc_m": yc, "order": max(2, truth["warp_k"].shape[-1] + 1)}
    true = {name: truth[name] for name in ("omega_rad_s", "warp_k")}

    def rms(x: Tensor) -> float:
        return float(x.square().mean().sqrt())

    def loss(one: Alternative, estimate: Estimate) -> dict[str, float]:
        rows = {}
        if one.name != "coarse":  # the coarse estimator does not use the rate
            rows["omega_error_percent"] = rms(100 * (estimate["omega_rad_s"] / truth["omega_rad_s"] - 1))
        for i, k in enumerate(truth["warp_k"].unbind(-1)[:2]):
            if bool((k != 0).all()):
                rows[f"k{i + 1}_error_percent"] = rms(100 * (estimate["warp_k"][..., i] - k) / k.abs())
        return rows

    def run(one: Alternative) -> Estimate:
        return one.keys["estimator"](signal.data, **known, **(true if one.name in (_DESCENT, _GENETIC) else {}))

    return Measured(run, loss)
