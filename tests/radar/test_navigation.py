"""Positions at pulse times from navigation records: accuracy, batches, gradients and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from torchsar.radar import resample_path

F64 = torch.float64


def record(seed: int = 0, n: int = 300, rate_hz: float = 50.0, noise_m: float = 0.0) -> tuple[Tensor, Tensor]:
    """Uneven times and positions of an aircraft that sways while it turns."""
    made = np.random.default_rng(seed)
    time = torch.tensor((np.arange(n) + made.uniform(-0.4, 0.4, n)) / rate_hz)
    return time, place(time) + noise_m * torch.tensor(made.standard_normal((n, 3)))


def place(t: Tensor) -> Tensor:
    sway = 2 * torch.sin(math.pi * t)
    return torch.stack([7000 * torch.cos(0.01 * t), 7000 * torch.sin(0.01 * t) + sway, 3000 + 0.3 * sway], -1)


PULSES = torch.linspace(0.1, 5.8, 500, dtype=F64)


def test_uneven_records_give_the_true_path_at_the_pulses() -> None:
    time, position = record()
    found = resample_path(time, position, PULSES)
    assert float((found - place(PULSES)).abs().max()) < 2e-6
    torch.testing.assert_close(found, torch.tensor(CubicSpline(time, position)(PULSES)), rtol=0, atol=1e-10)


def test_trials_have_records_and_pulses_of_their_own() -> None:
    time, position = map(torch.stack, zip(*(record(seed, noise_m=0.01) for seed in range(3)), strict=True))
    pulses = PULSES + torch.linspace(-0.01, 0.01, 3, dtype=F64)[:, None]
    singles = [resample_path(*each) for each in zip(time, position, pulses, strict=True)]
    torch.testing.assert_close(resample_path(time, position, pulses), torch.stack(singles), rtol=1e-13, atol=0)
    shared = resample_path(time[0], position, PULSES)
    torch.testing.assert_close(shared[2], resample_path(time[0], position[2], PULSES), rtol=1e-13, atol=0)


def test_gradients() -> None:
    time, position = record(1, n=8, rate_hz=1.0)
    pulses = torch.tensor([1.3, 2.0, 5.6], dtype=F64)
    given = tuple(x.requires_grad_() for x in (time, position, pulses))
    assert torch.autograd.gradcheck(lambda *x: resample_path(*x, jump_m=math.inf), given, eps=1e-5, rtol=1e-4)


@pytest.mark.parametrize("rate_hz, n, noise_m", [(1.0, 60, 0.5), (10.0, 100, 0.03), (200.0, 2000, 0.01)])
def test_noise_quantisation_and_clean_records_are_accepted(rate_hz: float, n: int, noise_m: float) -> None:
    for seed in range(20):
        time, position = record(seed, n, rate_hz, noise_m)
        pulses = time[:-1] + 0.3 / rate_hz * 0.01
        for accepted in (position, torch.round(position * 20) / 20, place(time), torch.round(20 * time[:, None]) / 20):
            resample_path(time, accepted.expand(-1, 3), pulses)


def test_random_times_and_lost_records_are_no_gaps() -> None:
    for seed in range(20):
        made = np.random.default_rng(seed)
        random = torch.tensor(np.sort(made.uniform(0, 50, 1000)))
        resample_path(random, place(random), random[:-1])
        kept = torch.arange(1000, dtype=F64)[torch.tensor(made.random(1000) > 0.3)] / 50
        resample_path(kept, place(kept), kept[:-1])


def spoilt(what: str) -> tuple[Tensor, Tensor]:
    time, position = record(noise_m=0.005)
    keep = torch.ones(len(time), dtype=torch.bool)
    if what == "gap":
        keep[100:130] = False
    elif what == "order":
        time = time.clone()
        time[[100, 101]] = time[[101, 100]]
    elif what == "doubled":
        time[101] = time[100]
    elif what == "jump":
        position[150:] += torch.tensor([0.0, 1.0, 0.0])
    elif what == "outlier":
        position[150, 2] += 0.5
    elif what == "first":
        position[0, 2] -= 3.0
    elif what == "nan":
        position[7, 1] = math.nan
    return time[keep], position[keep]


REFUSED = {
    "gap": r"gap of 0.6\d+ s after (1.9|2.0)\d+ s, longer than 0.\d+ s",
    "order": r"but \S+ s follows \S+ s at record 101; sort",
    "doubled": r"but \S+ s stands twice, at record 101; remove",
    "jump": r"jump of about \S+ m near (2.9|3)\S* s, where up to \S+ m are accepted",
    "outlier": "jump of about .* near",
    "first": "jump of about",
    "nan": "position_m: 1 of 900 values are NaN or Inf",
}


@pytest.mark.parametrize("what", REFUSED)
def test_faults_are_refused_with_their_figure(what: str) -> None:
    time, position = spoilt(what)
    pulses = PULSES - 0.08
    with pytest.raises(ValueError, match=REFUSED[what]):
        resample_path(time, position, pulses)
    good = record(noise_m=0.005)
    if len(time) == len(good[0]) and what != "nan":
        with pytest.raises(ValueError, match="trial 1"):
            resample_path(torch.stack([good[0], time]), torch.stack([good[1], position]), pulses)


def test_faults_beyond_the_pulses_do_not_matter() -> None:
    early = torch.linspace(0.1, 1.7, 50, dtype=F64)
    for what in ("gap", "jump", "outlier"):
        resample_path(*spoilt(what), early)
    late = torch.linspace(0.5, 5.0, 50, dtype=F64)
    resample_path(*spoilt("first"), late)


def test_jumps_of_every_size_above_the_limit_are_found() -> None:
    for seed in range(30):
        time, position = record(seed, noise_m=0.005)
        position[20 + 8 * seed :, seed % 3] += 0.5
        with pytest.raises(ValueError, match="jump of about"):
            resample_path(time, position, PULSES)


def test_pulses_beyond_the_record_and_bad_shapes_are_refused() -> None:
    time, position = record()
    with pytest.raises(ValueError, match=r"one is 0.\d+ s after the last record at 5.9\d+ s"):
        resample_path(time, position, PULSES + 0.5)
    with pytest.raises(ValueError, match="before the first record"):
        resample_path(time, position, PULSES - 0.5)
    with pytest.raises(ValueError, match=r"at least five records.*got \(4,\), \(4, 3\), \(500,\)"):
        resample_path(time[:4], position[:4], PULSES)
    with pytest.raises(ValueError, match=r"got \(300,\), \(299, 3\)"):
        resample_path(time, position[1:], PULSES)
    with pytest.raises(ValueError, match="must be positive"):
        resample_path(time, position, PULSES, jump_m=0.0)
    with pytest.raises(TypeError, match="time_s must be a float64 tensor"):
        resample_path(time.float(), position, PULSES)
