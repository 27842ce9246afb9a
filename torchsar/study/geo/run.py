"""`torchsar run` for moving targets before several channels: every case, simulated over trials, by
every method.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from torchsar.core import Draws
from torchsar.study.case_run import run_cases
from torchsar.study.cases import cases_of, check_simulated, methods_tree
from torchsar.study.config import Loaded
from torchsar.study.geo.build import Echoes, check
from torchsar.study.geo.figures import CaseResult, draw
from torchsar.study.geo.judge import DEFINITIONS
from torchsar.study.geo.report import write_report
from torchsar.study.geo.requires import heed_limits
from torchsar.study.geo.sections import GeoConfig, compression_gain_db
from torchsar.study.geo.trials import GeoTrials, run_batch
from torchsar.study.limits import warn_of_doubt
from torchsar.study.tracing import summary

__all__ = ["check", "run"]
_BATCH_BYTES = 2 << 30


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
    """All trials of one case, a few at a time; the noise of a target depends on its name, the seed
    and the trial, and on nothing else.
    """
    trials, count = GeoTrials(loaded), loaded.config.world.trials
    bench = trials.bench({})
    height = max(1, min(count, _BATCH_BYTES // trials.bytes_per_trial({})))
    parts: list[CaseResult] = []
    for begin in range(0, count, height):
        batch = run_batch(bench, Draws(loaded.config.seed, "run", range(begin, min(begin + height, count))))
        parts.append(CaseResult.of(bench, batch))
    result = CaseResult.joined(parts)
    warn_of_doubt(
        name,
        {method: {key: value.reshape(-1) for key, value in found.items()} for method, found in result.metrics.items()},
        count * len(bench.echoes.targets),
    )
    return result


def metrics_tree(loaded: Loaded, results: Mapping[str, CaseResult]) -> dict[str, Any]:
    """The content of metrics.json: by method means over all targets and cases as `metrics`, those
    of every case under `cases`, of every target (`case/target` where there are cases) under
    `targets`, and estimates by trial; `theory` by target.
    """
    methods = methods_tree(loaded, {case: summary(result.metrics) for case, result in results.items()})
    truth: dict[str, Any] = {}
    expected: dict[str, Any] = {}
    for case, result in results.items():
        of_case = "" if case == "all" else f"{case}/"
        truth.update({f"{of_case}{key}": value.tolist() for key, value in result.truth.items()})
        expected.update({f"{of_case}{target}": row for target, row in result.theory.items()})
        for target, by_method in result.by_target().items():
            for name, row in summary(by_method).items():
                methods[name]["targets"][f"{of_case}{target}"] = row
        for name, method in methods.items():
            method["estimates"].update({f"{of_case}{key}": entry for key, entry in result.found[name].items()})
    settings, levels = loaded.config.metrics, _levels(next(iter(cases_of(loaded).values())))
    definitions = {
        **DEFINITIONS,
        "metrics": "methods.NAME.metrics are means over all targets and cases",
        "orders": settings.orders,
        **levels,
    }
    published = {"targets": settings.published_targets}
    return {
        "methods": methods,
        "theory": expected,
        "published": published,
        "truth": truth,
        "definitions": definitions,
        "trials": loaded.config.world.trials,
    }


def _levels(case: Loaded) -> dict[str, Any]:
    """SNR both ways, and the range to the transmitter, as numbers."""
    assert isinstance(case.config, GeoConfig)
    echoes, gain = Echoes.of(case), compression_gain_db(case.config)
    transmit = {f"transmit_range_k{i}": k for i, k in enumerate(echoes.radar.transmit_range, 1)}
    return (
        {"compression_gain_db": gain, **transmit}
        if echoes.snr_db is None
        else {"snr_db": echoes.snr_db, "raw_scnr_db": echoes.snr_db - gain, **transmit}
    )
