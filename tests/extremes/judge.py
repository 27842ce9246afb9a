"""What a call of the table may do: a right result, or one sentence of the package."""

from __future__ import annotations

import ast
import random
import traceback
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchsar
from tests.table.functions import Entry, dims, named, samples

PACKAGE = str(Path(torchsar.__file__).parent)
Results = dict[str, Tensor]


@lru_cache(None)
def _raising_lines(path: str) -> frozenset[int]:
    nodes = ast.walk(ast.parse(Path(path).read_text(encoding="utf-8")))
    return frozenset(
        line for n in nodes if isinstance(n, ast.Raise) for line in range(n.lineno, (n.end_lineno or n.lineno) + 1)
    )


def is_sentence(error: Exception) -> bool:
    """Whether a `raise` statement of the package has raised a ValueError or TypeError."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return (
        isinstance(error, ValueError | TypeError)
        and last.filename.startswith(PACKAGE)
        and last.lineno in _raising_lines(last.filename)
    )


def outcome(call: Callable[[], Any]) -> Results | str:
    """Results by name, or the sentence; any other error is raised."""
    try:
        return named(call())
    except Exception as error:
        if is_sentence(error):
            return str(error)
        raise AssertionError(f"raw {type(error).__name__}: {error}") from error


def nan_in(results: Results) -> list[str]:
    """Names of the results that hold a NaN."""
    plain = {name: value.resolve_conj().resolve_neg() for name, value in results.items()}
    return [n for n, x in plain.items() if torch.isnan(torch.view_as_real(x) if x.is_complex() else x).any()]


def differences(found: Results, wanted: Results, entry: Entry, level: float = 1.0, tolerance: float = 2e-3) -> str:
    """In what results differ from others of samples `level` times as large; empty if they agree.

    Values of a trial that is not ok are compared by `ok` only.
    """
    judged = "ok" in wanted and wanted["ok"].ndim == 0
    for name, b in wanted.items():
        a = found[name]
        if a.shape != b.shape or a.dtype != b.dtype:
            return f"{name}: {a.dtype} {tuple(a.shape)} instead of {b.dtype} {tuple(b.shape)}"
        degree = entry.degree.get(name, 1 if name == "data" else 0)
        if degree is None or not b.numel():
            continue
        if not (b.is_floating_point() or b.is_complex()):
            if not torch.equal(a, b):
                return f"{name}: {a.tolist()} instead of {b.tolist()}"
            continue
        if judged and not bool(wanted["ok"]):
            continue
        wide = torch.complex128 if b.is_complex() else torch.float64
        a, b = a.to(wide) / level**degree, b.to(wide)
        gap = a - b
        if name.startswith("phase_rad"):  # whole turns are the same phase
            gap = torch.remainder(gap + torch.pi, 2 * torch.pi) - torch.pi
        error = torch.where((a == b) | (a.isnan() & b.isnan()), 0, gap.abs())
        size = torch.where(torch.isfinite(b.abs()), b.abs(), 0).max()
        least = 1.0 if name.startswith("phase_rad") else max(entry.least, 1e-300)
        if not bool(error.max() <= tolerance * size.clamp_min(least)):
            return f"{name}: off by {float(error.max()):.3g} of {float(size):.3g}"
    return ""


def trial(results: Results, i: int, trials: int) -> Results:
    """Results of one trial of a batch."""
    return {name: value[i] for name, value in results.items() if value.shape[:1] == (trials,)}


# views of the same samples: lazily conjugated, lazily negated, strided in the last dimension
VIEWS: dict[str, Callable[[Tensor], Tensor]] = {
    "plain": lambda x: x,
    "conj": lambda x: x.conj().resolve_conj().conj(),
    "neg": lambda x: torch._neg_view(-x),
    "strided": lambda x: x.repeat_interleave(2, -1)[..., ::2],
    "transposed": lambda x: x.movedim(-1, 0).contiguous().movedim(0, -1),
}
SIZES = (0, 1, 2, 3, 5, 7, 13, 31)
DTYPES = (torch.complex32, torch.float16, torch.bfloat16, torch.float32, torch.float64, torch.int16, torch.bool)


def _cut(x: Tensor, n_dims: int, lot: random.Random) -> tuple[Tensor, str]:
    """The samples, often cut along one or more dimensions."""
    note = []
    for dim in range(-n_dims, 0):
        if lot.random() < 0.15:
            n = lot.choice(SIZES)
            x = x.narrow(dim, 0, min(n, x.shape[dim]))
            note.append(f"{n} along {dim}")
    return x, ", ".join(note) or "whole"


def uses_nan(entry: Entry, batch: Tensor, i: int, mine: dict[str, Tensor]) -> bool:
    """Whether another value in place of the NaN of trial i changes its result; in a line that is
    missing it does not.
    """
    level = 1e3 * batch[i].abs().nan_to_num().max()
    other = torch.where(batch[i].isnan(), level, batch[i])
    found = outcome(lambda: entry.call(torch.cat([batch[:i], other[None], batch[i + 1 :]])))
    return isinstance(found, str) or any(not torch.equal(trial(found, i, len(batch))[k], v) for k, v in mine.items())


def random_case(entries: list[Entry], seed: int) -> str:
    """Run the random case of a seed.

    It draws an entry, a precision, sizes, trials (good, of zeros, of NaN, few with 120 dB of
    dynamic range) with noise of -60 to 100 dB SNR and levels of 2**-100 to 2**100, and a view of
    them. A batch must give what the single trials give at level one.

    Returns:
        What is wrong, with the case; empty if nothing is.
    """
    lot, source = random.Random(seed), torch.Generator().manual_seed(seed)
    entry = lot.choice(entries)
    dtype = lot.choice([torch.complex64, torch.complex64, torch.complex128])
    x, size = _cut(
        samples(entry.kind, 3, dtype) if not entry.kind.startswith("one ") else samples(entry.kind, 1, dtype)[None],
        dims(entry.kind),
        lot,
    )
    noise = torch.randn(x.shape, dtype=dtype, generator=source)
    snr_db = lot.uniform(-60, 100)
    x = x + 10 ** (-snr_db / 20) * noise
    if lot.random() < 0.2 and x.numel():
        x = x.clone()
        x.view(-1)[lot.randrange(x.numel())] *= 1e6
    kinds = [lot.choices(["good", "zero", "nan"], [8, 2, 1])[0] for _ in x]
    exponents = [lot.randrange(-100, 101) for _ in x]
    if x.numel():
        x = x / x.abs().flatten(1).amax(1).clamp_min(1e-6).reshape(-1, *[1] * (x.ndim - 1))
    levels = torch.tensor([2.0**e for e in exponents], dtype=torch.float64).to(x.real.dtype)
    batch = x * levels.reshape(-1, *[1] * (x.ndim - 1))
    for i, kind in enumerate(kinds):
        if kind == "zero":
            batch[i] = 0
        if kind == "nan" and batch[i].numel():
            batch[i].view(-1)[lot.randrange(batch[i].numel())] = float("nan")
    view = lot.choice(list(VIEWS))
    one = entry.kind.startswith("one ")
    if lot.random() < 0.08:
        other = lot.choice(DTYPES)
        batch = batch.to(other) if other.is_complex else batch.real.to(other)
    elif batch.numel() or view != "strided":
        batch = VIEWS[view](batch)
    case = f"seed {seed}: {entry.name}, {batch.dtype}, {size}, {view}, {snr_db:.0f} dB, {kinds}, 2**{exponents}"
    try:
        found = outcome(lambda: entry.call(batch[0] if one else batch))
        if isinstance(found, str):
            return "" if len(found) > 20 else f"{case}: short sentence {found!r}"
        if not batch.is_complex() or batch.dtype == torch.complex32 or entry.joint or one:
            return ""
        for i, kind in enumerate(kinds):
            mine = trial(found, i, len(kinds))
            if kind == "nan":
                hidden = batch[i].numel() and mine and not nan_in(mine)
                if hidden and not ("ok" in mine and not bool(mine["ok"].any())) and uses_nan(entry, batch, i, mine):
                    return f"{case}: trial {i} does not show its NaN"
                continue
            if nan_in(mine) and not entry.nan_ok:
                return f"{case}: trial {i} has NaN in {nan_in(mine)}"
            if kind == "zero":
                if not entry.zero_ok and "ok" in mine and bool(mine["ok"].any()):
                    return f"{case}: trial {i} of zeros is ok"
                continue
            alone = outcome(lambda i=i: entry.call(x[i]))
            if isinstance(alone, str):
                return f"{case}: trial {i} alone is refused: {alone}"
            wrong = differences(mine, {k: v for k, v in alone.items() if k in mine}, entry, 2.0 ** exponents[i])
            if wrong:
                return f"{case}: trial {i}: {wrong}"
    except AssertionError as error:
        return f"{case}: {error}"
    return ""
