"""Impairments of the sequence of lines: samples, numbers and truth."""

from __future__ import annotations

import pytest
import torch

from tests.helpers import small_radar
from torchsar.core import Draws, Recording, Signal
from torchsar.echo import CorruptedNumbers, LostGaps, LostLines, LostPulses, RepeatedLines, apply_impairments

N = 200


def recording(trials: int | None = 3) -> Recording:
    """Recording in which line i has i + 1 in every sample, and in its AGC."""
    shape = (N, 4) if trials is None else (trials, N, 4)
    lines = (torch.arange(N) + 1.0).to(torch.complex64)[:, None].expand(shape).contiguous()
    return Recording(
        Signal(lines, small_radar().raw_axes(N, 4)),
        small_radar(),
        {"agc": torch.arange(N) + 1.0, "pilot": torch.ones(N)},
    )


@pytest.mark.parametrize(
    "impairment, count", [(LostLines(count=7), 7), (LostLines(fraction=0.2), 40), (LostGaps(3, 8), 24)]
)
def test_lost_lines_close_up_and_the_end_is_padded(impairment, count: int) -> None:
    out, truth = apply_impairments(recording(), {"lost": impairment}, Draws(1, trials=range(3)))
    number, lost = out.aux["line_number"], truth["lost.lost"]
    assert (lost.sum(-1) == count).all() and not lost[:, 0].any()
    for trial in range(3):
        kept = (~lost[trial]).nonzero()[:, 0]
        assert torch.equal(number[trial, : N - count], kept)
        assert (number[trial, N - count :] == -1).all() and (out.signal.data[trial, N - count :] == 0).all()
        assert torch.equal(out.signal.data[trial, : N - count, 0].real, kept + 1.0)
        assert torch.equal(out.aux["agc"][trial, : N - count], kept + 1.0)
    assert torch.equal(out.aux["pilot"], torch.ones(N))
    assert torch.equal(truth["lost.lost_number"], lost.nonzero()[:, 1].reshape(3, -1))
    assert not torch.equal(lost[0], lost[1])


def test_gaps_have_their_length_and_stay_apart() -> None:
    for seed in range(5):
        _, truth = apply_impairments(recording(None), {"gap": LostGaps(5, 8)}, Draws(seed))
        edges = torch.diff(
            truth["gap.lost"].int(), prepend=torch.zeros(1, dtype=torch.int32), append=torch.zeros(1, dtype=torch.int32)
        )
        begins, ends = (edges == 1).nonzero()[:, 0], (edges == -1).nonzero()[:, 0]
        assert (ends - begins).tolist() == [8] * 5


def test_repeated_lines_come_twice() -> None:
    out, truth = apply_impairments(recording(), {"again": RepeatedLines(6)}, Draws(2, trials=range(3)))
    number = out.aux["line_number"]
    assert torch.equal(truth["again.repeated"][:, 1:], number[:, 1:] == number[:, :-1])
    assert ((number[:, 1:] - number[:, :-1]) >= 0).all()
    assert torch.equal(out.signal.data[..., 0].real, number + 1.0)


@pytest.mark.parametrize("bits", [None, 3])
def test_corrupted_numbers_leave_samples_alone(bits: int | None) -> None:
    source = recording()
    out, truth = apply_impairments(source, {"number": CorruptedNumbers(9, bits)}, Draws(3, trials=range(3)))
    wrong = out.aux["line_number"] != truth["number.true_number"]
    assert torch.equal(wrong, truth["number.corrupted"]) and (wrong.sum(-1) == 9).all()
    assert torch.equal(out.signal.data, source.signal.data)


def test_impairments_depend_on_their_address_only() -> None:
    together, _ = apply_impairments(recording(3), {"lost": LostLines(count=7)}, Draws(4, trials=range(3)))
    alone, _ = apply_impairments(recording(1), {"lost": LostLines(count=7)}, Draws(4, trials=[2]))
    assert torch.equal(together.aux["line_number"][2], alone.aux["line_number"][0])


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: LostLines(), "a count or a fraction"),
        (lambda: LostLines(fraction=1.5), "fraction of lost lines must be at least 0 and below 1"),
        (lambda: LostGaps(2, 0), "length >= 1"),
        (lambda: LostLines(count=N)(recording(None), Draws(0)), "leave nothing of a recording of 200 lines"),
        (lambda: LostGaps(30, 8)(recording(None), Draws(0)), "do not fit a recording of 200 lines"),
        (lambda: LostLines(count=3)(recording(None), Draws(0, trials=range(2))), "use draws without trials"),
        (lambda: LostLines(count=3)(recording(3), Draws(0, trials=[1])), r"shape \(3,\), got trials of shape \(1,\)"),
        (lambda: LostPulses(count=3)(recording(3), Draws(0, trials=[1])), r"shape \(3,\), got trials of shape \(1,\)"),
    ],
)
def test_invalid_parameters_are_refused(build, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()
