"""Positions of the antennas at the pulses."""

from __future__ import annotations

import torch

from torchsar.radar import AntennaPath

F64 = torch.float64


def test_the_path_of_a_trial_is_that_of_all_at_its_number() -> None:
    made = torch.Generator().manual_seed(1)
    place, other, reference = (
        torch.randn(*lead, *size, dtype=F64, generator=made)
        for lead, size in (((3,), (5, 3)), ((2, 1), (5, 3)), ((), (5,)))
    )
    points = torch.randn(4, 3, dtype=F64, generator=made)
    for receiver in (None, other):
        whole = AntennaPath(place, receiver, reference)
        trials = (2, 3) if receiver is not None else (3,)
        assert tuple(whole.trials) == trials
        index = (1, 2)[-len(trials) :]
        one = whole.of_trial(index)
        assert not one.trials
        torch.testing.assert_close(one.path_m(points), whole.path_m(points)[index])
        wider = whole.of_trial((6, *index), (7, *trials))
        torch.testing.assert_close(wider.path_m(points), one.path_m(points))
