"""Random numbers that are computed on their device, from the words of numpy's generator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.contract.pretended import DEVICE, Pretended, pretended_device, to_host
from torchsar.core import Draws, philox

CPU = torch.device("cpu")


def keys(count: int) -> list[int]:
    source = np.random.default_rng(4)
    return [int.from_bytes(source.bytes(16), "little") for _ in range(count)]


def host_words(some: Sequence[int], count: int) -> Tensor:
    found = np.stack([np.random.Philox(key=key).random_raw(count) for key in some])
    return torch.from_numpy(found.view(np.int64))


@pytest.fixture
def by_tensors(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the CPU too, words are computed by tensor operations, in blocks of another size."""
    monkeypatch.setattr(philox, "_SHORT", math.inf)
    monkeypatch.setattr(philox, "_MANY", 0)
    monkeypatch.setattr(philox, "_CPU_BLOCK", 900)


def everything() -> list[Tensor]:
    draws = Draws(3, trials=range(5), source="philox")
    return [
        *(draws.normal("n", (7, 43), dtype) for dtype in (torch.complex64, torch.float64)),
        draws.uniform("u", (2000,), -1.0, 3.0),
        draws.permutation("p", [50, 0, 1, 50, 7]),
        draws.subset("p", 50, 20),
    ]


def test_words_are_those_of_numpy() -> None:
    some = [*keys(40), 0, 1, (1 << 128) - 1, 1 << 63, 1 << 127, (1 << 64) - 1]
    assert torch.equal(philox.words(philox.key_table(some), 0, 403), host_words(some, 403))


def test_words_are_those_of_numpy_far_from_the_beginning() -> None:
    key, block = keys(1)[0], (1 << 40) + 3
    expected = np.random.Philox(counter=block, key=key).random_raw(9).view(np.int64)
    assert torch.equal(philox.words(philox.key_table([key]), 4 * block, 9)[0], torch.from_numpy(expected))


@pytest.mark.parametrize("edges", [(0, 1, 2, 3, 4, 5, 50), (0, 7, 20, 20, 50), (0, 49, 50)])
def test_words_do_not_depend_on_a_division_of_the_counter(edges: tuple[int, ...]) -> None:
    table = philox.key_table(keys(3))
    parts = [philox.words(table, first, last - first) for first, last in pairwise(edges)]
    assert torch.equal(torch.cat(parts, -1), philox.words(table, 0, 50))


def test_draws_on_a_device_copy_their_keys_alone() -> None:
    """The numbers are those of the CPU, and the host waits for none of them."""
    draws = Draws(3, trials=range(4), source="philox")
    for draw, copies in (
        (lambda device: draws.normal("n", (5, 7), torch.complex64, device), 1),
        (lambda device: draws.normal("n", (), torch.float32, device), 1),
        (lambda device: draws.uniform("u", (9,), -1.0, 3.0, torch.float32, device), 1),
        (lambda device: draws.subset("p", 50, 20, device), 1),
        (lambda device: draws.permutation("p", [50, 0, 7, 3], device), 2),
    ):
        expected = draw(None)
        with pretended_device() as counts:
            found = draw(DEVICE)
        assert torch.equal(to_host(found), expected) and isinstance(found, Pretended)
        assert counts.uploads.total() == copies and not counts.waits.total()


def test_tensors_and_numpy_give_the_same_numbers(request: pytest.FixtureRequest) -> None:
    by_numpy = everything()
    request.getfixturevalue("by_tensors")
    for found, expected in zip(everything(), by_numpy, strict=True):
        assert torch.equal(found, expected)


def test_short_draws_of_many_trials_are_those_of_single_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(philox, "_CPU_BLOCK", 512)
    many = Draws(3, trials=range(700), source="philox").normal("n", (3,))
    some = [0, 1, 255, 256, 699]
    assert torch.equal(Draws(3, trials=some, source="philox").normal("n", (3,)), many[some])


def test_blocks_do_not_show() -> None:
    n = 2 * philox._CPU_BLOCK + 5
    one, key = Draws(3, source="philox"), Draws(3)._keys("n")
    u, x = one.uniform("n", (n,)), one.normal("n", (2 * n - 1,))
    word = host_words(key, n)[0].numpy().view(np.uint64)
    radius = np.sqrt(-2 * np.log(((word >> np.uint64(32)) + 0.5) * 2.0**-32))
    angle = 2 * np.pi * 2.0**-32 * (word & np.uint64((1 << 32) - 1))
    expected = np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1).reshape(-1)[:-1]
    np.testing.assert_allclose(x.numpy(), expected, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(u.numpy(), (word >> np.uint64(11)) * 2.0**-53)


def test_uniform_numbers_are_those_of_numpy() -> None:
    for limits in ((0.0, 1.0), (-3.0, 5.5)):
        made = [Draws(3, trials=range(3), source=s).uniform("u", (100,), *limits) for s in ("numpy", "philox")]
        assert torch.equal(*made)


def test_the_largest_normal_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The words of all zeros and of all ones give the largest and the smallest radius."""
    monkeypatch.setattr(philox, "_blocks", lambda *_: [(slice(0, 1), 0, torch.tensor([[0, -1]]))])
    largest, _, smallest, _ = philox.normal([0], (4,), torch.float64, CPU)[0].tolist()
    assert largest == pytest.approx(math.sqrt(66 * math.log(2))) and 0 < smallest < 2e-5


def test_an_order_keeps_the_filling_last_for_the_largest_words(monkeypatch: pytest.MonkeyPatch) -> None:
    largest = torch.iinfo(torch.int64).max
    some = torch.tensor([[largest, largest, 0], [-1, largest, -2]])
    monkeypatch.setattr(philox, "_blocks", lambda *_: [(slice(0, 2), 0, some)])
    assert philox.permutation([0, 0], [2, 3], CPU).tolist() == [[0, 1, 2], [2, 0, 1]]
