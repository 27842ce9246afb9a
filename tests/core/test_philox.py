"""Random numbers that are computed on their device, from the words of numpy's generator."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._dynamo.testing import CompileCounter

from tests.contract.pretended import DEVICE, Pretended, pretended_device, to_host
from torchsar.core import Draws, philox, philox_compiled

CPU = torch.device("cpu")
COMPILE = torch.compile


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


def test_normal_numbers_have_a_normal_distribution() -> None:
    """Moments to the fourth within 5 standard errors, and the Kolmogorov-Smirnov test at 0.1 %."""
    n = 1_000_000
    x = Draws(1, source="philox").normal("x", (n,))
    for power, (mean, variance) in {1: (0, 1), 2: (1, 2), 3: (0, 15), 4: (3, 96)}.items():
        assert abs(float((x**power).mean()) - mean) < 5 * math.sqrt(variance / n), power
    reached = torch.arange(n, dtype=torch.float64) / n
    below = torch.special.ndtr(x.sort().values)
    distance = float(torch.maximum(below - reached, reached + 1 / n - below).max())
    assert 0.3 < distance * math.sqrt(n) < 1.95


def test_neighbours_are_not_correlated() -> None:
    """Correlations of numbers, and of their squares, within 5 standard errors."""
    draws = Draws(1, trials=range(200), source="philox")
    x = draws.normal("x", (500,), torch.complex128)
    others = [Draws(2, trials=range(200), source="philox").normal("x", (500,), torch.complex128)]
    others += [draws.normal("y", (500,), torch.complex128), draws.part("1").normal("x", (500,), torch.complex128)]
    pairs = [(x.real, x.imag), (x[1:], x[:-1]), (x[:, 1:], x[:, :-1]), *((x, other) for other in others)]
    for a, b in pairs:
        limit = 5 / math.sqrt(a.numel())
        if a.is_complex():
            assert abs(complex((a.conj() * b).mean())) < limit and abs(complex((a * b).mean())) < limit
        else:
            assert abs(float((a * b).mean())) < limit / 2
        assert abs(float((a.abs().square() - a.abs().square().mean()).mul(b.abs().square()).mean())) < limit


@pytest.fixture(scope="module")
def traced() -> Iterator[CompileCounter]:
    """The loop of "philox_compiled" is traced but not compiled, which takes half a minute; its rows
    are short, and few make a call. The counter counts programs.
    """
    counter = CompileCounter()
    compiler = partial(COMPILE, backend=counter)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch, "compile", lambda function, options, **how: compiler(function, **how))
        patch.setattr(philox_compiled, "_WIDTH", 64)
        patch.setattr(philox_compiled, "_ROWS", 4)
        philox_compiled._tested.cache_clear()
        yield counter
        philox_compiled._tested.cache_clear()


@pytest.mark.parametrize("dtype", [torch.complex128, torch.float64, torch.complex64, torch.float32, torch.float16])
@pytest.mark.usefixtures("traced")
def test_the_compiled_loop_gives_the_same_normal_numbers(dtype: torch.dtype) -> None:
    """Within rounding, also for one row, for a last row that is not full, and for many parts."""
    for trials, shape in ((1, (64,)), (1, (128,)), (3, (7, 43)), (5, (1000,)), (0, (128,)), (2, (0,))):
        one, loop = (Draws(3, trials=range(trials), source=s) for s in ("philox", "philox_compiled"))
        expected, found = one.normal("n", shape, dtype), loop.normal("n", shape, dtype)
        double = dtype.to_real() == torch.float64
        torch.testing.assert_close(found, expected, rtol=0 if double else 2e-7, atol=4e-15 if double else 1e-12)
        assert found.is_contiguous()
        if trials:
            assert torch.equal(loop.for_trials([trials - 1]).normal("n", shape, dtype)[0], found[-1])


def test_one_program_serves_every_state_of_torch(traced: CompileCounter) -> None:
    draws = Draws(3, trials=range(2), source="philox_compiled")
    expected = draws.normal("n", (128,), torch.complex64)
    before = traced.frame_count
    for state in (torch.no_grad(), torch.enable_grad(), torch.inference_mode()):
        with state:
            assert torch.equal(draws.normal("n", (128,), torch.complex64), expected)
    assert 0 < before == traced.frame_count


def test_every_number_of_threads_has_a_tested_program(traced: CompileCounter) -> None:
    """torch.compile makes a limited number of programs of one function, here two."""
    draws, threads = Draws(3, trials=range(2), source="philox_compiled"), torch.get_num_threads()
    dtypes = (torch.complex64, torch.float64)
    expected = [draws.normal("n", (128,), dtype) for dtype in dtypes]
    tested = philox_compiled._tested.cache_info().currsize
    try:
        with torch._dynamo.config.patch(recompile_limit=2):
            for count in (threads + 1, threads):
                torch.set_num_threads(count)
                for dtype, numbers in zip(dtypes, expected, strict=True):
                    assert torch.equal(draws.normal("n", (128,), dtype), numbers)
    finally:
        torch.set_num_threads(threads)
    assert philox_compiled._tested.cache_info().currsize == tested + 2


@pytest.mark.usefixtures("traced")
def test_the_compiled_loop_stands_where_it_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draws shorter than a row are those of "philox"; others do not call it after the first one."""
    draws = Draws(3, trials=range(2), source="philox_compiled")
    assert draws.normal("n", (64,), torch.complex64).shape == (2, 64)
    monkeypatch.delattr(philox, "normal")
    assert draws.normal("n", (64,), torch.complex64).shape == (2, 64)
    with pytest.raises(AttributeError, match="normal"):
        draws.normal("n", (63,), torch.complex64)


def test_a_loop_with_wrong_numbers_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one in which a compiler left out a mask: here one row of a call is wrong."""

    def loop(rounds: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        halves = (rounds[:, 0, 0] << 32) | rounds[:, 0, 1], (rounds[:, 1, 0] << 32) | rounds[:, 1, 1]
        table, width = torch.stack(halves, -1), philox_compiled._WIDTH
        found = torch.cat([philox.words(table[i : i + 1], 4 * int(first[i]), width) for i in range(len(first))])
        found[3] ^= 1 << 62
        radius, (cosine, sine) = philox.radius_of(found, 1), philox_compiled._cosine_and_sine(found & philox.LOW)
        return (radius * cosine).float(), (radius * sine).float()

    monkeypatch.setattr(philox_compiled, "_compiled", lambda *_: loop)
    philox_compiled._tested.cache_clear()
    with pytest.raises(RuntimeError, match="gives wrong ones with this compiler; take source 'philox'"):
        Draws(3, source="philox_compiled").normal("n", (1 << 13,), torch.complex64)


def test_words_by_halves_are_those_of_numpy() -> None:
    some = [*keys(40), 0, 1, (1 << 128) - 1, 1 << 63, 1 << 127, (1 << 64) - 1]
    halves = torch.stack([half for pair in philox.round_keys(philox.key_table(some)) for half in pair], -1)
    rounds = torch.stack((philox.upper(halves), halves & philox.LOW), -1)
    assert torch.equal(philox_compiled._words(rounds, torch.arange(1, 101)[None]), host_words(some, 400))


class Narrow(int):
    """A whole number of 63 bits and a sign; operations fail that need more."""

    def __new__(cls, value: int) -> Narrow:
        assert -(1 << 63) <= value < 1 << 63, value
        return super().__new__(cls, value)

    def __add__(self, other: int) -> Narrow:
        return Narrow(int(self) + int(other))

    def __mul__(self, other: int) -> Narrow:
        return Narrow(int(self) * int(other))

    def __rshift__(self, other: int) -> Narrow:
        return Narrow(int(self) >> other)

    def __and__(self, other: int) -> Narrow:
        return Narrow(int(self) & other)

    __rmul__ = __mul__


def test_products_need_no_more_than_63_bits_and_a_sign() -> None:
    """For C++ does not define what it does beyond."""
    edges = [0, 1, (1 << 31) - 1, 1 << 31, (1 << 32) - 2, (1 << 32) - 1]
    some = np.random.default_rng(6).integers(0, 1 << 32, (300, 2)).tolist()
    for multiplier, digits in zip(philox.MULTIPLIERS, philox_compiled._DIGITS, strict=True):
        for high, low in [*((a, b) for a in edges for b in edges), *some]:
            parts = philox_compiled._product(*digits, Narrow(high), Narrow(low))  # pyright: ignore[reportArgumentType]
            found = [int(half) for pair in parts for half in pair]
            product = multiplier * ((high << 32) + low)
            assert found == [product >> shift & philox.LOW for shift in (96, 64, 32, 0)]


def test_sines_of_fractions_of_a_turn() -> None:
    """Against cosines and sines of the reduced angle, at all quarters and at random fractions."""
    some = torch.from_numpy(np.random.default_rng(5).integers(0, 1 << 32, 20_000))
    edges = torch.arange(0, 1 << 32, 1 << 29)
    angle = torch.cat((some, edges, edges + 1, (edges - 1) % (1 << 32)))
    turns = angle.to(torch.float64) * 2.0**-32
    cosine, sine = philox_compiled._cosine_and_sine(angle)
    for found, shift in ((sine, 0.0), (cosine, 0.25)):
        # near its zeros a sine has the relative accuracy of the distance from them, which is exact
        halves = (2 * (turns + shift)).round()
        near = (turns + shift - halves / 2) * (2 * math.pi)
        expected = near.sin() * (1 - 2 * (halves % 2))
        torch.testing.assert_close(found, expected, rtol=5e-16, atol=1e-18)


def test_a_loop_that_cannot_be_compiled_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> object:
        raise OSError("no compiler")

    compiler = partial(COMPILE, backend=fail)
    monkeypatch.setattr(torch, "compile", lambda function, options, **how: compiler(function, **how))
    philox_compiled._tested.cache_clear()
    with pytest.raises(RuntimeError, match="(?s)^torch.compile could not.*no compiler.*take source 'philox'"):
        Draws(3, source="philox_compiled").normal("n", (1 << 13,), torch.complex64)
    philox_compiled._tested.cache_clear()
