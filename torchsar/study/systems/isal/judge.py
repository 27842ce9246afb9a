"""Metrics of one method on rotating targets: residual phases, images, bounds."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsar.core import Chain, Trace
from torchsar.metrics import contrast, entropy, phase_rmse, residual_phase, strehl
from torchsar.metrics.bounds import pulse_phase_bound_of_scene_rad, pulse_phase_bound_rad, turntable_responses
from torchsar.scene import PhaseOnly
from torchsar.study.trials.batch import IMAGE, Batch, Judged, Trials
from torchsar.study.trials.bench import Bench

# the bound of unknown amplitudes inverts a matrix of at most this size, within a second on one core
_MOST_SCATTERERS, _MOST_PULSES = 1200, 800


def judge(bench: Bench, name: str, trace: Trace, trials: Trials) -> Judged:
    """Return the metrics of the residual phase and of the image by one method.

    The field `view` of the result is the phase in rad that the method removes, (trial, pulse).
    """
    chain, clean = bench.chains[name], bench.config.processor[name].input == "clean"
    true, present = whole_phase(trials), received(trials)
    truth = torch.zeros_like(true) if clean else true
    found = estimated_phase(chain, trace, true)
    residual = residual_phase(found, truth, present)
    metrics = {"residual_phase_rms_rad": phase_rmse(found, truth, present), "strehl": strehl(residual, present)}
    for estimate in trace.estimates.values():
        if "phase_rad" in estimate.std:
            metrics["residual_phase_std_rad"] = estimate.std["phase_rad"].mean(-1)
    if trace.signal.names == IMAGE:
        metrics.update(entropy_nats=entropy(trace.signal), contrast=contrast(trace.signal))
    if bench.recording is not None:
        own = trace if clean else chain.trace(trials.clean)
        metrics["entropy_above_clean_nats"] = metrics["entropy_nats"] - entropy(own.signal)
        agreement = phase_rmse(found - truth, estimated_phase(chain, own, true), present)
        metrics["agreement_rad"] = agreement
    return Judged({key: x.double().expand(trials.count) for key, x in metrics.items()}, view=found)


def bounds(bench: Bench, batch: Batch) -> dict[str, dict[str, Tensor]]:
    """Return lower bounds of the rms residual phase in rad, (trial,): one for a known scene, and
    one for unknown amplitudes of its scatterers. Both are without the constant and the linear term
    of the phase, as the residual phase is.

    The ratio of the second bound to the first is computed for a single scene of the case; it
    differs by about one percent between scenes.
    """
    std, data = batch.trials.truth["noise_std"], batch.trials.clean.signal.data
    if not bool((std > 0).all()):
        return {}
    power = (torch.view_as_real(data).double().square().sum(-1).mean((-2, -1)) - std.square()).clamp_min(1e-300)
    known = pulse_phase_bound_rad(power / std.square(), data.shape[-1], data.shape[-2])
    ratio = bench.memo("bound ratio", lambda: _bound_ratio(bench))
    free = {} if ratio is None else {"amplitudes unknown (Cramer-Rao)": known * ratio}
    return {"residual_phase_rms_rad": {"scene known": known, **free}}


def whole_phase(trials: Trials) -> Tensor:
    """Return the true phase error of every pulse in rad, with impairments, (trial, pulse)."""
    phases = [value for name, value in trials.truth.items() if name == "phase_rad" or name.endswith(".phase_rad")]
    pulses = trials.recording.signal.data.shape[:-1]
    whole = torch.zeros(pulses, dtype=torch.float64, device=trials.recording.signal.data.device)
    return (whole + sum(phases)).reshape(trials.count, -1)


def received(trials: Trials) -> Tensor | None:
    """Pulses that were received, bool (trial, pulse); None if no impairment loses any."""
    lost = [value for name, value in trials.truth.items() if name.endswith(".present")]
    return torch.stack(lost).all(0).reshape(-1, lost[0].shape[-1]) if lost else None


def estimated_phase(chain: Chain, trace: Trace, like: Tensor) -> Tensor:
    """Return the phase in rad that a chain removes from each pulse, in the shape of `like`.

    It is the sum over all stages that correct a phase. If there is no such stage, it is the last
    estimate of a phase, or zero if there is none. Phases that are only initial values of another
    estimator do not count.
    """
    taken = [
        trace.arguments[name]["phase_rad"]
        for name, uses in chain.uses.items()
        if "phase_rad" in uses and name in trace.arguments
    ]
    found = taken or [e.value["phase_rad"] for e in trace.estimates.values() if "phase_rad" in e.value][-1:]
    return sum((phase.to(torch.float64).reshape(like.shape) for phase in found), torch.zeros_like(like))


def _bound_ratio(bench: Bench) -> float | None:
    """Ratio of the bound of unknown amplitudes to that of a known scene, computed for one scene;
    None if it would take too long.
    """
    size, world, radar = bench.world(), bench.world().of(bench.radar), bench.radar
    scene = world.scene.scatterers(bench.draws("bound"))
    few = scene.amplitude.shape[-1] <= _MOST_SCATTERERS and 2 < size.pulses <= _MOST_PULSES
    if not isinstance(world.fidelity, PhaseOnly) or not few:
        return None
    rate = float((radar.rotation_rad_s if world.rotation_rad_s is None else world.rotation_rad_s) or 0.0)
    azimuth, response = turntable_responses(radar, rate, scene.azimuth_m, scene.range_m, size.pulses, size.samples)
    power = ((azimuth * scene.amplitude) @ response).abs().square().mean()
    return float(
        pulse_phase_bound_of_scene_rad(azimuth, response, scene.amplitude, 1.0)
        / pulse_phase_bound_rad(power, size.samples, size.pulses)
    )
