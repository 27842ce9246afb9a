"""Random numbers of the compiled loop, and their distribution for every source.

The loop is traced but not compiled, which takes half a minute.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor
from torch._inductor import compile_fx
from torch._subclasses.fake_tensor import FakeTensorMode

from torchsar.core import Draws, philox, threefry
from torchsar.core.draws import Source
from torchsar.core.memory import LargestTensor

CPU = torch.device("cpu")
# counters, keys and words that Salmon et al. publish with their generators
KNOWN = (
    (("00000000",) * 4, ("00000000",) * 4, ("531c7e4f", "39491ee5", "2c855a92", "3d6abf9a")),
    (("ffffffff",) * 4, ("ffffffff",) * 4, ("c4189358", "1c9cc83a", "d5881c67", "6a0a89e0")),
    (
        ("243f6a88", "85a308d3", "13198a2e", "03707344"),
        ("a4093822", "299f31d0", "082efa98", "ec4e6c89"),
        ("4aa71d8f", "734738c2", "431fc6a8", "ae6debf1"),
    ),
)


def signed(x: int) -> int:
    """The number of 32 bits and a sign with the same bits."""
    return (x + (1 << 31)) % (1 << 32) - (1 << 31)


@pytest.fixture(scope="module")
def traced() -> Iterator[list[torch.fx.GraphModule]]:
    """The tensor operations of the traced loop take the place of the compiled one. Sixty-four
    complex numbers are a long draw, in calls of up to a hundred blocks. The list holds the loops.
    """
    graphs: list[torch.fx.GraphModule] = []

    def compiler(graph: torch.fx.GraphModule, *_: object, **__: object) -> torch.fx.GraphModule:
        graphs.append(graph)
        return graph

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compile_fx, "compile_fx", compiler)
        patch.setattr(threefry, "_LONG", 64)
        patch.setattr(threefry, "_BLOCKS", 100)
        threefry._tested.cache_clear()
        yield graphs
        threefry._tested.cache_clear()


def test_words_are_those_that_are_published() -> None:
    counters, keys, expected = torch.tensor(
        [[[signed(int(x, 16)) for x in part] for part in row] for row in KNOWN]
    ).unbind(1)
    addends = threefry.schedule([sum((x % (1 << 32)) << (32 * i) for i, x in enumerate(key)) for key in keys.tolist()])
    found = threefry.words(addends, list(counters.to(torch.int32).T))
    assert torch.equal(torch.stack(found, -1).long(), expected)


def test_normal_numbers_are_those_of_words() -> None:
    """Each number by itself, with the functions of Python."""
    key, blocks = 0x9E3779B97F4A7C15F39CC0605CEDC835, 50
    made = threefry._expected([key], blocks, torch.complex128, CPU)[0].tolist()
    for block in range(blocks):
        counter = [torch.tensor([block], dtype=torch.int32)] * 4
        a, b, c, d = (int(word) % (1 << 32) for word in threefry.words(threefry.schedule([key]), counter))
        for number, high, low in ((made[block], a, b), (made[blocks + block], c, d)):
            radius = math.sqrt(-math.log((high + 0.5) / (1 << 32)))
            angle = math.tau * low / (1 << 32)
            assert abs(number - radius * complex(math.cos(angle), math.sin(angle))) < 1e-14


@pytest.mark.parametrize("dtype", [torch.complex128, torch.float64, torch.complex64, torch.float32, torch.bfloat16])
@pytest.mark.usefixtures("traced")
def test_the_loop_gives_the_expected_numbers(dtype: torch.dtype) -> None:
    """Also for odd numbers, and each trial by itself."""
    for trials, shape in ((1, (128,)), (1, (129,)), (3, (7, 43)), (5, (1000,)), (2, (999,))):
        source, count = Draws(3, trials=range(trials), source="threefry"), math.prod(shape)
        found, keys = source.normal("n", shape, dtype), source._keys("n")
        per_complex = 1 if dtype.is_complex else 2
        expected = threefry._expected(keys, -(-count // (2 * per_complex)), torch.complex128, CPU)
        if not dtype.is_complex:
            expected = torch.view_as_real(expected).flatten(1) * math.sqrt(2)
        expected = expected[:, :count].reshape(found.shape).to(dtype)
        close = {torch.float64: 1e-14, torch.float32: 2e-6, torch.bfloat16: 0.02}[dtype.to_real()]
        torch.testing.assert_close(found, expected, rtol=0, atol=close)
        assert found.is_contiguous() and found.dtype == dtype
        assert torch.equal(source.for_trials([trials - 1]).normal("n", shape, dtype)[0], found[-1])


def test_single_precision_keeps_the_radius_at_both_ends() -> None:
    """For the largest and the smallest one, where the exponent changes, and in all quarters."""
    edges = [0, 1, 2, 3, 255, 1 << 24, (1 << 30) - 1, 1 << 30, (1 << 31) - 200, (1 << 31) - 1, 1 << 31]
    ends = torch.tensor([signed(sign * edge) for edge in edges for sign in (1, -1)], dtype=torch.int32)
    root = torch.tensor([signed(int(2**31.5) + i) for i in range(-200, 200)], dtype=torch.int32)
    some = torch.randint(-(1 << 31), 1 << 31, (20_000,), dtype=torch.int32, generator=torch.Generator().manual_seed(1))
    for high, low in ((ends[:, None], ends), (root[:, None], ends), (some, some.flip(0))):
        high, low = torch.broadcast_tensors(high, low)
        found, expected = (torch.complex(*parts(high, low)) for parts in (threefry._single_parts, threefry._parts))
        error = (found - expected).abs() / expected.abs()
        assert float(error.max()) < 10 * torch.finfo(torch.float32).eps


def test_the_largest_and_the_smallest_number() -> None:
    high, low = torch.tensor([0, -1], dtype=torch.int32), torch.zeros(2, dtype=torch.int32)
    for parts in (threefry._parts, threefry._single_parts):
        largest, smallest = parts(high, low)[0].tolist()
        assert largest == pytest.approx(math.sqrt(33 * math.log(2))) and 1e-5 < smallest < 1.1e-5


def test_one_loop_serves_every_state_of_torch(traced: list[torch.fx.GraphModule]) -> None:
    """Also modes in which torch.compile refuses to run, such as that which measures memory."""
    source, threads = Draws(3, trials=range(2), source="threefry"), torch.get_num_threads()

    def draw() -> Tensor:
        return source.normal("n", (501,), torch.complex64)

    threefry._tested.cache_clear()
    before = len(traced)
    with LargestTensor():
        expected = draw()
    states = (torch.no_grad(), torch.enable_grad(), torch.inference_mode(), torch.autocast("cpu"), torch.device("cpu"))
    for state in states:
        with state:
            assert torch.equal(draw(), expected)
    try:
        torch.set_num_threads(threads + 1)
        torch.set_default_dtype(torch.float64)
        assert torch.equal(draw(), expected)
    finally:
        torch.set_num_threads(threads)
        torch.set_default_dtype(torch.float32)
    assert len(traced) == before + 1 and not draw().is_inference()


@pytest.mark.usefixtures("traced")
def test_transforms_see_constants() -> None:
    def power(x: Tensor) -> Tensor:
        return (x * Draws(3, source="threefry").normal("n", (128,), torch.complex128)).abs().square().sum()

    x = torch.tensor(2.0, dtype=torch.float64)
    expected = 2 * power(x) / x
    torch.testing.assert_close(torch.func.grad(power)(x), expected)
    torch.testing.assert_close(torch.func.jvp(power, (x,), (torch.ones_like(x),))[1], expected)
    torch.testing.assert_close(torch.func.vmap(power)(x[None])[0], power(x))


@pytest.mark.usefixtures("traced")
def test_tensors_without_numbers_have_the_shape() -> None:
    source = Draws(3, trials=range(2), source="threefry")
    assert source.normal("n", (128,), torch.complex64, "meta").is_meta
    with FakeTensorMode():
        assert source.normal("n", (128,), torch.complex64).shape == (2, 128)


@pytest.mark.usefixtures("traced")
def test_other_draws_are_those_of_philox() -> None:
    """Short ones, none at all, uniform numbers and orders."""
    for trials, shape, dtype in (
        (2, (63,), torch.complex64),
        (2, (127,), torch.float32),
        (0, (128,), torch.complex64),
        (2, (0,), torch.float32),
    ):
        one, other = (
            Draws(3, trials=range(trials), source=s).normal("n", shape, dtype) for s in ("philox", "threefry")
        )
        assert torch.equal(one, other)
    assert threefry.uniform is philox.uniform and threefry.permutation is philox.permutation


def test_a_loop_with_wrong_numbers_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as one in which a compiler left out a mask: here one number of one key is wrong."""

    def loop(counter: Tensor, addends: Tensor, first: Tensor, second: Tensor) -> None:
        a, b, c, d = threefry.words(addends, [counter] * 4)
        if torch.equal(addends, threefry.schedule(threefry._TEST_KEYS[5:6])[..., 0]):
            c[-1] ^= 1 << 30
        first.copy_(threefry._bits(*threefry._single_parts(a, b)))
        second.copy_(threefry._bits(*threefry._single_parts(c, d)))

    monkeypatch.setattr(threefry, "_compiled", lambda *_: loop)
    threefry._tested.cache_clear()
    with pytest.raises(RuntimeError, match="gives wrong ones with this compiler; take source 'philox'"):
        Draws(3, source="threefry").normal("n", (1 << 14,), torch.complex64)
    threefry._tested.cache_clear()


def test_a_loop_that_cannot_be_compiled_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> object:
        raise OSError("no compiler")

    threefry._tested.cache_clear()
    source = Draws(3, source="threefry")
    monkeypatch.setattr(compile_fx, "compile_fx", fail)
    with pytest.raises(RuntimeError, match="^torch.compile could not.*: no compiler. Install.*take source 'philox'$"):
        source.normal("n", (1 << 14,), torch.complex64)
    monkeypatch.setattr(torch, "compile", lambda function, **_: function)
    with pytest.raises(RuntimeError, match="^torch.compile could not.*: it is switched off. Install"):
        source.normal("n", (1 << 14,), torch.complex64)


@pytest.mark.parametrize("source", ["philox", "threefry"])
@pytest.mark.usefixtures("traced")
def test_normal_numbers_have_a_normal_distribution(source: Source) -> None:
    """Moments to the fourth within 5 standard errors, and the Kolmogorov-Smirnov test at 0.1 %."""
    n = 1_000_000
    x = Draws(1, source=source).normal("x", (n,))
    for power, (mean, variance) in {1: (0, 1), 2: (1, 2), 3: (0, 15), 4: (3, 96)}.items():
        assert abs(float((x**power).mean()) - mean) < 5 * math.sqrt(variance / n), power
    reached = torch.arange(n, dtype=torch.float64) / n
    below = torch.special.ndtr(x.sort().values)
    distance = float(torch.maximum(below - reached, reached + 1 / n - below).max())
    assert 0.3 < distance * math.sqrt(n) < 1.95


@pytest.mark.parametrize("source", ["philox", "threefry"])
@pytest.mark.usefixtures("traced")
def test_neighbours_are_not_correlated(source: Source) -> None:
    """Correlations of numbers, and of their squares, within 5 standard errors."""
    draws = Draws(1, trials=range(200), source=source)
    x = draws.normal("x", (500,), torch.complex128)
    others = [Draws(2, trials=range(200), source=source).normal("x", (500,), torch.complex128)]
    others += [draws.normal("y", (500,), torch.complex128), draws.part("1").normal("x", (500,), torch.complex128)]
    pairs = [
        (x.real, x.imag),
        (x[1:], x[:-1]),
        (x[:, 1:], x[:, :-1]),
        (x[:, 250:], x[:, :250]),
        *((x, other) for other in others),
    ]
    for a, b in pairs:
        limit = 5 / math.sqrt(a.numel())
        if a.is_complex():
            assert abs(complex((a.conj() * b).mean())) < limit and abs(complex((a * b).mean())) < limit
        else:
            assert abs(float((a * b).mean())) < limit / 2
        assert abs(float((a.abs().square() - a.abs().square().mean()).mul(b.abs().square()).mean())) < limit
