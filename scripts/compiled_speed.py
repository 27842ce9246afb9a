"""Time and rounding of packaged chains as programs of torch.compile, beside the chains as they are.

    python scripts/compiled_speed.py --out FILE.json [CONFIG ...] [--backend NAME] [--seconds S]

The chain of one method of the first case of each config (by default one config of each system)
becomes one graph, with the estimates that it found held. A row holds the `config` and the `method`,
the `compile_s` of the first call, the largest `difference` of an image of other data relative to
its largest pixel, the `seconds` of one call of the chain as it is, and the `gain`, which is the
median ratio of this time to that of the program, measured in turn. A config that cannot be compiled
is named with the reason under `failed`. The file is written after each config.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchsar import keep_freed_memory
from torchsar.core import Chain, Draws, Recording
from torchsar.study.settings.sections import cases_of
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

# one config of each system, with a method whose images do not hang on what a stage detects
CONFIGS = {
    "airborne_spotlight": "recommended",
    "geo_ocean": "conventional",
    "geo_point_targets": "recommended",
    "isal_satellite": "recommended",
    "isal_table1": "recommended",
    "sal_points": "recommended",
    "stripmap_damaged": "none",
}


class Program(nn.Module):
    """The image that a chain forms of other data, with the estimates of its first recording."""

    def __init__(self, chain: Chain, recording: Recording) -> None:
        super().__init__()
        self.chain, self.recording = chain, recording
        found = chain.trace(recording).estimates
        self.values = {f"{stage}.{name}": v for stage, one in found.items() for name, v in one.value.items()}

    def forward(self, data: Tensor) -> Tensor:
        recording = replace(self.recording, signal=self.recording.signal.with_data(data))
        return self.chain.trace(recording, self.values).signal.data


def seconds(work: Callable[[], Any]) -> float:
    """Wall time of one call."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


@torch.no_grad()
def measured(config: str, backend: str, budget_s: float) -> dict[str, Any]:
    """The row of one config."""
    loaded = next(iter(cases_of(load(config)).values()))
    bench = Bench(loaded)
    recording = bench.trials(Draws(loaded.config.seed, trials=[0])).recording
    module, data = Program(bench.chains[CONFIGS.get(config, "recommended")], recording), recording.signal.data
    torch.compiler.reset()
    program = torch.compile(module, fullgraph=True, backend=backend)
    compile_s = seconds(lambda: program(data))
    other = 1.5 * data.flip(0).roll(1, -1)
    image, found = module(other), program(other)
    plain, compiled = [], []
    while len(plain) < 3 or sum(plain) + sum(compiled) < budget_s:
        plain.append(seconds(lambda: module(data)))
        compiled.append(seconds(lambda: program(data)))
    numbers = {
        "compile_s": compile_s,
        "difference": float((found - image).abs().max() / image.abs().max()),
        "seconds": statistics.median(plain),
        "gain": statistics.median(a / b for a, b in zip(plain, compiled, strict=True)),
    }
    return {"config": config, "method": CONFIGS.get(config, "recommended")} | {
        name: float(f"{x:.3g}") for name, x in numbers.items()
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("configs", nargs="*", default=list(CONFIGS), help="one of each system by default")
    parser.add_argument("--out", type=Path, required=True, help="file for the rows, .json")
    parser.add_argument("--backend", default="inductor", help="compiler behind torch.compile")
    parser.add_argument("--seconds", type=float, default=3.0, help="how long each chain is measured")
    options = parser.parse_args(arguments)
    keep_freed_memory()  # as the commands do
    os.environ.setdefault("TORCHINDUCTOR_FORCE_DISABLE_CACHES", "1")  # else `compile_s` is that of a second time
    torch.set_num_threads(1)
    about = {
        "processor": platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "backend": options.backend,
    }
    rows, failed = list[dict[str, Any]](), dict[str, str]()
    for config in options.configs:
        try:
            rows.append(measured(config, options.backend, options.seconds))
            print(json.dumps(rows[-1]), flush=True)
        except Exception as error:  # of the compiler, of any kind
            failed[config] = f"{type(error).__name__}: {error}".splitlines()[0]
            print(f"{config}: {failed[config]}", flush=True)
        lines = ",\n".join(map(json.dumps, rows))
        text = f'{{"machine": {json.dumps(about)},\n"failed": {json.dumps(failed)},\n"rows": [\n{lines}\n]}}\n'
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
