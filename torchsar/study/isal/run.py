"""`torchsar run` for turning targets: every case, simulated over trials or recorded with injected
phase errors, by every method.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws
from torchsar.echo import apply_impairments
from torchsar.metrics import phase_rmse
from torchsar.study.build import build_impairments
from torchsar.study.case_run import run_cases
from torchsar.study.cases import check_judged, methods_tree
from torchsar.study.config import Loaded, check_methods
from torchsar.study.isal.build import check, read_recording, recorded_chains
from torchsar.study.isal.figures import CaseResult, draw
from torchsar.study.isal.judge import DEFINITIONS, estimated_phase, image_metrics, phase_metrics
from torchsar.study.isal.report import write_report
from torchsar.study.isal.sections import TARGET_IMPAIRMENTS
from torchsar.study.isal.trials import ENDING, Bench, IsalTrials, judged, run_batch
from torchsar.study.montecarlo.record import OK
from torchsar.study.tracing import image_of, refuse_no_image, summary, traced

log = logging.getLogger("torchsar")


def run(loaded: Loaded, out: Path, command: str = "torchsar run") -> Path:
    """Run every method on every case and write config.yaml, metrics.json, arrays.zarr, figures/ and
    report.html into OUT.

    OUT appears whole or not at all. Returns the path of the report. Raises ConfigError for whatever
    the user can put right.
    """
    recorded = loaded.config.data.file is not None

    def prepare() -> None:
        check_methods(loaded.config, loaded.file)
        (check_judged if recorded else check)(loaded)

    return run_cases(
        loaded, out, command, prepare, _recorded if recorded else _simulated, metrics_tree, draw, write_report
    )


@torch.no_grad()
def _simulated(loaded: Loaded, name: str) -> CaseResult:
    """All trials of one case, a few at a time; scenes and noise of a case depend on the seed and on
    nothing else.
    """
    trials, bench = loaded.config.world.trials, IsalTrials(loaded).bench({})
    height = max(1, min(trials, (64 << 20) // max(1, IsalTrials(loaded).bytes_per_trial({}))))
    parts, first = [], None
    for begin in range(0, trials, height):
        batch = run_batch(bench, Draws(loaded.config.seed, "run", range(begin, min(begin + height, trials))))
        for method, trace in batch.traces.items():
            refuse_no_image(method, trace.signal, ENDING)
        parts.append(judged(bench, batch))
        if first is None:
            true = batch.phase_rad[0]
            phases = {
                method: estimated_phase(bench.chains[method], trace, batch.phase_rad)[0]
                for method, trace in batch.traces.items()
            }
            along, across, amplitude = (
                batch.truth.values[name].reshape(-1, batch.truth.values[name].shape[-1])[0]
                for name in ("range_m", "cross_range_m", "amplitude")
            )
            first = (
                {method: image_of(trace.signal) for method, trace in batch.traces.items()},
                phases,
                true,
                (along, across, amplitude),
            )
    assert first is not None
    _warn_of_doubt(bench, name, parts)
    metrics = {
        method: {key: torch.cat([part[method][key].reshape(-1) for part in parts]) for key in parts[0][method]}
        for method in parts[0]
    }
    return CaseResult(metrics, *first)


def _warn_of_doubt(bench: Bench, name: str, parts: list[dict[str, dict[str, Tensor]]]) -> None:
    doubted = sum(int((~part["recommended"][OK]).sum()) for part in parts if OK in part["recommended"])
    if doubted:
        log.warning(
            "warning: %srecommended does not trust its phases in %d of %d trials",
            f"{name}: " if name else "",
            doubted,
            bench.config.world.trials,
        )


@torch.no_grad()
def _recorded(loaded: Loaded, name: str) -> CaseResult:
    """One case of a recording: every method on the recording as it is, and with the injected
    phases.
    """
    clean = read_recording(loaded)
    impairments = build_impairments(loaded.config.data.impairments, "data.impairments", loaded.file, TARGET_IMPAIRMENTS)
    dirty, told = apply_impairments(clean, impairments, Draws(loaded.config.seed))
    if not [name for name in told if name.endswith(".phase_rad")]:
        told = {**told, "none.phase_rad": torch.zeros(clean.signal.data.shape[-2], dtype=torch.float64)}
    true = sum(
        (value for name, value in told.items() if name.endswith(".phase_rad")),
        torch.zeros(clean.signal.data.shape[-2], dtype=torch.float64),
    )
    present = torch.stack(
        [value for name, value in told.items() if name.endswith(".present")]
        or [torch.ones_like(true, dtype=torch.bool)]
    ).all(0)
    chains = recorded_chains(loaded, clean)
    metrics: dict[str, dict[str, Tensor]] = {}
    images, phases = {}, {}
    for title, method in loaded.config.processor.items():
        began = time.perf_counter()
        chain = chains[title]
        of_clean = traced(chain, clean, title)
        seconds = time.perf_counter() - began
        trace = of_clean if method.input == "clean" else traced(chain, dirty, title)
        refuse_no_image(title, trace.signal, ENDING)
        injected = torch.zeros_like(true) if method.input == "clean" else true
        row = {**phase_metrics(chain, trace, injected, present), **image_metrics(trace.signal, None)}
        row["entropy_above_clean_nats"] = row["entropy_nats"] - image_metrics(of_clean.signal, None)["entropy_nats"]
        row["agreement_rad"] = phase_rmse(
            estimated_phase(chain, trace, true) - injected, estimated_phase(chain, of_clean, true), present
        )
        row["seconds"] = torch.tensor(seconds, dtype=torch.float64)
        metrics[title], images[title], phases[title] = row, trace.signal, estimated_phase(chain, trace, true)
    return CaseResult(metrics, images, phases, true)


def metrics_tree(loaded: Loaded, results: Mapping[str, CaseResult]) -> dict[str, Any]:
    """The content of metrics.json: by method, means over all cases as `metrics`, and every case
    under `cases`.
    """
    config = loaded.config
    methods = methods_tree(loaded, {case: summary(result.metrics) for case, result in results.items()})
    published = {"ideal_entropy_nats": config.metrics.published_ideal, "entropy_nats": config.metrics.published}
    return {
        "methods": methods,
        "published": published,
        "truth": {},
        "definitions": DEFINITIONS,
        "trials": 1 if config.data.file is not None else config.world.trials,
    }
