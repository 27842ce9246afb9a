"""Line integrity: verified numbers, a regular grid, and complete counts."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.helpers import small_radar
from torchsar.core import Draws, Estimate, Outcome, Recording, Signal
from torchsar.echo import CorruptedNumbers, LostGaps, LostLines, RepeatedLines, apply_impairments
from torchsar.repair import LineIntegrity, line_integrity

N = 600


def lines(trials: int | None = 2, n: int = N) -> Tensor:
    shape = (n, 3) if trials is None else (trials, n, 3)
    return torch.randn(shape, dtype=torch.complex64, generator=torch.Generator().manual_seed(0))


def impaired(seed: int, trials: int = 2, **impairments) -> tuple[Recording, Recording, dict]:
    clean = Recording(Signal(lines(trials), small_radar().raw_axes(N, 3)), small_radar())
    out, truth = apply_impairments(clean, impairments, Draws(seed, trials=range(trials)))
    return clean, out, truth


def check_counts(estimate: Estimate) -> None:
    info = estimate.info
    assert torch.equal(info["received"], info["placed"] + info["repeated_count"] + info["unplaced_count"])


@pytest.mark.parametrize("trials", [None, 2])
@pytest.mark.parametrize("first", [0, 1, 71000])
def test_regular_input_is_unchanged_bit_for_bit(trials: int | None, first: int) -> None:
    x = lines(trials)
    signal = Signal(x, small_radar().raw_axes(N, 3))
    out, estimate = LineIntegrity()(signal, torch.arange(first, first + N))
    assert torch.equal(torch.view_as_real(out.data), torch.view_as_real(x)) and out.axes == signal.axes
    assert not estimate["missing"].any() and estimate.ok.all() and (estimate.quality == 1).all()
    check_counts(estimate)


def test_shorter_trials_keep_their_padding() -> None:
    x, number = lines(2), torch.arange(N).repeat(2, 1)
    number[1, 500:], x[1, 500:] = -1, 0
    out, estimate = LineIntegrity()(Signal(x, small_radar().raw_axes(N, 3)), number)
    assert torch.equal(out.data, x) and not estimate["missing"].any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "loss", [LostLines(count=6), LostLines(fraction=0.05), LostLines(fraction=0.2), LostGaps(5, 8), LostGaps(2, 60)]
)
def test_every_line_returns_to_its_position(seed: int, loss) -> None:
    clean, out, truth = impaired(seed, loss=loss)
    repaired, estimate = LineIntegrity()(out.signal, out.aux["line_number"])
    lost = truth["loss.lost"]
    # losses after the last received line cannot be detected
    behind = (~lost).flip(-1).cumsum(-1).flip(-1) == 0
    assert torch.equal(estimate["missing"], lost & ~behind)
    assert torch.equal(repaired.data, torch.where(lost[..., None], 0, clean.signal.data))
    check_counts(estimate)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.0, 0.01, 0.05])
def test_corrupted_and_repeated_numbers(seed: int, share: float) -> None:
    _, out, truth = impaired(seed, loss=LostLines(fraction=share), again=RepeatedLines(5), wrong=CorruptedNumbers(12))
    _, estimate = LineIntegrity()(out.signal, out.aux["line_number"])
    placed = estimate.info["number"] != -1
    assert torch.equal(estimate.info["number"][placed], truth["wrong.true_number"][placed])
    assert (estimate.info["repeated_count"] >= 4).all()  # one may have fallen off the end
    assert (
        estimate.info["corrected_count"] + estimate.info["unplaced_count"] + estimate.info["repeated_count"] >= 12
    ).all()
    assert (estimate.info["unplaced_count"] <= 3).all() and estimate.ok.all()
    check_counts(estimate)


def test_first_and_last_number_may_be_corrupted() -> None:
    x, number = lines(3), torch.arange(100, 100 + N).repeat(3, 1)
    number[0, 0], number[1, 0], number[1, 1], number[2, -1] = 37, 5000, 12, 900
    out, estimate = LineIntegrity()(Signal(x, small_radar().raw_axes(N, 3)), number)
    assert torch.equal(out.data, x) and estimate.info["corrected_count"].tolist() == [1, 2, 1]
    assert (estimate.info["first_number"] == 100).all()


def test_a_stuck_counter_and_a_cluster_are_corrected() -> None:
    x, number = lines(2), torch.arange(N).repeat(2, 1)
    number[0, 200:206] = 200
    number[1, 300:304] = torch.tensor([9, 40000, 301, 7])
    out, estimate = LineIntegrity()(Signal(x, small_radar().raw_axes(N, 3)), number)
    assert torch.equal(out.data, x) and not estimate["missing"].any()
    assert estimate.info["corrected_count"][0] == 5


def test_a_line_with_two_possible_positions_is_left_out_and_counted() -> None:
    number = torch.cat([torch.arange(300), torch.tensor([77]), torch.arange(303, 303 + N - 301)])
    x = lines(None)
    plan = line_integrity(x, number)
    assert plan.info["unplaced"].nonzero().tolist() == [[300]]
    assert plan["missing"].nonzero()[:, 0].tolist() == [300, 301, 302]
    assert len(plan.info["source"]) == N + 2  # the grid grew: no line behind the gap is cut off


def test_grid_can_be_given() -> None:
    x = lines(None)
    plan = line_integrity(x[10:], torch.arange(10, N), first_number=0, n_lines=N)
    assert plan["missing"].nonzero()[:, 0].tolist() == list(range(10))
    assert torch.equal(plan.info["source"][10:], torch.arange(N - 10))


def test_lines_of_zeros_are_missing_except_at_the_ends() -> None:
    x = lines(None)
    x[:5], x[100], x[-7:] = 0, 0, 0
    _, estimate = LineIntegrity()(Signal(x, small_radar().raw_axes(N, 3)), torch.arange(N))
    assert estimate["missing"].nonzero()[:, 0].tolist() == [100]


def test_one_inconsistent_trial_does_not_change_others() -> None:
    x, number = lines(2), torch.arange(N).repeat(2, 1)
    number[1] = torch.randperm(N, generator=torch.Generator().manual_seed(1))
    out, estimate = LineIntegrity()(Signal(x, small_radar().raw_axes(N, 3)), number)
    assert estimate.outcome.tolist() == [Outcome.OK, Outcome.SINGULAR]
    assert torch.equal(out.data, x) and not estimate["missing"].any()
    check_counts(estimate)


def test_a_grid_with_a_first_number_keeps_the_lines_of_an_inconsistent_trial() -> None:
    """Its numbers are not known, so that they say nothing about the grid."""
    x, number = lines(2), 500 + torch.arange(N).repeat(2, 1)
    number[1] = torch.randperm(N, generator=torch.Generator().manual_seed(1))
    out, estimate = LineIntegrity(500, N + 4)(Signal(x, small_radar().raw_axes(N, 3)), number)
    assert estimate.ok.tolist() == [True, False] and torch.equal(out.data[:, :N], x)
    with pytest.raises(ValueError, match=rf"numbers, 500 to {499 + N}, lies on the grid of {N} rows"):
        LineIntegrity(5000, N)(Signal(x[:1], small_radar().raw_axes(N, 3)), number[:1])


@pytest.mark.parametrize(
    "number, message",
    [
        (torch.randperm(N, generator=torch.Generator().manual_seed(1)), "cannot be reconciled"),
        (torch.arange(N).flip(0), "cannot be reconciled"),
        (torch.arange(N - 1), "one number for each of the 600 lines"),
        (torch.arange(N) + 0.5, "must hold integers"),
    ],
)
def test_inconsistent_or_invalid_numbers_raise(number: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LineIntegrity()(Signal(lines(None), small_radar().raw_axes(N, 3)), number)


def test_lines_beyond_the_last_accepted_number_are_not_placed_where_lines_are_lost() -> None:
    generator = torch.Generator().manual_seed(4)
    kept = torch.rand(50, 300, generator=generator) > 0.1
    true = torch.stack([row.nonzero()[:200, 0] for row in kept])
    wrong = torch.rand(true.shape, generator=generator) < 0.2
    seen = torch.where(wrong, torch.randint(0, 5000, true.shape, generator=generator), true)
    plan = line_integrity(torch.randn(50, 200, 2, dtype=torch.complex64, generator=generator), seen)
    found = plan.info["number"]
    misplaced = (found >= 0) & (found != true)
    assert bool(plan.ok.all()) and float(misplaced.sum(-1).max()) <= 2
    assert float((found >= 0).double().mean()) > 0.9
