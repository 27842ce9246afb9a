"""`torchsar run` for ships on a sea: every case, a few scenes, by every method."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchsar.core import Draws
from torchsar.study.case_run import run_cases
from torchsar.study.cases import check_simulated, methods_tree
from torchsar.study.config import Loaded
from torchsar.study.limits import warn_of_doubt
from torchsar.study.ocean.build import check
from torchsar.study.ocean.figures import CaseResult, draw
from torchsar.study.ocean.judge import DEFINITIONS
from torchsar.study.ocean.report import write_report
from torchsar.study.ocean.requires import heed_limits
from torchsar.study.ocean.trials import OceanTrials, scene_of
from torchsar.study.tracing import summary

__all__ = ["check", "run"]


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


def _simulated(loaded: Loaded, name: str) -> CaseResult:
    """All scenes of one case, one at a time; the first is kept for figures."""
    bench, draws, count = OceanTrials(loaded).bench({}), Draws(loaded.config.seed, "run"), loaded.config.world.trials
    parts = [CaseResult.of(bench, scene_of(bench, draws, trial), pictured=trial == 0) for trial in range(count)]
    result = CaseResult.joined(parts)
    warn_of_doubt(
        name,
        {method: {"ok": table["ok"].reshape(-1)} for method, table in result.metrics.items() if "ok" in table},
        count * len(result.targets),
    )
    return result


def metrics_tree(loaded: Loaded, results: Mapping[str, CaseResult]) -> dict[str, Any]:
    """The content of metrics.json: by method means over all ships and cases as `metrics`, those of
    every case under `cases`, of every ship (`case/ship` where there are cases) under `targets`, and
    what was estimated of each ship by scene.
    """
    methods = methods_tree(loaded, {case: summary(result.measured()) for case, result in results.items()})
    truth: dict[str, Any] = {}
    for case, result in results.items():
        of_case = "" if case == "all" else f"{case}/"
        truth.update({f"{of_case}{key}": value.tolist() for key, value in result.truths().items()})
        for target in result.targets:
            for name, row in summary(result.measured(target)).items():
                methods[name]["targets"][f"{of_case}{target}"] = row
        for name, values in result.estimates().items():
            methods[name]["estimates"].update(
                {f"{of_case}{key}": {"value": value.tolist()} for key, value in values.items()}
            )
    published = {"targets": loaded.config.metrics.published_targets}
    definitions = {
        **DEFINITIONS,
        "metrics": "methods.NAME.metrics are means over all ships that have the figure, and cases",
    }
    return {
        "methods": methods,
        "published": published,
        "truth": truth,
        "definitions": definitions,
        "trials": loaded.config.world.trials,
    }
