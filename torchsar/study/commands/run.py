"""The command `torchsar run`: runs every method of a config on every case and writes a report."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Outcome, counts
from torchsar.io.arrays import write_arrays
from torchsar.study.commands.requires import refuse_beyond_limits
from torchsar.study.output.folder import fresh_result
from torchsar.study.output.numbers import write_json
from torchsar.study.output.progress import progress
from torchsar.study.output.report import before_and_after, draw_all, run_fields, write_page
from torchsar.study.settings.sections import ALL, Loaded, cases_of, key_of
from torchsar.study.trials.batch import Batch, Found, Result, joined_found, joined_metrics, summary
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.system import per_trial_first

log = logging.getLogger("torchsar")
FILES = ("config.yaml", "metrics.json", "arrays.zarr", "figures", "report.html")
# metrics.json has only the mean of estimates with more numbers than this; arrays.zarr has all of
# them
_LISTED = 16


def run(loaded: Loaded, out: Path, command: str = "torchsar run", device: str = "cpu") -> Path:
    """Run every method of a config on each of its cases, and write the result into a folder.

    Args:
        loaded: The config.
        out: The result folder. It gets config.yaml, metrics.json, arrays.zarr, figures/ and
            report.html, all of them or none.
        command: Command line that the report shows.
        device: Device on which the trials are computed.

    Returns:
        The path of the report.

    Raises:
        ConfigError: If the config is invalid, the simulation or a stage rejects it, or the scene
            exceeds the limits of a method.
    """
    began = time.perf_counter()
    with fresh_result(out, "run", FILES) as folder:
        cases = cases_of(loaded)
        with progress(0, "stages") as steps:

            def announce(method: str, stage: str) -> None:
                steps.set_description_str(f"{method}, {stage}" if method else stage, refresh=False)
                steps.update()

            benches = {name: Bench(case, device, announce) for name, case in cases.items()}
            for name, bench in benches.items():
                refuse_beyond_limits(bench, name)
                for sentence in bench.chosen:
                    log.info("%s", sentence)
                steps.total += len(_chunks(bench)) * (1 + sum(len(chain.stages) for chain in bench.chains.values()))
            results = {name: _case(bench, name) for name, bench in benches.items()}
        tree = metrics_tree(loaded, results)
        (folder / "config.yaml").write_text(loaded.text(), encoding="utf-8")
        write_json(folder / "metrics.json", tree)
        kept = {case: loaded.system.pictured(r) for case, r in results.items()}
        images = {key_of(case, name): image for case, of in kept.items() for name, image in of.items()}
        truth = {
            key_of(case, name): per_trial_first(torch.as_tensor(value), r.first.trials.count)[0]
            for case, r in results.items()
            for name, value in r.first.trials.truth.items()
        }
        estimates = {
            method: {
                key_of(case, name): value.value[0]
                for case, r in results.items()
                for name, value in r.estimates.get(method, {}).items()
            }
            for method in dict.fromkeys(method for r in results.values() for method in r.estimates)
        }
        write_arrays(folder / "arrays.zarr", images, truth, estimates)
        pictures = draw_all(loaded.system.pictures(results), folder / "figures")
        fields = run_fields(tree, loaded.system.columns, loaded.system.target_columns)
        notes = [*(("Chosen", text) for text in tree["chosen"]), *loaded.system.notes(tree)]
        definitions = tree["definitions"]
        processed = [name for name, method in loaded.config.processor.items() if method.input != "clean"]
        fields["lead"] = before_and_after(pictures, processed)
        page = {"title": loaded.config.title, "command": command, "definitions": definitions, "config": loaded.text()}
        write_page(folder / "report.html", "run.html.j2", pictures, folder / "figures", notes=notes, **page, **fields)
    log.info("finished in %.0f s", time.perf_counter() - began)
    return out / "report.html"


def _chunks(bench: Bench) -> list[range]:
    """Numbers of the trials of each batch of a case."""
    count = 1 if bench.recording is not None else bench.world().trials
    # largest tensor of a batch in bytes; it is large enough for efficient calls, and small relative
    # to the memory of a machine that can process one trial
    height = max(1, min(count, (256 << 20) // max(1, bench.bytes_per_trial)))
    return [range(first, min(first + height, count)) for first in range(0, count, height)]


def _case(bench: Bench, name: str) -> Result:
    """Run all trials of one case in batches."""
    began, system = time.perf_counter(), bench.system
    first: Batch | None = None
    metrics: dict[str, list[Mapping[str, Tensor]]] = {}
    targets: dict[str, dict[str, list[Mapping[str, Tensor]]]] = {}
    estimates: dict[str, list[Mapping[str, Found]]] = {}
    truth: list[Mapping[str, Tensor]] = []
    marks: dict[str, list[Mapping[str, Mapping[str, Tensor]]]] = {}
    for chunk in _chunks(bench):
        keep = bench.chains if first is None else ()
        batch = bench.batch(bench.draws(system.address, chunk), keep=keep, detail=True)
        first, n = first or batch, batch.trials.count
        whole = {name: per_trial_first(torch.as_tensor(x), n) for name, x in batch.trials.truth.items()}
        # true values that have one number per trial
        truth.append({k: x.reshape(n).cpu() for k, x in whole.items() if x.numel() == n and not x.is_complex()})
        for method, outcome in batch.outcomes.items():
            metrics.setdefault(method, []).append(outcome.metrics)
            estimates.setdefault(method, []).append(system.found(bench, outcome, batch.trials))
            marks.setdefault(method, []).append(outcome.marks)
            for target, found in outcome.judged.targets.items():
                targets.setdefault(method, {}).setdefault(target, []).append(found)
    assert first is not None
    joined = {method: joined_metrics(parts) for method, parts in metrics.items()}
    of_targets = {method: {t: joined_metrics(parts) for t, parts in of.items()} for method, of in targets.items()}
    found = {method: joined_found(parts) for method, parts in estimates.items()}
    joined_marks = {
        method: {k: joined_metrics([part.get(k, {}) for part in parts]) for k in ("outcomes", "neutral", "doubtful")}
        for method, parts in marks.items()
    }
    result = Result(bench, first, joined, of_targets, found, joined_metrics(truth), joined_marks)
    where = "" if name == ALL else f"{name}: "
    for stage, codes in result.marks["recommended"]["outcomes"].items():
        for code, count in _reasons(codes).items():
            if not code.is_ok:
                text = "warning: %srecommended.%s, not ok in %d of %d trials: %s"
                log.warning(text, where, stage, count, len(codes), code.message)
    log.info("%s: %.1f s", bench.loaded.name if name == ALL else name, time.perf_counter() - began)
    return result


def _reasons(codes: Tensor) -> dict[Outcome, int]:
    """Number of trials of each outcome; codes are NaN in batches without outcomes."""
    return counts(codes[codes.isfinite()].long())


def metrics_tree(loaded: Loaded, results: Mapping[str, Result]) -> dict[str, Any]:
    """Return the content of metrics.json.

    Args:
        loaded: The config.
        results: Results by case. In the returned content, the entry `metrics` of a method has those
            of the first case, and the entry `cases` those of every case.
    """
    first = next(iter(results.values()))
    methods = {name: _method_tree(method.title, name, results) for name, method in loaded.config.processor.items()}
    truth = {key_of(c, name): _listed(value) for c, result in results.items() for name, value in result.truth.items()}
    shown = {
        "metrics": "methods.NAME.metrics are means over trials of the first case, "
        f"{next(iter(results))!r}; methods.NAME.cases has all cases, with standard deviations over trials as _sd",
        "estimates": f"an estimate of more than {_LISTED} numbers per trial is given by its mean and its rms standard "
        "deviation, of a path over the pulses that see the imaged strip; arrays.zarr has all numbers",
        "outcomes": "methods.NAME.outcomes: by stage that estimates, the number of trials of each outcome, with its "
        "sentence: what was seen, and what to try; of several targets the worst one counts",
        "neutral": "methods.NAME.neutral: number of trials in which an estimate was not used, because it failed, by "
        "stage and parameter: the stage got a neutral value, or left the signal unchanged",
        "doubtful": "methods.NAME.doubtful: number of trials in which a doubtful estimate was used, by stage and "
        "parameter",
        "in_doubt": "methods.NAME.in_doubt: stages that use neutral values also where an estimate is doubtful "
        "(in_doubt: neutral)",
        "ok": "whether all assessed estimates of the method are reliable; its mean is over the trials that have some",
        "seconds": "wall time of the chain of the method per trial; shared estimates count in every method",
        "targets_outside": "named targets outside the image, or never in the beam; a case has their number",
    }
    return {
        "methods": methods,
        "published": getattr(first.bench.judging, "published", {}),
        "published_targets": getattr(first.bench.judging, "published_targets", {}),
        "theory": {key_of(case, n): row for case, r in results.items() for n, row in loaded.system.theory(r).items()},
        "truth": truth,
        "definitions": {**shown, **loaded.system.definitions, **loaded.system.extra_definitions(first.bench)},
        "trials": len(next(iter(first.metrics["recommended"].values()))),
        "chosen": [sentence for result in results.values() for sentence in result.bench.chosen],
    }


def _method_tree(title: str, name: str, results: Mapping[str, Result]) -> dict[str, Any]:
    outcomes = {case: result.first_of(name) for case, result in results.items()}
    outside = {case: outcome.judged.outside for case, outcome in outcomes.items()}
    counted = {case: {"targets_outside": len(names)} if names else {} for case, names in outside.items()}
    cases = {case: {**summary(result.metrics[name]), **counted[case]} for case, result in results.items()}
    first = next(iter(outcomes.values()))
    targets = {
        key_of(case, target): summary(metrics)
        for case, result in results.items()
        for target, metrics in result.targets.get(name, {}).items()
    }
    estimates = {key_of(c, key): _entry(found) for c, r in results.items() for key, found in r.estimates[name].items()}
    return {
        "title": title,
        "metrics": next(iter(cases.values())),
        "cases": cases,
        "estimates": estimates,
        "targets": targets,
        "targets_outside": [key_of(case, target) for case, names in outside.items() for target in names],
        "seconds_by_stage": dict(first.seconds),
        "failed": "; ".join(key_of(case, o.failed) for case, o in outcomes.items() if o.failed),
        "outcomes": {
            key_of(c, stage): {code.name: {"trials": n, "message": code.message} for code, n in _reasons(codes).items()}
            for c, r in results.items()
            for stage, codes in r.marks[name]["outcomes"].items()
        },
        **{
            kind: {
                key_of(c, key): int(used.nansum())
                for c, r in results.items()
                for key, used in r.marks[name][kind].items()
                if used.nansum()
            }
            for kind in ("neutral", "doubtful")
        },
        "in_doubt": [
            stage
            for stage, doubt in results[next(iter(results))].bench.chains[name].in_doubt.items()
            if doubt == "neutral"
        ],
    }


def _entry(found: Found) -> dict[str, Any]:
    """Value, standard deviation, `ok` and name of the outcome of an estimate: lists over trials, or
    one entry.
    """
    value, std, codes = found.value, found.std, found.outcome
    if value[0].numel() > _LISTED:
        known = torch.ones_like(value).bool() if std is None or not std.isfinite().any() else std.isfinite()
        value = value.where(known, math.nan).double().flatten(1).nanmean(1)
        std = None if std is None else std.double().flatten(1).square().nanmean(1).sqrt()
    outcomes = None if codes is None else list(map(Outcome, codes.tolist()))
    return {
        "value": _listed(value),
        "std": _listed(std),
        "ok": _listed(outcomes and [code.is_ok for code in outcomes]),
        "outcome": _listed(outcomes and [code.name for code in outcomes]),
    }


def _listed(x: Tensor | list[Any] | None) -> Any:
    listed: Sequence[Any] | None = x.tolist() if isinstance(x, Tensor) else x
    return listed[0] if listed is not None and len(listed) == 1 else listed
