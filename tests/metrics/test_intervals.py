"""Statistics of trials against closed forms, an exact oracle and simulation."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.stats import binomtest

from torchsar.metrics.intervals import half_width_ratio, share_interval, trial_statistics

NAN, INF = np.nan, np.inf
FIELDS = ("n", "mean", "median", "rmse", "std", "mean_interval", "median_interval", "rmse_interval")


@pytest.fixture
def errors() -> np.ndarray:
    """(2, 3, 700) with gaps: more than one block of trials, rows of several lengths."""
    values = np.random.default_rng(1).standard_normal((2, 3, 700)) + 0.3
    values[0, 1, 400:] = NAN
    values[1, 0, ::7] = INF
    return values


def test_figures_are_those_of_the_finite_trials(errors: np.ndarray) -> None:
    found = trial_statistics(errors, seed=1)
    assert set(found) == set(FIELDS)
    for index in np.ndindex(2, 3):
        x = errors[index][np.isfinite(errors[index])]
        expected = {
            "n": len(x),
            "mean": x.mean(),
            "median": np.median(x),
            "rmse": np.sqrt((x**2).mean()),
            "std": x.std(ddof=1),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(found[name][index], value, rtol=1e-12)
        for name in ("mean", "median", "rmse"):
            low, high = found[f"{name}_interval"][index]
            assert low < found[name][index] < high


def test_a_point_does_not_depend_on_its_neighbours(errors: np.ndarray) -> None:
    together, other = (trial_statistics(errors, seed) for seed in (1, 2))
    alone = [[trial_statistics(errors[i, j], seed=1) for j in range(3)] for i in range(2)]
    for name in FIELDS:
        values = np.stack([[found[name] for found in row] for row in alone])
        np.testing.assert_allclose(together[name], values, rtol=1e-12, err_msg=name)
        assert not name.endswith("e_interval") or np.abs(together[name] - other[name]).max() > 0


def test_order_of_magnitude_and_sign_follow() -> None:
    x = np.random.default_rng(2).standard_normal(50)
    plain, scaled = trial_statistics(x, 0), trial_statistics(-1e200 * x, 0)
    np.testing.assert_allclose(scaled["rmse_interval"], 1e200 * plain["rmse_interval"], rtol=1e-12)
    np.testing.assert_allclose(scaled["mean_interval"], -1e200 * plain["mean_interval"][::-1], rtol=1e-12)
    np.testing.assert_allclose(scaled["std"], 1e200 * plain["std"], rtol=1e-12)


@pytest.mark.parametrize("values, n", [([NAN, NAN], 0), ([INF, 2.0, NAN], 1)])
def test_fewer_than_two_trials_have_no_interval(values: list[float], n: int) -> None:
    found = trial_statistics(np.array(values), seed=0)
    assert found["n"] == n and np.isnan(found["std"])
    assert np.isnan([found[f"{name}_interval"] for name in ("mean", "median", "rmse")]).all()
    assert np.isnan(found["rmse"]) == (n == 0)


@pytest.mark.parametrize("n, ranks", [(5, None), (6, (1, 6)), (8, (1, 8)), (9, (2, 8)), (100, (40, 61))])
def test_median_interval_uses_the_tabulated_ranks(n: int, ranks: tuple[int, int] | None) -> None:
    interval = trial_statistics(np.arange(1.0, n + 1), seed=0)["median_interval"]
    np.testing.assert_array_equal(interval, (NAN, NAN) if ranks is None else ranks)


@pytest.mark.parametrize("n", [50, 200])
def test_intervals_of_gaussian_errors_cover_what_they_promise(n: int) -> None:
    found = trial_statistics(np.random.default_rng(n).standard_normal((2000, n)), seed=5)
    for name, true in (("rmse", 1.0), ("mean", 0.0), ("median", 0.0)):
        low, high = found[f"{name}_interval"].T
        covered = ((low <= true) & (true <= high)).mean()
        assert 0.90 < covered < (0.98 if name == "median" else 0.97), (name, covered)


def test_a_row_with_gaps_covers_as_its_finite_part_does() -> None:
    values = np.full((1000, 600), NAN)
    values[:, :150] = np.random.default_rng(6).standard_normal((1000, 150))
    low, high = trial_statistics(values, seed=5)["rmse_interval"].T
    assert 0.90 < ((low <= 1) & (high >= 1)).mean() < 0.97


def test_memory_stays_bounded_for_many_trials() -> None:
    # all resamples at once would take 400 MB
    values = np.random.default_rng(7).standard_normal((4, 50_000))
    tracemalloc.start()
    low, high = trial_statistics(values, seed=0)["rmse_interval"].T
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64e6
    np.testing.assert_allclose((high - low) / 2, 1.96 / np.sqrt(2 * 50_000), rtol=0.15)


@pytest.mark.parametrize(
    "k, n", [(0, 1), (1, 1), (0, 12), (12, 12), (3, 10), (37, 200), (199, 200), (1, 20_000), (9_950, 20_000)]
)
@pytest.mark.parametrize("level", [0.68, 0.95])
def test_share_is_exact(k: int, n: int, level: float) -> None:
    value, interval = share_interval(np.arange(n) < k, np.ones(n, bool), level)
    exact = binomtest(k, n).proportion_ci(level, method="exact")
    assert value == k / n
    np.testing.assert_allclose(interval, (exact.low, exact.high), atol=1e-10)


def test_share_counts_only_what_it_is_of() -> None:
    hits = np.array([[True, True, False, True], [True, True, True, True]])
    of = np.array([[True, False, True, True], [False, False, False, False]])
    value, interval = share_interval(hits, of)
    assert value[0] == 2 / 3 and np.isnan(value[1]) and np.isnan(interval[1]).all()
    np.testing.assert_array_equal(interval[0], share_interval(np.array([True, True, False]), np.ones(3, bool))[1])


def test_half_width_shrinks_with_trials() -> None:
    x = np.random.default_rng(3).standard_normal(6400) + 1.0
    for name in ("rmse", "mean", "median"):
        few, many = (half_width_ratio(x[:n], name, seed=0) for n in (100, 6400))
        assert 4 < few / many < 16
    assert half_width_ratio(np.full(10, 3.0), "rmse", 0) == 0 and np.isnan(
        half_width_ratio(np.array([1.0, NAN]), "rmse", 0)
    )
    with pytest.raises(ValueError, match="must be 'rmse', 'mean' or 'median'"):
        half_width_ratio(x, "mode", seed=0)
