"""Sweeps of any trial function: addresses, chunks, memory, resuming, early ends."""

from __future__ import annotations

import logging
import re
import resource
import time
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr

from tests.study import toy
from torchsar.core import Draws, Outcome
from torchsar.study.montecarlo import Record, Stop, differences, read_sweep, sweep
from torchsar.study.montecarlo.grid import address, make_grid
from torchsar.study.montecarlo.loop import looks
from torchsar.study.montecarlo.work import (
    CACHE_BYTES,
    Work,
    cut,
    probed_bytes,
    rows_by_bytes,
    rows_by_peak,
    rows_by_trial,
    rows_of,
)
from torchsar.study.output import progress
from torchsar.study.settings.errors import ConfigError


def same(a: Record, b: Record, rtol: float = 0.0) -> None:
    assert a.labels == b.labels and a.algorithms == b.algorithms
    np.testing.assert_array_equal(a.done, b.done)
    np.testing.assert_array_equal(a.outcome, b.outcome)
    for name in a.metrics:
        np.testing.assert_allclose(a.metrics[name], b.metrics[name], rtol=rtol, atol=rtol)


@pytest.fixture(scope="module")
def reference() -> Record:
    return toy.run(chunk=7)


def test_a_batch_may_hold_several_cases_each_with_its_own_numbers() -> None:
    both = Draws(3, ("a", "b", "a"), [0, 4, 9]).part("noise")
    for row, (case, trial) in enumerate((("a", 0), ("b", 4), ("a", 9))):
        assert torch.equal(both.normal("x", (5,))[row], Draws(3, case, [trial]).part("noise").normal("x", (5,))[0])
    with pytest.raises(ValueError, match="2 cases need as many trials, got 3"):
        Draws(3, ("a", "b"), [0, 1, 2])


def test_addresses_stay_when_the_grid_grows_or_is_reordered() -> None:
    small = make_grid({"a": [1.0, 2.0], "b": {"x": {"k": 1}, "y": {"k": 2}}})
    large = make_grid({"b": {"y": {"k": 2}, "z": {"k": 3}, "x": {"k": 1}}, "a": [0, 2, 1]})
    known = {tuple(sorted(large.labels_at(p).items())): p.address for p in large.points()}
    assert all(known[tuple(sorted(small.labels_at(p).items()))] == p.address for p in small.points())
    assert len(set(known.values())) == 9
    assert address({"a": 20}) == address({"a": 20.0}) != address({"b": 20})


@pytest.mark.parametrize(
    "grid, batched, said",
    [
        ({"a": []}, [], "a has no values"),
        ({"a": [1, 1.0]}, [], "holds 1.0 twice"),
        ({"a": "word"}, [], "must be a list of values"),
        ({"a": [1, "b"]}, [], "mixes numbers and words"),
        ({"a": [{"k": 1}]}, [], "write {label: value"),
        ({"trial": [1]}, [], "names a dimension"),
        ({"a": ["x"]}, ["a"], "finite numbers"),
        ({"a": [float("nan")]}, [], "a holds the value nan"),
        ({"a": [1]}, ["b"], "batched lists 'b'"),
    ],
)
def test_bad_grids_are_refused_by_name(grid: dict, batched: list, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_grid(grid, batched)


def test_results_are_labelled_and_whole(reference: Record) -> None:
    assert reference.dims == ("algorithm", "snr_db", "law", "trial")
    assert reference.metrics["level_error_m"].shape == (2, 3, 2, 40) and reference.done.all()
    assert np.isnan(reference.metrics["first_m"][0]).all() and np.isfinite(reference.metrics["first_m"][1]).all()
    assert (reference.outcome[1] == Outcome.NOT_ASSESSED).all() and reference.ok[
        1
    ].all()  # without a verdict of its own
    rmse = np.sqrt((reference.metrics["level_error_m"][0, :, 0] ** 2).mean(-1))
    np.testing.assert_allclose(rmse, reference.bounds["level_error_m"]["Cramer-Rao bound"][:, 0, 0], rtol=0.4)


def test_the_numbers_are_those_of_each_trial_alone(reference: Record) -> None:
    point = address({"snr_db": 10.0, "law": "tilted"})
    alone = toy.trial({"snr_db": torch.tensor([10.0], dtype=torch.float64), "law": "tilted"}, Draws(5, (point,), [33]))
    np.testing.assert_allclose(
        reference.metrics["level_error_m"][0, 1, 1, 33], float(alone["average"]["level_error_m"][0]), rtol=1e-5
    )
    assert reference.metrics["first_m"][1, 1, 1, 33] == float(alone["transformed"]["first_m"][0])


@pytest.mark.parametrize("chunk", [1, None, 1000])
def test_chunks_change_no_draw_and_no_verdict(reference: Record, chunk: int | None) -> None:
    other = toy.run(chunk=chunk)
    np.testing.assert_array_equal(other.metrics["first_m"], reference.metrics["first_m"])
    same(other, reference, 1e-5)


def test_automatic_chunks_follow_the_bytes_of_the_largest_tensor() -> None:
    def trial(parameters, draws):
        x = draws.normal("x", (1024,), torch.complex64)
        return {"m": torch.fft.fft(torch.cat([x, x], -1)).abs().sum(-1)}

    work = Work(trial, make_grid({}), Draws(1))
    bytes_per_trial = probed_bytes(work, 0)
    # the doubled complex64 row, or the float64 draws
    assert bytes_per_trial in (16 * 1024, 32 * 1024)
    assert rows_by_bytes(bytes_per_trial) == CACHE_BYTES // bytes_per_trial
    assert rows_by_bytes(10 * CACHE_BYTES) == 1
    # up to four trials share the time of the calls
    assert [rows_by_bytes(size << 20) for size in (1, 3, 5, 8, 9, 15, 17)] == [12, 4, 4, 4, 3, 2, 1]
    trial.bytes_per_trial = lambda fixed: 12345
    assert probed_bytes(work, 0) == 12345


def test_chunks_on_a_gpu_follow_measured_peaks() -> None:
    """Peaks of 100 bytes and 20 bytes a trial."""
    assert rows_by_peak({1: 120, 8: 260}, 1000) == 45
    assert rows_by_peak({1: 120, 8: 260}, 10) == 1


def pretend_gpus(monkeypatch: pytest.MonkeyPatch, count: int, peak: Callable[[], int]) -> None:
    """GPUs with 10 GB free each, on which batches take what `peak` says."""

    class Peak:
        def __init__(self, device: object) -> None: ...

        def __enter__(self) -> Peak:
            return self

        def __exit__(self, *_: object) -> None:
            self.bytes = peak()

    monkeypatch.setattr("torchsar.study.montecarlo.work.PeakMemory", Peak)
    for name, value in {"empty_cache": None, "mem_get_info": (10_000_000_000, 0), "device_count": count}.items():
        monkeypatch.setattr(torch.cuda, name, lambda *_, value=value: value)


@pytest.mark.parametrize(
    "each, device, workers, expected, tried",
    [
        (100, "cuda", 1, 73, [1, 1, 8, 37]),
        (100, "cuda", 4, 27, [1, 1, 8, 14]),
        (100, "cuda:1", 4, 7, [1, 1, 8]),
        (10, "cuda", 1, 730, [1, 1, 8, 64, 365]),
        (1, "cuda", 1, 7300, [1, 1, 8]),  # more than there are
    ],
)
def test_processes_share_the_memory_of_a_gpu(
    monkeypatch: pytest.MonkeyPatch, each: int, device: str, workers: int, expected: int, tried: list[int]
) -> None:
    """Two GPUs, and trials of `each` MB beside 700 MB for any number."""
    sizes: list[int] = []

    def trial(parameters, draws):
        sizes.append(len(draws.trials))
        return {"m": draws.normal("x", (1,)).sum(-1)}

    pretend_gpus(monkeypatch, 2, lambda: 700_000_000 + each * 1_000_000 * sizes[-1])
    work = Work(trial, make_grid({}), Draws(1), device)
    assert rows_of(work, 0, 1000, workers) == expected
    assert sizes == tried
    assert rows_of(work, 0, workers, workers) == 1 and len(sizes) == len(tried)


def test_blocks_do_not_make_batches_on_a_gpu_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials of 10 MB beside blocks of 20 MB a trial that take 1 GB at most."""
    sizes: list[int] = []
    pretend_gpus(monkeypatch, 1, lambda: 10_000_000 * sizes[-1] + min(1_000_000_000, 20_000_000 * sizes[-1]))
    found = rows_by_trial(sizes.append, "cuda", 100_000, 1)
    # 8 GB of the 10, less those of the blocks; 1 and 8 trials, of 30 MB each, would make it 266
    assert found == 700


def test_chunks_are_equal_pieces_in_one_order() -> None:
    case = make_grid({"a": [1.0, 2.0, 3.0]}, ["a"]).cases()[0]
    chunks = list(cut(0, case, {0, 2}, 10, 15, 4))
    assert [len(c) for c in chunks] == [3, 4, 3]
    assert [(p, t) for c in chunks for p, t in zip(c.points, c.trials)] == [
        (p, t) for p in (0, 2) for t in range(10, 15)
    ]


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("full"),
        MemoryError("full"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 10 bytes"),
    ],
)
def test_too_large_a_batch_is_halved_and_the_sweep_goes_on(
    reference: Record, error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    sizes = []

    def greedy(parameters, draws):
        sizes.append(len(draws.trials))
        if len(draws.trials) > 4:
            raise error
        return toy.trial(parameters, draws)

    with caplog.at_level(logging.WARNING, "torchsar"):
        same(toy.run(trial=greedy, chunk=20), reference, 1e-5)
    assert sum(size > 4 for size in sizes) <= 6  # one chunk of each case teaches the rest
    assert "20 trials at once do not fit into memory; going on with" in caplog.text


def test_a_long_sweep_reports_progress_while_it_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert progress._EVERY_S < 10
    monkeypatch.setattr(progress, "_EVERY_S", 0.05)

    def slow(parameters, draws):
        time.sleep(0.1)
        return toy.trial(parameters, draws)

    toy.run(trial=slow, grid={"snr_db": [0.0], "law": ["flat"]}, trials=3, chunk=1)
    assert re.search(r"1/3 \[00:00<00:00, .*trials/s", capsys.readouterr().err)


def test_a_warning_is_printed_once_a_sweep(caplog: pytest.LogCaptureFixture) -> None:
    def warning(parameters, draws):
        logging.getLogger("torchsar").warning("warning: the scene leaves the beam")
        warnings.warn("a window  of\n zeros", stacklevel=1)
        return toy.trial(parameters, draws)

    with warnings.catch_warnings(), caplog.at_level(logging.WARNING, "torchsar"):
        warnings.simplefilter("always")
        toy.run(trial=warning, trials=20, chunk=7)
    assert sorted(caplog.messages) == ["warning: a window of zeros", "warning: the scene leaves the beam"]


def test_a_single_trial_that_does_not_fit_is_a_sentence() -> None:
    def greedy(parameters, draws):
        raise MemoryError

    with pytest.raises(ConfigError, match="a single trial does not fit into the memory of cpu"):
        toy.run(trial=greedy, chunk=5)


@pytest.mark.parametrize(
    "result, said",
    [
        (lambda rows: {"m": torch.zeros(rows + 1)}, r"trial.m must hold one real number for each of the 5 trials"),
        (lambda rows: {"m": torch.zeros(rows, dtype=torch.complex64)}, "real number"),
        (lambda rows: {"ok": torch.zeros(rows)}, "ok must be bool"),
        (lambda rows: {"outcome": torch.full((rows,), 9)}, r"outcome must hold codes of torchsar.Outcome, got \[9"),
        (lambda rows: {"m": torch.zeros(rows), "a": {"m": torch.zeros(rows)}}, "not both"),
        (lambda rows: 1 / 0, "ZeroDivisionError: division by zero"),
    ],
)
def test_what_a_trial_does_wrong_is_named_with_its_position(result, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        sweep(lambda parameters, draws: result(len(draws.trials)), {"law": ["flat"]}, trials=5, chunk=5)
    assert "trials 0 to 4 of law=flat failed" in str(caught.value)
    assert caught.value.__cause__ is not None


def test_a_trial_function_gives_outcomes_or_ok_or_neither(tmp_path: Path) -> None:
    codes = torch.tensor([Outcome.OK, Outcome.MISFIT, Outcome.NOISE])

    def trial(parameters, draws):
        m, here = torch.zeros(len(draws.trials)), codes[list(draws.trials)]
        named = {"reasons": {"m": m, "outcome": here, "ok": m > 0}, "verdicts": {"m": m, "ok": here == 0}}
        return {**named, "neither": {"m": m}}

    made = sweep(trial, {"law": ["flat"]}, trials=3, out=tmp_path / "s")
    for record in (made, read_sweep(tmp_path / "s"), made.grown({"law": ("flat", "tilted")}, 5)):
        assert record.outcome.dtype == np.uint8 and record.outcome[:, 0, :3].tolist() == [
            codes.tolist(),
            [Outcome.OK, Outcome.UNSPECIFIED, Outcome.UNSPECIFIED],
            [Outcome.NOT_ASSESSED] * 3,
        ]
        assert record.ok[:, 0, :3].sum(-1).tolist() == [1, 1, 3] and record.ok.sum() == 5


def test_a_store_of_an_earlier_layout_is_refused_with_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("torchsar.study.montecarlo.store.FORMAT", 2)
        toy.run(tmp_path / "s", trials=4)
    for again in (lambda: read_sweep(tmp_path / "s"), lambda: toy.run(tmp_path / "s", trials=4, resume=True)):
        with pytest.raises(ConfigError, match=r"this version of torchsar \(its layout is 2, not 4\); choose another"):
            again()


def test_other_algorithms_in_the_middle_are_refused() -> None:
    with pytest.raises(ConfigError, match="algorithm 'b', but earlier trials of a;"):
        sweep(lambda p, d: {p["law"]: {"m": torch.zeros(len(d.trials))}}, {"law": ["a", "b"]}, trials=2)


def test_the_store_holds_the_record_and_says_where_it_comes_from(reference: Record, tmp_path: Path) -> None:
    toy.run(tmp_path / "s", chunk=7, config={"scene": "toy"})
    held = read_sweep(tmp_path / "s")
    same(held, reference)
    np.testing.assert_array_equal(
        held.bounds["level_error_m"]["Cramer-Rao bound"], reference.bounds["level_error_m"]["Cramer-Rao bound"]
    )
    assert (
        held.about["seed"] == 5
        and held.about["identity"]["config"] == {"scene": "toy"}
        and len(held.about["hash"]) == 24
    )
    session = held.about["sessions"][0]
    assert (
        session["trials"] == 240
        and session["versions"]["torch"] == torch.__version__
        and session["device"] == "cpu"
        and session["seconds"] > 0
    )
    root = zarr.open_group(str(tmp_path / "s" / "results.zarr"), mode="r")
    assert root.metadata.zarr_format == 3 and root["level_error_m"].metadata.dimension_names == (
        "algorithm",
        "snr_db",
        "law",
        "trial",
    )
    assert list(root["law"][:]) == ["flat", "tilted"] and list(root["snr_db"][:]) == [0, 10, 20]


def test_xarray_reads_it(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="the extra xarray is not installed")
    record = toy.run(tmp_path / "s", chunk=7)
    data = record.to_xarray()
    direct = xarray.open_zarr(str(tmp_path / "s" / "results.zarr"), consolidated=False)
    for one in (data, direct):
        picked = one["level_error_m"].sel(algorithm="transformed", snr_db=10.0, law="tilted")
        np.testing.assert_array_equal(picked.values, record.metrics["level_error_m"][1, 1, 1])


def test_a_finished_sweep_is_not_overwritten_and_resuming_computes_nothing(tmp_path: Path) -> None:
    toy.run(tmp_path / "s", version=1)
    with pytest.raises(ConfigError, match="holds a sweep already; add --resume"):
        toy.run(tmp_path / "s")

    def never(parameters, draws):
        raise AssertionError("nothing is missing")

    never.__qualname__ = "trial"
    assert toy.run(tmp_path / "s", trial=never, resume=True, version=1).done.all()


def test_a_sweep_draws_from_its_source_and_goes_on_with_no_other(tmp_path: Path) -> None:
    def drawn(parameters: Mapping[str, Any], draws: Draws) -> dict[str, torch.Tensor]:
        return {"x": draws.normal("x")}

    records = {s: sweep(drawn, {}, trials=3, out=tmp_path / s, random=s) for s in ("numpy", "torch")}
    expected = Draws(1, (address({}),) * 3, range(3), "torch").normal("x")
    assert records["torch"].metrics["x"][0].tolist() == expected.tolist()
    assert records["numpy"].metrics["x"][0].tolist() != expected.tolist()
    longer = sweep(drawn, {}, trials=4, out=tmp_path / "torch", random="torch", resume=True)
    assert longer.about["random"] == "torch" and longer.metrics["x"][0, :3].tolist() == expected.tolist()
    with pytest.raises(ConfigError, match="random was torch and is absent"):
        sweep(drawn, {}, trials=3, out=tmp_path / "torch", resume=True)
    with pytest.raises(ConfigError, match="random must be one of numpy, torch, got 'mersenne'"):
        sweep(drawn, {}, random="mersenne")  # type: ignore[arg-type]


def test_resuming_an_empty_folder_starts(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    assert toy.run(tmp_path / "s", resume=True, trials=3).done.all()


def test_folders_of_others_are_never_touched(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious.txt").write_text("x")
    (tmp_path / "mine2" / "results.zarr").mkdir(parents=True)
    (tmp_path / "file").write_text("x")
    for name in ("mine2", "file"):
        for resume in (False, True):
            with pytest.raises(ConfigError, match="no results|not left by|cannot be written"):
                toy.run(tmp_path / name, resume=resume)
    assert toy.run(tmp_path / "mine", trials=2).done.all()
    assert (tmp_path / "mine" / "precious.txt").read_text() == "x"


def test_trials_and_values_can_be_added(tmp_path: Path) -> None:
    toy.run(tmp_path / "s", trials=20, grid={"snr_db": [0.0, 20.0], "law": ["flat"]}, chunk=7, version=1)
    seen: list[tuple[str, int]] = []

    def noting(parameters, draws):
        seen.extend(zip(draws.case, draws.trials))
        return toy.trial(parameters, draws)

    noting.__qualname__ = "trial"
    grown = toy.run(tmp_path / "s", trial=noting, resume=True, chunk=7, version=1)
    same(grown, toy.run(chunk=7), 1e-5)
    assert len(seen) == len(set(seen)) == 240 - 40
    # what was there stays where it was
    assert read_sweep(tmp_path / "s").labels["snr_db"] == (0.0, 20.0, 10.0)
    part = toy.run(tmp_path / "s", resume=True, grid={"snr_db": [20.0], "law": ["flat"]}, trials=20, version=1)
    assert part.labels == {"snr_db": (20.0,), "law": ("flat",)}


@pytest.mark.parametrize(
    "change, said",
    [
        ({"seed": 6}, "seed was 5 and is 6"),
        ({"config": {"world": {"lines": 65}}}, "config.world.lines was 64 and is 65"),
        ({"grid": {"snr_db": [0.0]}}, "holds a sweep over the parameters snr_db, law, and this sweep is over snr_db;"),
        ({"grid": {"snr_db": [0.0], "law": {"flat": "tilted"}}}, "in which 'flat' of the parameter law stands for"),
    ],
)
def test_resuming_another_sweep_is_refused_with_what_differs(tmp_path: Path, change: dict, said: str) -> None:
    config = {"config": {"world": {"lines": 64}}}
    toy.run(tmp_path / "s", trials=2, **config)
    with pytest.raises(ConfigError, match=said):
        toy.run(tmp_path / "s", trials=2, resume=True, **{**config, **change})


def test_two_writers_are_refused(tmp_path: Path) -> None:
    def second(parameters, draws):
        with pytest.raises(ConfigError, match="another torchsar command is writing"):
            toy.run(tmp_path / "s", resume=True)
        return toy.trial(parameters, draws)

    toy.run(tmp_path / "s", trial=second, trials=2)


def test_arrays_of_chosen_trials_are_kept(tmp_path: Path) -> None:
    toy.run(tmp_path / "s", trials=6, save=[1, 4], chunk=4)
    saved = zarr.open_group(str(tmp_path / "s" / "results.zarr"), mode="r")["saved"]
    point = saved[address({"snr_db": 0.0, "law": "flat"})]
    assert set(point.group_keys()) == {"1", "4"} and len(list(saved.group_keys())) == 6
    expected = toy.trial(
        {"snr_db": torch.zeros(1, dtype=torch.float64), "law": "flat"},
        Draws(5, (address({"snr_db": 0.0, "law": "flat"}),), [4]),
    )
    np.testing.assert_allclose(
        point["4/average.samples"][:], expected["saved"]["average"]["samples"][0].numpy(), rtol=1e-6
    )
    assert point["4"].attrs["parameters"] == {"snr_db": 0.0, "law": "flat"} and point["4"].attrs["trial"] == 4


@pytest.mark.parametrize("bad", [{"trials": 0}, {"chunk": 0}, {"seed": -1}, {"trials": 2.5}, {"device": "abacus"}])
def test_impossible_settings_are_refused(bad: dict) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad)) if "device" not in bad else "abacus"):
        toy.run(**bad)


def test_points_end_early_by_the_trials_in_order_alone() -> None:
    assert (
        looks(200, None) == [200]
        and looks(401, Stop("m", 0.1)) == [50, 100, 200, 400, 401]
        and looks(30, Stop("m", 0.1)) == [30]
    )
    stop = Stop("level_error_m", 0.12, "rmse")
    runs = [toy.run(stop=stop, trials=500, chunk=chunk) for chunk in (7, 64)]
    counts = runs[0].done.sum(-1)
    np.testing.assert_array_equal(counts, runs[1].done.sum(-1))
    assert set(counts.flat) <= {50, 100, 200, 400, 500} and counts.min() < 500
    assert toy.run(stop=Stop("level_error_m", 0.9), trials=500).done.sum(-1).max() == 50
    with pytest.raises(ConfigError, match=r"stop.metric names 'level_error'.*did you mean 'level_error_m'"):
        toy.run(stop=Stop("level_error", 0.1), trials=500)


def test_a_stopped_point_is_extended_when_more_is_asked(tmp_path: Path) -> None:
    loose, tight = Stop("level_error_m", 0.5), Stop("level_error_m", 0.12)
    assert toy.run(tmp_path / "s", stop=loose, trials=200).done.sum(-1).max() == 50
    again = toy.run(tmp_path / "s", stop=tight, trials=200, resume=True)
    np.testing.assert_array_equal(again.done.sum(-1), toy.run(stop=tight, trials=200).done.sum(-1))


def test_memory_stays_flat_over_ten_thousand_trials(tmp_path: Path) -> None:
    held = []

    def trial(parameters, draws):
        x = torch.zeros(len(draws.trials), 1 << 14)
        held.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
        return {"m_m": x.sum(-1)}

    sweep(trial, {"a": [1.0, 2.0]}, trials=5_000, chunk=50, out=tmp_path / "s")
    # KiB; what a chunk holds, 3 MB, must not pile up to 600 MB
    assert len(held) == 200 and held[-1] - held[20] < 6_000


def test_the_machinery_costs_less_than_five_percent(tmp_path: Path) -> None:
    """Of chunks of 50 ms: less than 2.5 ms of processor time a chunk, the store included."""

    def trial(parameters, draws):
        return {f"metric{i}_m": torch.zeros(len(draws.trials)) for i in range(3)}

    began = time.process_time()
    sweep(trial, {"a": [1.0, 2.0]}, trials=400, chunk=8, out=tmp_path / "s")
    assert (time.process_time() - began) / 100 < 2.5e-3


def test_trials_that_came_out_otherwise_are_named(reference: Record) -> None:
    import copy

    other = copy.deepcopy(reference)
    other.metrics["level_error_m"][1, 2, 0, 17] += 0.5
    other.metrics["first_m"][1, 0, 0, 3] *= 1 + 1e-7
    other.outcome[0, 1, 1, 5] = Outcome.MISFIT
    found = differences(reference, other, 1e-5)
    assert [(d.metric, d.algorithm, d.parameters, d.trial) for d in found] == [
        ("level_error_m", "transformed", {"snr_db": 20.0, "law": "flat"}, 17),
        ("outcome", "average", {"snr_db": 10.0, "law": "tilted"}, 5),
    ]
    assert found[0].values[1] - found[0].values[0] == pytest.approx(0.5)
    assert differences(reference, reference, 0.0) == []
    with pytest.raises(ConfigError, match="must have the same algorithms and parameter values"):
        differences(reference, reference.select({"snr_db": (0.0,), "law": ("flat",)}), 0.0)
