"""Reuse of freed memory, and the peak memory of a block."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
import torch

import torchsar
from tests.program import Program
from torchsar.study.memory import PeakMemory


def count_faults(keeps: bool) -> None:
    kept = keeps and torchsar.keep_freed_memory()
    x = torch.ones(1 << 24)  # 64 MiB
    before = 0
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(10):
            y = x + 1
            del y
    print(kept, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)


def faults(keeps: bool, folder: Path) -> tuple[str, int]:
    """In a process of its own, in which memory was not kept before."""
    program = Program(count_faults, keeps, folder=folder, said=folder / "said.txt")
    assert program.wait() == 0, program.said
    kept, count = program.said.split()
    return kept, int(count)


@pytest.mark.slow
def test_pages_of_freed_tensors_are_mapped_once(tmp_path: Path):
    """In one process of ten, by the addresses that it gets, one tensor of ten is mapped anew."""
    kept, count = faults(True, tmp_path)
    if kept == "False":
        pytest.skip("the C library of this machine is not that of GNU")
    usual = faults(False, tmp_path)[1]
    assert count < 0.01 * usual or any(faults(True, tmp_path)[1] < 0.01 * usual for _ in range(2)), count


def test_kept_memory_does_not_hide_a_peak():
    if not torchsar.keep_freed_memory():
        pytest.skip("the C library of this machine is not that of GNU")
    big = torch.ones(1 << 26)  # 256 MiB
    del big
    with PeakMemory() as peak:
        used = torch.ones(1 << 25)
    assert peak.bytes is not None and peak.bytes > 0.9 * used.nbytes
