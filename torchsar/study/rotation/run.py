"""`torchsar run` for targets that turn unevenly: every case, simulated over trials, by every
method.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchsar.core import Draws
from torchsar.study.case_run import run_cases
from torchsar.study.cases import check_simulated, methods_tree
from torchsar.study.config import Loaded
from torchsar.study.limits import warn_of_doubt
from torchsar.study.rotation.build import check
from torchsar.study.rotation.figures import CaseResult, draw
from torchsar.study.rotation.judge import DEFINITIONS
from torchsar.study.rotation.report import write_report
from torchsar.study.rotation.requires import heed_limits
from torchsar.study.rotation.trials import ENDING, RotationTrials, run_batch
from torchsar.study.tracing import refuse_no_image, summary

__all__ = ["check", "run"]
log = logging.getLogger("torchsar")
_BATCH_BYTES = 256 << 20


def run(loaded: Loaded, out: Path, command: str = "torchsar run") -> Path:
    """Run every method on every case and write config.yaml, metrics.json, arrays.zarr, figures/ and
    report.html into OUT.

    OUT appears whole or not at all. Returns the path of the report. Raises ConfigError for whatever
    the user can put right, limits that the scene exceeds among it.
    """
    return run_cases(
        loaded,
        out,
        command,
        lambda: check_simulated(loaded, check, heed_limits),
        _simulated,
        metrics_tree,
        draw,
        write_report,
    )


@torch.no_grad()
def _simulated(loaded: Loaded, name: str) -> CaseResult:
    """All trials of one case, a few at a time; scenes and noise of a case depend on its seeds and
    on nothing else.
    """
    trials, count = RotationTrials(loaded), loaded.config.world.trials
    bench = trials.bench({})
    height = max(1, min(count, _BATCH_BYTES // trials.bytes_per_trial({})))
    parts: list[CaseResult] = []
    for begin in range(0, count, height):
        batch = run_batch(bench, Draws(loaded.config.seed, "run", range(begin, min(begin + height, count))), cuts=True)
        for method, outcome in batch.outcomes.items():
            refuse_no_image(method, outcome.trace.signal, ENDING)
        parts.append(CaseResult.of(bench, batch))
    result = CaseResult.joined(parts)
    warn_of_doubt(name, result.metrics, count)
    return result


def metrics_tree(loaded: Loaded, results: Mapping[str, CaseResult]) -> dict[str, Any]:
    """The content of metrics.json: by method, the first case as `metrics`, every case under
    `cases`, estimates by trial, and responses of point targets by `case/target`.
    """
    methods = methods_tree(loaded, {case: summary(result.metrics) for case, result in results.items()}, first_only=True)
    truth: dict[str, Any] = {}
    for case, result in results.items():
        of_case = "" if case == "all" else f"{case}/"
        truth.update({f"{of_case}{key}": value.tolist() for key, value in result.truth.items()})
        for name, method in methods.items():
            method["targets"].update(
                {f"{of_case}{target}": row for target, row in summary(result.targets[name]).items()}
            )
            method["estimates"].update({f"{of_case}{key}": entry for key, entry in result.found[name].items()})
    settings = loaded.config.metrics
    shown = (
        "methods.NAME.metrics are the means over trials of the first case, "
        f"{next(iter(results))!r}; every case stands in methods.NAME.cases, with deviations "
        "as _sd"
    )
    definitions = {**DEFINITIONS, "metrics": shown, "reference": settings.reference, "search_m": settings.search_m}
    published = {**settings.published, "targets": settings.published_targets}
    return {
        "methods": methods,
        "published": published,
        "truth": truth,
        "definitions": definitions,
        "trials": loaded.config.world.trials,
    }
