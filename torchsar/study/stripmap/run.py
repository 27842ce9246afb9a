"""`torchsar run`: one experiment, from config to report."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from torchsar.core import Chain
from torchsar.focus.requirements import requirements
from torchsar.study.build import Case, build_impairments, resolved
from torchsar.study.case_run import RUN_FILES
from torchsar.study.config import Loaded
from torchsar.study.methods import Result, build_chains, run_methods
from torchsar.study.output.arrays import write_arrays, write_json
from torchsar.study.output.folder import fresh_result
from torchsar.study.report import write_report
from torchsar.study.stripmap.build import build_case, build_radar, build_world, true_doppler_hz
from torchsar.study.stripmap.figures import Scene, draw
from torchsar.study.stripmap.judge import metrics_tree

log = logging.getLogger("torchsar")


def run(loaded: Loaded, out: Path, command: str = "torchsar run") -> Path:
    """Run every method of the config and write config.yaml, metrics.json, arrays.zarr, figures/ and
    report.html into OUT.

    OUT appears whole or not at all. Returns the path of the report. Raises ConfigError for whatever
    the user can put right.
    """
    began = time.perf_counter()
    with fresh_result(out, "run", RUN_FILES) as folder:
        case, chains = prepare(loaded)
        results = run_methods(loaded, case, chains)
        metrics = metrics_tree(loaded.config, case, results)
        config_text = loaded.text(resolved(loaded))
        (folder / "config.yaml").write_text(config_text, encoding="utf-8")
        write_json(folder / "metrics.json", metrics)
        wrote = time.perf_counter()
        write_arrays(
            folder / "arrays.zarr",
            {name: r.image for name, r in results.items()},
            _truth_arrays(case),
            _estimate_arrays(results),
        )
        log.info("arrays: %.1f s", time.perf_counter() - wrote)
        scene = Scene(loaded.config, case, results, metrics["definitions"]["window"])
        pictures = draw(scene, folder / "figures")
        write_report(
            folder / "report.html", loaded.config.title, metrics, pictures, folder / "figures", config_text, command
        )
    log.info("finished in %.0f s", time.perf_counter() - began)
    return out / "report.html"


def check(loaded: Loaded) -> None:
    """Build all that the config of a simulation names, without computing anything: echoes take
    long, mistakes should not.
    """
    build_world(loaded)
    assert loaded.config.world is not None
    build_impairments(loaded.config.world.impairments, "world.impairments", loaded.file)
    build_chains(loaded, radar=build_radar(loaded))


def prepare(loaded: Loaded) -> tuple[Case, dict[str, Chain]]:
    """The case and all chains."""
    if loaded.config.data.file is None:
        check(loaded)
        log.info("simulating %s", loaded.name)
    else:
        log.info("reading %s", loaded.config.data.file)
    began = time.perf_counter()
    case = build_case(loaded)
    if loaded.config.data.file is None:
        _warn_of_aliasing(loaded, case)
    lines, samples = case.recording.signal.data.shape[-2:]
    log.info("%d lines of %d samples: %.1f s", lines, samples, time.perf_counter() - began)
    return case, build_chains(loaded, radar=case.recording.radar)


def _warn_of_aliasing(loaded: Loaded, case: Case) -> None:
    """A Doppler band of the nominal aperture beyond the PRF is named with both figures, by
    `requirements`.
    """
    world, radar = loaded.config.world, case.recording.radar
    assert world is not None
    if radar.integration_s is not None:
        requirements(radar, case.recording.signal.axes, true_doppler_hz(loaded), world.velocity_m_s)


def _truth_arrays(case: Case) -> dict[str, Tensor]:
    return {} if case.truth is None else {name: torch.as_tensor(value) for name, value in case.truth.values.items()}


def _estimate_arrays(results: Mapping[str, Result]) -> dict[str, dict[str, Tensor]]:
    """Values of all estimates by method, `stage.value`; those of methods without any are
    left out.
    """
    return {
        name: {f"{stage}.{key}": value for stage, e in r.estimates.items() for key, value in e.value.items()}
        for name, r in results.items()
        if r.estimates
    }
