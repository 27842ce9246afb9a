"""Random numbers of both sources: what they depend on, and their distribution."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.contract.pretended import DEVICE, Pretended, pretended_device, to_host
from torchsar.core import Draws, Source
from torchsar.study.montecarlo.work import LargestTensor


@pytest.mark.parametrize("source", ["numpy", "torch"])
class TestDraws:
    def test_chunks_and_order_do_not_matter(self, source: Source) -> None:
        draws = Draws(7, trials=range(6), source=source)
        whole = draws.normal("noise", (4, 5), torch.complex64)
        parts = [draws.for_trials(t).normal("noise", (4, 5), torch.complex64) for t in ([0, 1], [2], [3, 4, 5])]
        assert torch.equal(whole, torch.cat(parts))
        assert torch.equal(draws.for_trials([5, 0]).normal("noise", (4, 5), torch.complex64), whole[[5, 0]])

    def test_a_single_trial_is_the_first(self, source: Source) -> None:
        one, many = (Draws(7, trials=trials, source=source) for trials in (None, range(3)))
        for draw in (
            lambda draws: draws.normal("x"),
            lambda draws: draws.normal("x", (3,), torch.complex64),
            lambda draws: draws.uniform("x", (2, 3)),
            lambda draws: draws.permutation("x", 9),
            lambda draws: draws.subset("x", 9, 4),
        ):
            assert torch.equal(draw(one), draw(many)[0])

    def test_each_trial_has_its_own_case(self, source: Source) -> None:
        draws = Draws(7, ("a", "b", "a"), [0, 0, 4], source).part("sea")
        found = draws.normal("noise", (5,))
        for i, (case, trial) in enumerate(draws.addresses):
            assert torch.equal(found[i], Draws(7, case, [trial], source).normal("noise", (5,))[0])

    def test_a_number_of_trials_in_place_of_indices_is_refused(self, source: Source) -> None:
        with pytest.raises(TypeError, match=r"trials=range\(4\)"):
            Draws(7, trials=4, source=source)  # type: ignore[arg-type]

    @pytest.mark.parametrize("dtype", [torch.complex64, torch.float64, torch.bfloat16])
    def test_threads_do_not_matter(self, source: Source, dtype: torch.dtype) -> None:
        """Also without the records of autograd, which threads do not know of."""
        draws, threads = Draws(7, trials=range(3), source=source), torch.get_num_threads()
        try:
            torch.set_num_threads(2)
            with torch.inference_mode():
                many = draws.normal("noise", (50_000,), dtype)
        finally:
            torch.set_num_threads(threads)
        assert torch.equal(many, draws.normal("noise", (50_000,), dtype))
        assert torch.equal(draws.for_trials([2]).normal("noise", (50_000,), dtype), many[2:])

    @pytest.mark.parametrize("dtype", [torch.complex64, torch.float32])
    def test_no_trials_and_no_numbers(self, source: Source, dtype: torch.dtype) -> None:
        draws = Draws(7, trials=range(3), source=source)
        none = draws.for_trials([])
        assert none.normal("noise", (4,), dtype).shape == (0, 4) == none.uniform("u", (4,)).shape
        assert none.permutation("order", []).shape == (0, 0)
        assert draws.normal("noise", (0, 4), dtype).shape == (3, 0, 4)

    def test_earlier_draws_do_not_change_a_draw(self, source: Source) -> None:
        a, b = Draws(7, source=source), Draws(7, source=source)
        b.uniform("something else", (1000,))
        torch.randn(1000)
        assert torch.equal(a.normal("noise", (9,)), b.normal("noise", (9,)))

    @pytest.mark.parametrize(
        "change",
        [
            lambda draws: replace(draws, seed=8),
            lambda draws: replace(draws, case="snr=3"),
            lambda draws: draws.part("sea"),
            lambda draws: draws.for_trials([1]),
        ],
    )
    def test_every_part_of_the_address_changes_the_draw(self, source: Source, change: Callable[[Draws], Draws]) -> None:
        draws = Draws(7, source=source)
        assert not torch.equal(draws.normal("noise", (9,)), change(draws).normal("noise", (9,)).reshape(-1))

    def test_states_of_torch_do_not_change_a_draw(self, source: Source) -> None:
        def draw() -> Tensor:
            return Draws(7, trials=range(2), source=source).normal("noise", (501,), torch.complex64)

        expected = draw()
        for state in (torch.no_grad(), torch.inference_mode(), torch.autocast("cpu"), torch.device("cpu")):
            with state:
                assert torch.equal(draw(), expected)
        with LargestTensor():
            assert torch.equal(draw(), expected)
        try:
            torch.set_default_dtype(torch.float64)
            assert torch.equal(draw(), expected)
        finally:
            torch.set_default_dtype(torch.float32)

    def test_subset_has_no_repetition(self, source: Source) -> None:
        picked = Draws(1, trials=range(3), source=source).subset("lost", 50, 20)
        assert picked.shape == (3, 20) and all(len(set(row.tolist())) == 20 for row in picked)

    def test_a_permutation_begins_with_the_subset(self, source: Source) -> None:
        draws = Draws(1, trials=range(3), source=source)
        order = draws.permutation("lost", 50)
        assert torch.equal(order.sort(-1).values, torch.arange(50).expand(3, -1))
        assert torch.equal(order[:, :20].sort(-1).values, draws.subset("lost", 50, 20))
        uneven = draws.permutation("lost", [50, 7, 0])
        assert torch.equal(uneven[0], order[0]) and uneven[1, 7:].tolist() == list(range(7, 50))
        assert torch.equal(uneven[1, :7], Draws(1, trials=[1], source=source).permutation("lost", 7)[0])
        assert uneven[2].tolist() == list(range(50))

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
    def test_uniform_numbers_fill_their_limits_evenly(self, source: Source, dtype: torch.dtype) -> None:
        x = Draws(1, source=source).uniform("x", (100_000,), -1.0, 3.0, dtype)
        assert x.dtype == dtype and float(x.min()) >= -1 and float(x.max()) <= 3
        for power, (mean, variance) in {1: (1, 4 / 3), 2: (7 / 3, 6.76)}.items():
            assert abs(float((x.double() ** power).mean()) - mean) < 5 * math.sqrt(variance / x.numel()) + 0.01

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_normal_numbers_have_a_normal_distribution(self, source: Source, dtype: torch.dtype) -> None:
        """Moments to the fourth within 5 standard errors; Kolmogorov-Smirnov test at 0.1 %."""
        n = 1_000_000
        x = Draws(1, source=source).normal("x", (n,), dtype).double()
        for power, (mean, variance) in {1: (0, 1), 2: (1, 2), 3: (0, 15), 4: (3, 96)}.items():
            assert abs(float((x**power).mean()) - mean) < 5 * math.sqrt(variance / n), power
        reached = torch.arange(n, dtype=torch.float64) / n
        below = torch.special.ndtr(x.sort().values)
        distance = float(torch.maximum(below - reached, reached + 1 / n - below).max())
        assert 0.3 < distance * math.sqrt(n) < 1.95
        assert 4.3 < float(x.abs().max()) < 6

    def test_numbers_of_short_rows_are_normal(self, source: Source) -> None:
        """Trials of a few numbers, which torch draws in another way than many."""
        x = Draws(1, trials=range(20_000), source=source).normal("x", (3,), torch.complex64)
        power = x.abs().square()
        for mean, expected, variance in (
            (power.mean(), 1, 1),
            (power.square().mean(), 2, 20),
            (x.real.square().mean(), 0.5, 0.5),
            ((x.real * x.imag).mean(), 0, 0.25),
        ):
            assert abs(float(mean) - expected) < 5 * math.sqrt(variance / x.numel())

    @pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
    def test_neighbours_are_not_correlated(self, source: Source, dtype: torch.dtype) -> None:
        """Correlations of numbers, and of their squares, within 5 standard errors."""
        draws = Draws(1, trials=range(200), source=source)
        x = draws.normal("x", (500,), dtype).to(torch.complex128)
        others = [Draws(2, trials=range(200), source=source).normal("x", (500,), dtype)]
        others += [draws.normal("y", (500,), dtype), draws.part("1").normal("x", (500,), dtype)]
        pairs = [
            (x.real, x.imag),
            (x[1:], x[:-1]),
            (x[:, 1:], x[:, :-1]),
            (x[:, 250:], x[:, :250]),
            *((x, other.to(torch.complex128)) for other in others),
        ]
        for a, b in pairs:
            limit = 5 / math.sqrt(a.numel())
            if a.is_complex():
                assert abs(complex((a.conj() * b).mean())) < limit and abs(complex((a * b).mean())) < limit
            else:
                assert abs(float((a * b).mean())) < limit / 2
            assert abs(float((a.abs().square() - a.abs().square().mean()).mul(b.abs().square()).mean())) < limit

    def test_transforms_and_programs_see_constants(self, source: Source) -> None:
        class Power(torch.nn.Module):
            def forward(self, x: Tensor) -> Tensor:
                return (x * Draws(3, source=source).normal("n", (9,), torch.complex128)).abs().square().sum()

        power, x = Power(), torch.tensor(2.0, dtype=torch.float64)
        expected = 2 * power(x) / x
        torch.testing.assert_close(torch.func.grad(power)(x), expected)
        torch.testing.assert_close(torch.func.jvp(power, (x,), (torch.ones_like(x),))[1], expected)
        torch.testing.assert_close(torch.func.vmap(power, randomness="same")(x[None])[0], power(x))
        program = torch.export.export(power, (x,), strict=False).module()
        for _ in range(2):
            torch.testing.assert_close(program(x), power(x))

    def test_tensors_without_numbers_have_the_shape(self, source: Source) -> None:
        draws = Draws(3, trials=range(2), source=source)
        assert draws.normal("n", (128,), torch.complex64, "meta").is_meta
        with FakeTensorMode():
            assert draws.normal("n", (128,), torch.complex64).shape == (2, 128)


def test_an_unknown_source_is_refused() -> None:
    with pytest.raises(ValueError, match="source of Draws must be one of 'numpy', 'torch', got 'philox'"):
        Draws(7, source="philox")  # type: ignore[arg-type]


def test_numbers_of_numpy_are_those_of_recorded_sweeps() -> None:
    draws = Draws(7, trials=range(2))
    assert draws.normal("n", (1,), torch.complex128)[:, 0].tolist() == [
        -0.19662770368083424 - 0.7862203375466035j,
        0.17180901233063475 + 0.5208240394175109j,
    ]
    assert draws.uniform("u").tolist() == [0.9075354533484568, 0.15615308673503747]
    assert draws.permutation("p", [6, 3]).tolist() == [[4, 3, 2, 1, 5, 0], [0, 2, 1, 3, 4, 5]]


def test_precisions_of_numpy_draw_the_same_noise() -> None:
    double = Draws(7).normal("noise", (99,), torch.complex128)
    assert torch.equal(double.to(torch.complex64), Draws(7).normal("noise", (99,), torch.complex64))


def test_torch_draws_on_a_device_without_copies() -> None:
    draws = Draws(3, trials=range(4), source="torch")
    for draw in (
        lambda device: draws.normal("n", (5, 7), torch.complex64, device),
        lambda device: draws.normal("n", (), torch.float32, device),
        lambda device: draws.uniform("u", (9,), -1.0, 3.0, torch.float32, device),
        lambda device: draws.subset("p", 50, 20, device),
        lambda device: draws.permutation("p", [50, 0, 7, 3], device),
    ):
        expected = draw(None)
        with pretended_device() as counts:
            found = draw(DEVICE)
        assert torch.equal(to_host(found), expected) and isinstance(found, Pretended)
        assert not counts.uploads.total() and not counts.waits.total()
