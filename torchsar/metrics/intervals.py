"""Statistics of trials, each with its confidence interval.

Arrays have the shape (..., trial); missing trials are NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from torchsar.core.draws import generator_at

# the usual level of intervals in reports
LEVEL = 0.95
# the ends of 95 % intervals are then the 25th values from either end
RESAMPLES = 1000
_BLOCK = 2**20  # float64 numbers in one working array: 8 MB
_ROWS = 256  # points whose resampled sums are held at a time: 6 MB
_COLUMNS = 512  # trials whose resampling weights are held at a time: 4 MB


def trial_statistics(values: np.ndarray, seed: int, level: float = LEVEL) -> dict[str, np.ndarray]:
    """Count, mean, median, root mean square and standard deviation, with intervals.

    Values that are not finite are left out. Intervals of mean and rmse are percentiles of a
    bootstrap, which is too narrow for few trials: of Gaussian errors, at 95 %, it contains the
    rmse in 81 % of cases for n = 10, 92 % for 50, 95 % for 200. It cannot include rare outliers
    that do not occur in few trials: it contains the rmse of log-normal errors in 69 % (n = 50) and
    80 % (200), with one error in a hundred 100 times as large in 28 % and 62 %, while the median
    keeps 95 % or more and the mean 89 % or more. The bootstrap draws from (seed, number of trials)
    alone: the interval of a point is the same, to rounding, whatever other points there are.

    Args:
        values: Shape (..., trial), float64.
        seed: Of the bootstrap.
        level: Probability of the intervals.

    Returns:
        `n`, `mean`, `median`, `rmse` (about zero), `std` (with n - 1), shape (...,), and
        `mean_interval`, `median_interval`, `rmse_interval`, shape (..., 2). The interval of the
        median lies between two order statistics and contains the median of any distribution with
        at least the given probability; it is NaN for fewer than log2(2 / (1 - level)) trials (six
        at 95 %), the others are for fewer than two.

    Raises:
        ValueError: If there is no trial.
    """
    rows = _rows(values)
    found = _moments(rows, level)
    found["mean_interval"], found["rmse_interval"] = _bootstrap(rows, found["n"], seed, level)
    return {name: x.reshape(values.shape[:-1] + x.shape[1:]) for name, x in found.items()}


def half_width_ratio(values: np.ndarray, statistic: str, seed: int, level: float = LEVEL) -> np.ndarray:
    """Half the width of a statistic's interval over its magnitude.

    It bounds how much further trials may still change the statistic.

    Args:
        values: Shape (..., trial).
        statistic: "rmse", "mean" or "median".
        seed: Of the bootstrap.
        level: Probability of the interval.

    Returns:
        Shape (...,); NaN where there is no interval, 0 where all trials agree, infinite about zero.

    Raises:
        ValueError: If the statistic is another one.
    """
    if statistic not in ("rmse", "mean", "median"):
        raise ValueError(f"no interval is known for the statistic {statistic!r}; choose rmse, mean or median")
    found = trial_statistics(values, seed, level)
    half = np.diff(found[f"{statistic}_interval"], axis=-1)[..., 0] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(half == 0, 0.0, half / np.abs(found[statistic]))


def share_interval(hits: np.ndarray, of: np.ndarray, level: float = LEVEL) -> tuple[np.ndarray, np.ndarray]:
    """Share of hits among some trials, and its exact interval.

    The interval is conservative: it contains the share with at least the given probability.

    Args:
        hits: Shape (..., trial), bool.
        of: The trials that count, of a shape that broadcasts with `hits`, bool.
        level: Probability of the interval.

    Returns:
        The share, shape (...,), and its interval, shape (..., 2); NaN where no trial counts.

    Reference:
        C. J. Clopper and E. S. Pearson, Biometrika 26 (1934), 404-413.
    """
    hits, of = np.broadcast_arrays(hits, of)
    k, n = (hits & of).sum(-1), of.sum(-1)
    pairs, index = np.unique(np.stack([k, n], -1).reshape(-1, 2), axis=0, return_inverse=True)
    lower = _binomial_limit(pairs[:, 0], pairs[:, 1], (1 - level) / 2)
    upper = 1 - _binomial_limit(pairs[:, 1] - pairs[:, 0], pairs[:, 1], (1 - level) / 2)
    interval = np.stack([lower, upper], -1)[index.reshape(-1)].reshape(*n.shape, 2)
    none = n == 0
    return np.where(none, np.nan, k / np.maximum(n, 1)), np.where(none[..., None], np.nan, interval)


def finite_rms(values: np.ndarray) -> np.ndarray:
    """Root mean square of the finite values over the last dim; NaN where there is none.

    Args:
        values: Shape (..., trial).

    Returns:
        Shape (...,).
    """
    here = np.isfinite(values)
    power = np.square(np.where(here, values, 0.0)).sum(-1)
    return np.sqrt(power / np.where(here.any(-1), here.sum(-1), np.nan))


def _rows(values: np.ndarray) -> np.ndarray:
    if values.ndim < 1 or values.shape[-1] < 1:
        raise ValueError(f"statistics need at least one trial in the last dim, got the shape {values.shape}")
    return np.asarray(values, dtype=np.float64).reshape(-1, values.shape[-1])


def _blocks(count: int, size: int) -> Iterator[slice]:
    """Slices of at most `size` (at least one) that cover `count`."""
    size = max(1, size)
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _moments(rows: np.ndarray, level: float) -> dict[str, np.ndarray]:
    """rows: (point, trial). Everything but the bootstrap, in blocks of rows."""
    table = _log_factorials(rows.shape[-1])
    parts = [_moments_of(rows[block], table, level) for block in _blocks(len(rows), _BLOCK // rows.shape[-1])]
    return (
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if parts
        else _moments_of(rows, table, level)
    )


def _moments_of(rows: np.ndarray, table: np.ndarray, level: float) -> dict[str, np.ndarray]:
    here = np.isfinite(rows)
    n = here.sum(-1)
    scale = _scale(rows)
    unit = np.where(here, rows, 0.0) / scale[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = unit.sum(-1) / n
        rmse = np.sqrt(np.square(unit).sum(-1) / n)
        centred = np.where(here, unit - mean[:, None], 0.0)
        std = np.sqrt(np.square(centred).sum(-1) / np.where(n > 1, n - 1, np.nan))
    median, interval = _median(np.sort(np.where(here, rows, np.nan), axis=-1), n, table, level)
    return {
        "n": n,
        "mean": mean * scale,
        "median": median,
        "rmse": rmse * scale,
        "std": std * scale,
        "median_interval": interval,
    }


def _scale(rows: np.ndarray) -> np.ndarray:
    """Largest finite magnitude of each row, so that no square overflows; 1 for rows of zeros.

    (point, trial) -> (point,).
    """
    peak = np.abs(rows).max(-1, where=np.isfinite(rows), initial=0.0)
    return np.where(peak > 0, peak, 1.0)


def _median(ordered: np.ndarray, n: np.ndarray, table: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Median (point,) and its interval (point, 2).

    ordered: (point, trial), ascending, NaN last; n: how many are not NaN.
    """
    rank = np.zeros_like(n)
    for count in np.unique(n):
        rank[n == count] = _median_rank(int(count), table, level)
    at = np.stack([(n - 1) // 2, n // 2, rank - 1, n - rank], -1).clip(0, ordered.shape[-1] - 1)
    low, high, lower, upper = np.take_along_axis(ordered, at, -1).T
    interval = np.stack([lower, upper], -1)
    return low / 2 + high / 2, np.where(rank[:, None] > 0, interval, np.nan)


def _median_rank(n: int, table: np.ndarray, level: float) -> int:
    """The largest r for which the r-th smallest and the r-th largest of n enclose the median with
    the given probability; 0: none.

    They miss it with the probability 2 P(Binomial(n, 1/2) < r). Terms further than 5 sqrt(n) below
    n / 2 sum to less than exp(-50).
    """
    first = max(0, math.floor(n / 2 - 5 * math.sqrt(n)))
    j = np.arange(first, n // 2)
    miss = 2 * np.exp(table[n] - table[j] - table[n - j] - n * math.log(2)).cumsum()
    inside = int((miss <= 1 - level).sum())
    return first + inside if inside else 0


def _bootstrap(rows: np.ndarray, n: np.ndarray, seed: int, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Percentile intervals of mean and rmse, (point, 2) each.

    rows: (point, trial); n: finite trials of each.
    """
    intervals = np.full((2, len(rows), 2), np.nan)
    enough = np.flatnonzero(n > 1)
    tails = [(1 - level) / 2, (1 + level) / 2]
    for block in _blocks(len(enough), _ROWS):
        chosen = enough[block]
        for interval, resampled in zip(intervals, _resampled(rows, chosen, seed), strict=True):
            interval[chosen] = np.nanquantile(resampled, tails, axis=0).T
    return intervals[0], intervals[1]


def _resampled(rows: np.ndarray, chosen: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and rmse of every resample, (resample, point) each, for the chosen rows: matrix products
    of weights and powers.

    A resample that holds none of a row's trials (there may be few among many that are missing) is
    NaN.
    """
    sums = np.zeros((3, RESAMPLES, len(chosen)))
    scale = np.concatenate([_scale(rows[chosen[block]]) for block in _blocks(len(chosen), _BLOCK // rows.shape[-1])])
    for trials, weights in _weights(seed, rows.shape[-1]):
        for total, power in zip(sums, _powers(rows[chosen, trials] / scale[:, None]), strict=True):
            total += weights @ power.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return sums[1] / sums[0] * scale, np.sqrt(sums[2] / sums[0]) * scale


def _weights(seed: int, trials: int) -> Iterator[tuple[slice, np.ndarray]]:
    """How often each resample holds each trial, (resample, some trials), for one slice of trials
    after another.

    Multinomial with equal chances, drawn in two steps so that all resamples of few trials are at
    hand together: first how many of a resample's draws fall into each slice, then where in it.
    Addressed by (seed, trials, slice) alone.
    """
    slices = list(_blocks(trials, _COLUMNS))
    counts = generator_at(seed, "bootstrap", trials, -1).multinomial(
        trials, [(s.stop - s.start) / trials for s in slices], RESAMPLES
    )
    for i, s in enumerate(slices):
        width = s.stop - s.start
        index = generator_at(seed, "bootstrap", trials, i).integers(0, width, counts[:, i].sum())
        index += np.repeat(np.arange(RESAMPLES) * width, counts[:, i])
        yield s, np.bincount(index, minlength=RESAMPLES * width).reshape(RESAMPLES, width).astype(np.float64)


def _powers(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zeroth, first and second power; zero where a trial is missing."""
    here = np.isfinite(rows)
    first = np.where(here, rows, 0.0)
    return here.astype(np.float64), first, np.square(first)


def _log_factorials(n: int) -> np.ndarray:
    """ln(0!) .. ln(n!)."""
    return np.array([math.lgamma(i + 1) for i in range(n + 1)])


def _binomial_limit(k: np.ndarray, n: np.ndarray, tail: float) -> np.ndarray:
    """The p at which P(Binomial(n, p) >= k) equals `tail`; 0 for k = 0. k, n: (pair,) int."""
    table = _log_factorials(int(n.max(initial=0)))
    reach = math.ceil(5 * math.sqrt(n.max(initial=0))) + 2
    parts = [_bisect(k[block], n[block], table, reach, tail) for block in _blocks(len(k), _BLOCK // reach)]
    return np.where(k > 0, np.concatenate(parts) if parts else np.zeros(0), 0.0)


def _bisect(k: np.ndarray, n: np.ndarray, table: np.ndarray, reach: int, tail: float) -> np.ndarray:
    """Bisection between 0 and k / n, where terms further than 5 sqrt(n) above k sum to less than
    exp(-50) (Hoeffding).
    """
    j = k[:, None] + np.arange(reach)
    inside = j <= n[:, None]
    j = np.minimum(j, n[:, None])
    choices = np.where(inside, table[n][:, None] - table[j] - table[n[:, None] - j], -np.inf)
    low, high = np.zeros(len(k)), np.where(k > 0, k, 1) / np.maximum(n, 1)
    for _ in range(60):
        p = (low + high) / 2
        above = np.exp(choices + j * np.log(p)[:, None] + (n[:, None] - j) * np.log1p(-p)[:, None]).sum(-1) > tail
        low, high = np.where(above, low, p), np.where(above, p, high)
    return (low + high) / 2
