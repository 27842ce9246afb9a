"""Figures of one batch of trials: phases against the truth, images against the ideal one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchsar.core import Chain, Signal, Trace
from torchsar.metrics import contrast, entropy, phase_rmse, residual_phase, strehl
from torchsar.study.tracing import verdict

DEFINITIONS: dict[str, Any] = {
    "snr": "mean power of all range-compressed samples over noise variance, dB",
    "entropy": "-sum p ln p, p = |I|^2 / sum |I|^2 over the whole image, nats",
    "entropy_above_ideal_nats": (
        "entropy less that of the error-free image of the same scene and noise; it depends "
        "on the position of the image between cells by some 0.03"
    ),
    "contrast": "standard deviation over mean of the intensity |I|^2",
    "residual_phase_rms_rad": (
        "rms over pulses of what was taken out, all corrections together, minus truth, "
        "constant and linear term removed on the circle; lost pulses do not count"
    ),
    "residual_phase_std_rad": "what the method itself predicts for it",
    "strehl": "|mean exp(j residual)|^2 over pulses; success is 0.8 and more, about 0.47 rad rms",
    "entropy_above_clean_nats": (
        "entropy less that which the same method reaches on the recording without the injected phases"
    ),
    "agreement_rad": (
        "rms of (estimate - injected phase) less the estimate on the recording without "
        "injected phases: 0 for a method that errors cannot influence"
    ),
    "ok": "whether the method itself trusts its estimate",
    "seconds": "wall time of the chain of the method per trial",
    "published": (
        "figures of Ruan et al. 2013, Table 1, less the entropy that the paper implies for the error-free image"
    ),
}


def estimated_phase(chain: Chain, trace: Trace, like: Tensor) -> Tensor:
    """Phase that the chain takes out of each pulse, (..., pulse) float64 shaped as `like`: the sum
    over its correctors.

    Of a chain without a corrector the last estimate of a phase, which it would take out; zero where
    there is none. A phase that only starts another estimator does not count.
    """
    taken = [
        trace.values[uses["phase_rad"]]
        for name, uses in chain.uses.items()
        if "phase_rad" in uses and name in trace.outputs
    ]
    found = (
        taken
        or [estimate.value["phase_rad"] for estimate in trace.estimates.values() if "phase_rad" in estimate.value][-1:]
    )
    return sum((phase.to(torch.float64) for phase in found), torch.zeros_like(like, dtype=torch.float64))


def phase_metrics(chain: Chain, trace: Trace, truth_rad: Tensor, present: Tensor | None) -> dict[str, Tensor]:
    """Residual phase, Strehl ratio, predicted deviation and verdict, (...,) each."""
    phase = estimated_phase(chain, trace, truth_rad)
    residual = residual_phase(phase, truth_rad, present)
    found = {"residual_phase_rms_rad": phase_rmse(phase, truth_rad, present), "strehl": strehl_over(residual, present)}
    for estimate in trace.estimates.values():
        if "phase_rad" in estimate.std:
            found["residual_phase_std_rad"] = estimate.std["phase_rad"].mean(-1)
    return {**found, **verdict(trace.estimates, truth_rad.shape[:-1])}


def strehl_over(residual: Tensor, present: Tensor | None) -> Tensor:
    """Strehl ratio over the pulses that are there."""
    if present is None:
        return strehl(residual)
    counted = torch.where(present, torch.polar(torch.ones_like(residual), residual), 0).sum(-1)
    return (counted.abs() / present.sum(-1).clamp_min(1)).square()


def image_metrics(image: Signal, ideal: Signal | None) -> dict[str, Tensor]:
    """Entropy and contrast, and the entropy above that of the ideal image."""
    found = {"entropy_nats": entropy(image), "contrast": contrast(image)}
    return found if ideal is None else {**found, "entropy_above_ideal_nats": found["entropy_nats"] - entropy(ideal)}
