"""What the version of a benchmark fixes: fingerprints of its scenes, and a score.

    python -m tests.bench.frozen path rotation

writes those of the benchmarks `path` and `rotation` of today into the table of the package, of
which the checksums of the version are made.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import torch
from torch import Tensor

from torchsar.core import Estimate, Outcome
from torchsar.study.bench.frame import Batch, Bench, counted, row, samples
from torchsar.study.bench.records import HERE, bench, checksum

FILE = HERE / "frozen.json"


def table() -> dict[str, Any]:
    """The table of the package, by benchmark."""
    return json.loads(FILE.read_text(encoding="utf-8"))


def fingerprint(x: Tensor) -> list[float]:
    """Three numbers of samples: their rms, and a projection on fixed phasors relative to it."""
    flat = x.detach().to(torch.complex128).reshape(-1)
    flat = torch.where(torch.isfinite(flat.abs()), flat, 0)
    k = torch.arange(len(flat), dtype=torch.float64)
    norm = float(torch.linalg.vector_norm(flat))
    part = complex((flat * torch.polar(torch.ones_like(k), 1.618 * k.square() % (2 * math.pi))).sum())
    three = norm / max(1, len(flat)) ** 0.5, part.real / (norm or 1), part.imag / (norm or 1)
    return [float(f"{y:.6g}") for y in three]


def frozen(one: Bench) -> dict[str, Any]:
    """What the version of a benchmark fixes: first data and truth of each world, and a score."""
    found: dict[str, Any] = {}
    seen: set[int] = set()
    for entry in one.entries():
        for world in entry.worlds:
            if id(world) in seen:
                continue
            seen.add(id(world))
            batch = world.blocks(1)[0]
            truth = [fingerprint(x) for _, x in sorted((batch.truth or {}).items())]
            label = f"{entry.name}: {world.label}" if world.label in found else world.label
            found[label] = [fingerprint(samples(batch.data)), *truth]
    return {"worlds": found, "score": _example(one)}


def _example(one: Bench) -> dict[str, Any]:
    """Scores of an estimate near the truth, sure in every second trial."""
    entry = one.entries()[0]
    for world in entry.worlds:
        batch: Batch = world.blocks(4)[0]
        if batch.truth is not None:
            break
    value, std = {}, {}
    for quantity in (q for q in entry.judged if q.name in (batch.truth or {})):
        truth = (batch.truth or {})[quantity.name].double().nan_to_num()
        wave = torch.cos(torch.arange(truth.numel(), dtype=torch.float64).square()).reshape(truth.shape)
        value[quantity.name] = truth + 0.7 * quantity.tolerance * wave
        std[quantity.name] = torch.full_like(truth, 0.5 * quantity.tolerance)
    ok = torch.arange(4) % 2 == 0
    found = Estimate(value, std, outcome=Outcome.of(ok, Outcome.INEXACT), quality=ok.double())
    return row(counted(entry, batch, found, one.scores))


def main(names: list[str]) -> None:
    """Write what is frozen of benchmarks, one world per line, and print the checksums."""
    kept = table() | {name: frozen(bench(name)) for name in names}
    texts = []
    for name, one in sorted(kept.items()):
        worlds = ",\n".join(f"   {json.dumps(label)}: {json.dumps(world)}" for label, world in one["worlds"].items())
        texts.append(f' "{name}": {{"score": {json.dumps(one["score"])}, "worlds": {{\n{worlds}}}}}')
    FILE.write_text("{\n" + ",\n".join(texts) + "\n}\n", encoding="utf-8")
    print({name: checksum(name) for name in kept})


if __name__ == "__main__":
    main(sys.argv[1:])
