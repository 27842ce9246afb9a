"""`torchsar run` for turning targets: every case, simulated over trials or recorded with injected phase errors, by every method."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Draws, Signal, Trace
from torchsar.echo import apply_damages
from torchsar.metrics import phase_rmse
from torchsar.study.build import build_damages, resolved
from torchsar.study.config import Loaded, check_methods
from torchsar.study.errors import ConfigError
from torchsar.study.folder import fresh_folder, write_arrays, write_json
from torchsar.study.isal.build import cases_of, check, check_judged, read_recording, recorded_chains
from torchsar.study.isal.figures import CaseResult, draw
from torchsar.study.isal.judge import DEFINITIONS, estimated_phase, image_metrics, phase_metrics, summary
from torchsar.study.isal.report import write_report
from torchsar.study.isal.sections import TARGET_DAMAGES
from torchsar.study.isal.trials import IMAGE, Bench, IsalTrials, image_of, judged, not_an_image, run_batch, traced
from torchsar.study.montecarlo.record import OK

log = logging.getLogger("torchsar")


def run(loaded: Loaded, out: Path, command: str = "torchsar run") -> Path:
    """Run every method on every case and write config.yaml, metrics.json, arrays.zarr, figures/ and report.html into OUT.

    OUT appears whole or not at all. Returns the path of the report. Raises ConfigError for whatever the user can put right.
    """
    began = time.perf_counter()
    with fresh_folder(out) as folder:
        check_methods(loaded.config, loaded.file)
        recorded = loaded.config.data.file is not None
        if recorded:
            check_judged(loaded)
        else:
            check(loaded)
        results: dict[str, CaseResult] = {}
        for name, case in cases_of(loaded).items():
            started = time.perf_counter()
            try:
                results[name or "all"] = _recorded(case) if recorded else _simulated(case, name)
            except (ValueError, TypeError, KeyError, RuntimeError) as error:
                text, place = " ".join(str(error).split()), f"{loaded.file}: {f'cases.{name}: ' if name else ''}"
                raise ConfigError(text if text.startswith(loaded.file) else f"{place}{text}") from error
            log.info("%s: %.1f s", name or loaded.name, time.perf_counter() - started)
        metrics = metrics_tree(loaded, results)
        config_text = loaded.text(resolved(loaded))
        (folder / "config.yaml").write_text(config_text, encoding="utf-8")
        write_json(folder / "metrics.json", metrics)
        write_arrays(folder / "arrays.zarr", _images(results), _truths(results), _estimates(results))
        pictures = draw(results, folder / "figures")
        write_report(folder / "report.html", loaded.config.title, metrics, pictures, folder / "figures", config_text, command)
    log.info("finished in %.0f s", time.perf_counter() - began)
    return out / "report.html"


@torch.no_grad()
def _simulated(loaded: Loaded, name: str) -> CaseResult:
    """All trials of one case, a few at a time; scenes and noise of a case depend on the seed and on nothing else."""
    trials, bench = loaded.config.world.trials, IsalTrials(loaded).bench({})
    height = max(1, min(trials, (64 << 20) // max(1, IsalTrials(loaded).bytes_per_trial({}))))
    parts, first = [], None
    for begin in range(0, trials, height):
        batch = run_batch(bench, Draws(loaded.config.seed, "run", range(begin, min(begin + height, trials))))
        for method, trace in batch.traces.items():
            _refuse_no_image(method, trace)
        parts.append(judged(bench, batch))
        if first is None:
            true = batch.phase_rad[0]
            phases = {method: estimated_phase(bench.chains[method], trace, batch.phase_rad)[0] for method, trace in batch.traces.items()}
            along, across, amplitude = (batch.truth.values[name].reshape(-1, batch.truth.values[name].shape[-1])[0] for name in ("range_m", "cross_range_m", "amplitude"))
            first = {method: image_of(trace) for method, trace in batch.traces.items()}, phases, true, (along, across, amplitude)
    assert first is not None
    _warn_of_doubt(bench, name, parts)
    metrics = {method: {key: torch.cat([part[method][key].reshape(-1) for part in parts]) for key in parts[0][method]} for method in parts[0]}
    return CaseResult(metrics, *first)


def _refuse_no_image(name: str, trace: Trace) -> None:
    if trace.signal.names != IMAGE:
        raise ConfigError(f"processor.{name}, {not_an_image(trace.signal)} (a sweep needs none)")
    for axis in trace.signal.axes:
        if not math.isfinite(axis.step * axis.n):
            raise ConfigError(f"processor.{name}: the image has cells of {axis.step:g} {axis.unit} along {axis.name}; check the carrier, the pulse rate and the rotation of the radar")


def _warn_of_doubt(bench: Bench, name: str, parts: list[dict[str, dict[str, Tensor]]]) -> None:
    doubted = sum(int((~part["recommended"][OK]).sum()) for part in parts if OK in part["recommended"])
    if doubted:
        log.warning("warning: %srecommended does not trust its phases in %d of %d trials", f"{name}: " if name else "", doubted, bench.config.world.trials)


@torch.no_grad()
def _recorded(loaded: Loaded) -> CaseResult:
    """One case of a recording: every method on the recording as it is, and with the injected phases."""
    clean = read_recording(loaded)
    damages = build_damages(loaded.config.data.damages, "data.damages", loaded.file, TARGET_DAMAGES)
    dirty, told = apply_damages(clean, damages, Draws(loaded.config.seed))
    if not [name for name in told if name.endswith(".phase_rad")]:
        told = {**told, "none.phase_rad": torch.zeros(clean.signal.data.shape[-2], dtype=torch.float64)}
    true = sum((value for name, value in told.items() if name.endswith(".phase_rad")), torch.zeros(clean.signal.data.shape[-2], dtype=torch.float64))
    present = torch.stack([value for name, value in told.items() if name.endswith(".present")] or [torch.ones_like(true, dtype=torch.bool)]).all(0)
    chains = recorded_chains(loaded, clean)
    metrics: dict[str, dict[str, Tensor]] = {}
    images, phases = {}, {}
    for name, method in loaded.config.processor.items():
        began = time.perf_counter()
        chain = chains[name]
        of_clean = traced(chain, clean, name)
        seconds = time.perf_counter() - began
        trace = of_clean if method.input == "clean" else traced(chain, dirty, name)
        _refuse_no_image(name, trace)
        injected = torch.zeros_like(true) if method.input == "clean" else true
        row = {**phase_metrics(chain, trace, injected, present), **image_metrics(trace.signal, None)}
        row["entropy_above_clean_nats"] = row["entropy_nats"] - image_metrics(of_clean.signal, None)["entropy_nats"]
        row["agreement_rad"] = phase_rmse(estimated_phase(chain, trace, true) - injected, estimated_phase(chain, of_clean, true), present)
        row["seconds"] = torch.tensor(seconds, dtype=torch.float64)
        metrics[name], images[name], phases[name] = row, trace.signal, estimated_phase(chain, trace, true)
    return CaseResult(metrics, images, phases, true)


def metrics_tree(loaded: Loaded, results: Mapping[str, CaseResult]) -> dict[str, Any]:
    """The content of metrics.json: by method, means over all cases as `metrics`, and every case under `cases`."""
    config = loaded.config
    by_case = {case: summary(result.metrics) for case, result in results.items()}
    methods = {}
    for name, method in config.processor.items():
        rows = {case: rows[name] for case, rows in by_case.items()}
        keys = dict.fromkeys(key for row in rows.values() for key in row if not key.endswith("_sd"))
        metrics = {key: sum(row[key] for row in rows.values() if key in row) / sum(key in row for row in rows.values()) for key in keys}
        methods[name] = {"title": method.title, "metrics": metrics, "estimates": {}, "targets": {}, "cases": rows}
    published = {"ideal_entropy_nats": config.metrics.published_ideal, "entropy_nats": config.metrics.published}
    return {"methods": methods, "published": published, "truth": {}, "definitions": DEFINITIONS, "trials": 1 if config.data.file is not None else config.world.trials}


def _key(case: str, name: str) -> str:
    """Path in the store; a '/' in the name of a case makes no group."""
    return name if case == "all" else f"{case.replace('/', '_')}/{name}"


def _images(results: Mapping[str, CaseResult]) -> dict[str, Signal]:
    return {_key(case, name): image for case, result in results.items() for name, image in result.images.items()}


def _truths(results: Mapping[str, CaseResult]) -> dict[str, Tensor]:
    return {_key(case, "phase_rad"): result.true_rad for case, result in results.items()}


def _estimates(results: Mapping[str, CaseResult]) -> dict[str, dict[str, Tensor]]:
    found: dict[str, dict[str, Tensor]] = {}
    for case, result in results.items():
        for name, phase in result.phases.items():
            found.setdefault(name, {})[_key(case, "phase_rad")] = phase
    return found
