"""Reuse of freed memory, and the peak memory of a block."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

import torchsar
from torchsar.core import PeakMemory

FAULTS = """
import resource, sys, torch, torchsar
kept = sys.argv[1] == "kept" and torchsar.keep_freed_memory()
x = torch.ones(1 << 24)  # 64 MiB
for round in range(2):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        y = x + 1
        del y
print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> tuple[str, int]:
    done = subprocess.run([sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=True)
    kept, count = done.stdout.split()
    return kept, int(count)


def test_pages_of_freed_tensors_are_mapped_once():
    kept, count = faults("kept")
    if kept == "False":
        pytest.skip("the C library of this machine is not that of GNU")
    assert count < 0.01 * faults("returned")[1]


def test_kept_memory_does_not_hide_a_peak():
    if not torchsar.keep_freed_memory():
        pytest.skip("the C library of this machine is not that of GNU")
    big = torch.ones(1 << 26)  # 256 MiB
    del big
    with PeakMemory() as peak:
        used = torch.ones(1 << 25)
    assert peak.bytes is not None and peak.bytes > 0.9 * used.nbytes
