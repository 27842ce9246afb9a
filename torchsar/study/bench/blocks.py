"""Methods on recorded pulses, whose true phases nobody knows."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchsar.core import Signal
from torchsar.io import read_inverse
from torchsar.metrics import phase_rmse
from torchsar.study.bench.frame import estimate_of
from torchsar.study.bench.pulses import of_image, turned, white
from torchsar.study.bench.records import bench, entries_of
from torchsar.study.bench.show import aligned

# SHA-256 of the samples as complex64 of the blocks that the page of benchmarks describes
BLOCKS = {
    "687d1df4308eb5040b4eff119ffcbed33dfff1f09a35117d8c0479ab413d7331": "Yak-42 in flight",
    "92167fa81529ad52eca25ed7b3184dbece72a677f041c7c22721b56bd2c69f48": "model aircraft at 220 GHz",
    "98d3c33fc3388641c3f0190303e07dd7cd2add1dfad8d31efd1130b9ad331919": "Gotcha, pass 1, 0 to 3 degrees",
}


def checksum_of(path: Path) -> str:
    """SHA-256 of the samples of an archive that `read_inverse` reads, as complex64."""
    with np.load(path) as archive:
        (samples,) = (archive[name] for name in ("profiles", "sig", "fp") if name in archive)
    return hashlib.sha256(np.ascontiguousarray(samples, "<c8").tobytes()).hexdigest()


def remarks(path: Path, methods: Mapping[str, Any] | None = None) -> str:
    """Text of a table of methods on the pulses of a recording, see `score` for the methods.

    There is no truth, and so no score and no order: the entropy of the image in nats, `ok`, and rms
    differences of the phases in rad, from those of the other methods (median), and from what the
    method finds with white phases added to the pulses, less these.
    """
    signal, sha = read_inverse(path).signal, checksum_of(path)
    x, added = signal.data[None], white(1, len(signal.data))
    found = {}
    for entry in entries_of(bench("autofocus"), methods):
        plain, moved = (estimate_of(entry.run(Signal(data, signal.axes))) for data in (x, turned(x, added)))
        found[entry.name] = plain, moved["phase_rad"].double() - added
    lines = [["method", "entropy", "ok", "from others", "from itself"]]
    for name, (plain, again) in found.items():
        phase = plain["phase_rad"].double()
        others = [phase_rmse(phase, other["phase_rad"].double()) for key, (other, _) in found.items() if key != name]
        apart = torch.stack(others or [torch.tensor([torch.nan])]).median()
        numbers = of_image(x, phase), apart, phase_rmse(again, phase)
        entropy, *differences = (f"{float(number):.3f}" for number in numbers)
        lines.append([name, entropy, "yes" if bool(plain.ok.all()) else "no", *differences])
    block = BLOCKS.get(sha, f"no block of the page of benchmarks, SHA-256 of its samples {sha}")
    return aligned(f"{path.name}: {block}; without a truth, so that nothing is ranked", lines)
