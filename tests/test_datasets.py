"""Every system has a small example, with its truth, that depends on its seed alone."""

from __future__ import annotations

import pytest
import torch

from torchsar import datasets
from torchsar.study.table import SYSTEMS


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_system_has_a_small_example_with_its_truth(system: str) -> None:
    recording, truth = datasets.example(system)
    samples = recording.signal.data
    assert samples.numel() * samples.element_size() < 10e6 and bool(torch.isfinite(samples.abs()).all())
    assert truth.values and truth.clean is not None
    assert truth.clean.signal.axes == recording.signal.axes


def test_trials_differ_and_a_seed_repeats_them() -> None:
    (first, _), (again, _), (other, _) = (datasets.example("isal", 2, seed=seed) for seed in (3, 3, 4))
    one, two = first.signal.data
    assert torch.equal(first.signal.data, again.signal.data)
    assert not torch.equal(one, two) and not torch.equal(first.signal.data, other.signal.data)


def test_an_unknown_system_is_one_sentence() -> None:
    with pytest.raises(ValueError, match="no example of a system 'sar'; choose one of stripmap, isal, "):
        datasets.example("sar")
