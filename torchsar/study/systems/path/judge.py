"""Metrics of one method on recordings along any path."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchsar.compensate.pulse_phase.data import without_line
from torchsar.core import Chain, Signal, Trace, per_trial
from torchsar.focus.path_image import last_image, seen_in
from torchsar.metrics import contrast, entropy, impulse_response, line_of_sight_bound_m, residual_phase
from torchsar.radar import AntennaPath
from torchsar.study.systems.isal.judge import estimated_phase, received
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Metrics, Trials
from torchsar.study.trials.bench import Bench

# metrics of a point that are reported
_OF_POINT = (
    *("displacement_azimuth_m", "displacement_range_m", "irw_azimuth_m", "irw_range_m"),
    *("pslr_azimuth_db", "pslr_range_db"),
)
# half width of the search for a point, by choice; less if another point is near
_SEARCH_M = 10.0
# most pulses * samples * scatterers for which a bound is computed, by choice: some seconds
_MOST_WORK = 10_000_000


def judge(bench: Bench, name: str, trace: Trace, trials: Trials, detail: bool) -> Judged:
    """Return the metrics of the image and of the path by one method.

    The field `view` of the result is the error of the line of sight in metres that is left, (trial,
    pulse).
    """
    chain, clean = bench.chains[name], bench.config.processor[name].input == "clean"
    left = residual_m(chain, trace, trials, bench.radar.wavelength_m, clean)
    metrics = {"path_residual_rms_m": left.square().nanmean(-1).sqrt()}
    targets: dict[str, Metrics] = {}
    outside: list[str] = []
    if trace.signal.names == IMAGE:
        metrics |= {"entropy_nats": entropy(trace.signal), "contrast": contrast(trace.signal)}
        if bench.recording is None:
            targets, outside, positions = _points(bench, chain, trace.signal, trials)
            metrics |= positions
    metrics = {key: value.double().expand(trials.count) for key, value in metrics.items()}
    return Judged(metrics, targets if detail else {}, outside if detail else (), view=left)


def residual_m(chain: Chain, trace: Trace, trials: Trials, wavelength_m: float, clean: bool) -> Tensor:
    """Return the error of the line of sight (m) that a chain leaves, (trial, pulse).

    It has no constant and linear terms, which shift the image, and rotate and stretch it slightly.
    Where the chain estimates it or phases of pulses it is known modulo half a wavelength. It is NaN
    for pulses outside of the strip, if the image is that of a strip.
    """
    strip = seen_in(chain.stages.values(), AntennaPath.recorded(trials.recording.aux))
    pulses = (trials.count, len(strip))
    parts = [x for key, x in trials.truth.items() if key.rpartition(".")[2] == "line_of_sight_m" and not clean]
    true = sum((x.expand(pulses) for x in parts), torch.zeros(pulses, dtype=torch.float64, device=strip.device))
    phases = [x for key, x in trials.truth.items() if key.endswith(".phase_rad") and not clean]
    radians = 4 * math.pi / wavelength_m
    of_path = [e.value["line_of_sight_m"] for e in trace.estimates.values() if "line_of_sight_m" in e.value]
    if phases or of_path or any("phase_rad" in uses for uses in chain.uses.values()):
        # a recorded range that is too long leaves a positive phase
        whole = radians * true + sum((x.reshape(pulses) for x in phases), torch.zeros_like(true))
        found = sum((radians * x.reshape(pulses) for x in of_path), estimated_phase(chain, trace, whole))
        present = received(trials)
        left = residual_phase(found, whole, strip.expand(pulses) if present is None else present & strip) / radians
    else:
        left = -without_line(true, strip)
    return left.masked_fill(~strip, math.nan)


def bounds(bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
    """Return the Cramer-Rao bound of the line of sight, (trial,); nothing for large or recorded
    scenes and for data without noise.
    """
    truth, count = batch.trials.truth, batch.trials.count
    std = truth.get("noise_std")
    if bench.recording is not None or std is None or not bool((std > 0).all()):
        return {}
    points = torch.stack(torch.broadcast_tensors(*(truth[f"{axis}_m"] for axis in ("range", "azimuth", "height"))), -1)
    aux = batch.trials.clean.aux
    antennas = AntennaPath.recorded(aux)
    if antennas.pulses * len(aux["frequency_hz"]) * points.shape[-2] > _MOST_WORK or bench.world().beam is not None:
        return {}
    bound = line_of_sight_bound_m(aux["frequency_hz"], antennas, points, truth["amplitude"], std)
    return {"path_residual_rms_m": {"Cramer-Rao": bound.expand(count)}}


def _positions(off: Tensor, at: Tensor) -> dict[str, Tensor]:
    """The common shift of points in m, (trial,), and the rms distance that is left of them in m.

    Of more than three points a linear displacement is removed besides: rotation and stretch of the
    image. off: displacements (trial, point, 2); at: places (trial, point, 2).
    """
    basis = torch.cat([torch.ones_like(at[..., :1]), at[..., : 2 * (at.shape[1] > 3)]], -1)
    left = (off - basis @ (torch.linalg.pinv(basis) @ off)).square().sum(-1).mean(-1).sqrt()
    return {"image_shift_m": off.mean(1).square().sum(-1).sqrt(), "position_error_rms_m": left}


def _points(
    bench: Bench, chain: Chain, image: Signal, trials: Trials
) -> tuple[dict[str, Metrics], list[str], dict[str, Tensor]]:
    """Metrics of the named points in the image, the names of those outside it, and what their
    displacements have in common.
    """
    stage = last_image(chain.stages.values())
    if stage is None:
        return {}, [], {}
    (_, cos, _), (_, sin, _) = stage.grid.axes.tolist()  # azimuth and range axes of the image
    places, outside = {}, []
    image = image.with_data(image.data.expand(trials.count, *image.data.shape[-2:]))
    for name, place in bench.world().named_points.items():
        y, x = (per_trial(v, 0, image.data).expand(trials.count) for v in place)
        at = torch.stack([cos * y - sin * x, cos * x + sin * y], -1)
        edges = [(axis.index_of(at[:, i]), axis.n - 1) for i, axis in enumerate(image.axes)]
        if all(bool(((i >= 0) & (i <= last)).all()) for i, last in edges):
            places[name] = at
        else:
            outside.append(name)
    if not places:
        return {}, outside, {}
    at = torch.stack([*places.values()], 1)  # (trial, point, 2)
    apart = torch.cdist(at, at) + 2 * _SEARCH_M * torch.eye(len(places), dtype=torch.float64, device=at.device)
    search_m = max(image.axes[0].step, min(_SEARCH_M, float(apart.min()) / 2))
    found = impulse_response(image, (at[..., 0], at[..., 1]), search_m=search_m)
    off = torch.stack([found[f"position_{axis}_m"] for axis in IMAGE], -1) - at
    found |= {f"displacement_{axis}_m": off[..., i] for i, axis in enumerate(IMAGE)}
    targets: dict[str, Metrics] = {name: {key: found[key][:, i] for key in _OF_POINT} for i, name in enumerate(places)}
    return targets, outside, _positions(off, at)
