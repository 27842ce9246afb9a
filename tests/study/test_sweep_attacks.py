"""Mistakes of a user of sweeps: each is answered by one sentence, and nothing that was computed is
lost.
"""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.study.tiny import write_tiny
from torchsar.cli import main
from torchsar.study.montecarlo import Stop, read_sweep, sweep
from torchsar.study.montecarlo.engines import engine
from torchsar.study.montecarlo.grid import address, check_name, make_grid
from torchsar.study.montecarlo.record import summary_of
from torchsar.study.montecarlo.store import Store
from torchsar.study.settings.errors import ConfigError
from torchsar.study.table import load


def level(rows: int) -> torch.Tensor:
    return torch.arange(1.0, rows + 1)


def trial(parameters: dict, draws) -> dict:
    x = draws.normal("x", (2,)).mean(-1)
    return {"m": {"error_m": x, "ok": x > -9}, "bounds": {"error_m": {"x": x.abs()}}}


def run(out: Path | None = None, function: Any = trial, **options: Any):
    return sweep(function, options.pop("grid", {"a": [1.0, 2.0]}), out=out, **{"trials": 4, **options})


# --- grids
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "grid, said",
    [
        ([1, 2], "must be a mapping of names"),
        ({"a": np.float64(3)}, "must be a list of values"),
        ({"a": [10**400]}, "cannot be a label of results"),
        ({"a": {float("nan"): 3}}, "holds the value nan"),
        ({"a": {"x": object()}}, "differs between processes"),
        ({"done": [1]}, "cannot be called 'done'"),
        ({"ok": [1]}, "cannot be called 'ok'"),
        ({"outcome": [1]}, "cannot be called 'outcome'"),
        ({"a/b": [1]}, "without '/'"),
        ({3: [1]}, "cannot be called 3"),
    ],
)
def test_odd_grids_are_refused(grid: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_grid(grid)


def test_zero_has_one_sign_and_large_whole_numbers_stay_apart() -> None:
    assert address({"a": -0.0}) == address({"a": 0.0}) and address({"a": 2**60}) != address({"a": 2**60 + 1})
    assert json.dumps(make_grid({"a": [-0.0]}).labels) == '{"a": [0.0]}'


def test_numbers_of_numpy_and_torch_are_numbers() -> None:
    plain = [p.address for p in make_grid({"a": [0, 1, 2]}, ["a"]).points()]
    given: list[Any] = [list(np.arange(3)), np.arange(3), torch.arange(3), [torch.tensor(i) for i in range(3)]]
    for values in given:
        assert [p.address for p in make_grid({"a": values}, ["a"]).points()] == plain


def test_long_arrays_have_addresses_of_all_their_numbers() -> None:
    one, other = np.zeros(5000), np.zeros(5000)
    other[2500] = 1
    assert len({p.address for p in make_grid({"a": {"one": one, "other": other}}).points()}) == 2


def test_names_of_batched_parameters_are_a_list() -> None:
    with pytest.raises(ConfigError, match=r"write \['snr'\]"):
        make_grid({"snr": [1.0]}, "snr")
    none: Any = None
    with pytest.raises(ConfigError, match=r"batched must be a list of names, got None; write \[\]"):
        make_grid({"snr": [1.0]}, none)


# --- what a trial gives
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "result, said",
    [
        (lambda n: None, "got NoneType"),
        (lambda n: level(n), "got Tensor"),
        (lambda n: {}, "gave none"),
        (lambda n: {"x": {}}, "gave none"),
        (lambda n: {"m": None}, "m must hold one real number for each of the 4 trials, got NoneType"),
        (lambda n: {"m": "word"}, "got str"),
        (lambda n: {"m": level(n), "bounds": {"m": level(n)}}, "'bounds' must be a mapping of mappings"),
        (lambda n: {"m": level(n), "saved": {"m": level(n)}}, "'saved' must be a mapping of mappings"),
        (lambda n: {"m": level(n), "saved": {"m": {"x": torch.zeros(1, 3)}}}, "one array for each of the 4 trials"),
        (lambda n: {"a": level(n)}, "cannot be called 'a'"),
        (lambda n: {"trial": level(n)}, "cannot be called 'trial'"),
        (lambda n: {"x/y": level(n)}, "without '/'"),
        (lambda n: {5: level(n)}, "cannot be called 5"),
        (lambda n: {"m" * 300: level(n)}, "has 300 bytes"),
        (
            lambda n: {"m": level(n), "m_bound_x": level(n), "bounds": {"m": {"x": level(n)}}},
            "cannot be called 'm_bound_x'",
        ),
        (
            lambda n: {"m": level(n), "bounds": {"m": {"a b": level(n), "a_b": level(n)}}},
            "cannot be called 'm_bound_a_b'",
        ),
    ],
)
def test_what_a_trial_gives_is_refused_by_name(result: Callable[[int], Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=said):
        run(tmp_path / "s", lambda parameters, draws: result(len(draws.trials)), chunk=4, save=[0])


@pytest.mark.parametrize("name", ["OK", "a b", "é∞", "m.n"])
def test_unusual_names_are_kept(name: str, tmp_path: Path) -> None:
    record = run(tmp_path / "s", lambda parameters, draws: {name: level(len(draws.trials))})
    np.testing.assert_array_equal(read_sweep(tmp_path / "s").metrics[name], record.metrics[name])
    check_name(name, (), "", "metric")


def test_an_algorithm_that_disappears_is_missed() -> None:
    with pytest.raises(ConfigError, match="results of x alone, but earlier trials of x, y"):
        run(
            function=lambda p, d: {
                "x": {"m": level(len(d.trials))},
                **({"y": {"m": level(len(d.trials))}} if d.trials[0] == 0 else {}),
            },
            chunk=2,
        )


def test_halves_of_a_batch_may_give_other_metrics_but_not_other_algorithms() -> None:
    def halved(extra: Callable[[int], dict]):
        def function(parameters: dict, draws) -> dict:
            if len(draws.trials) > 1:
                raise MemoryError
            return extra(draws.trials[0])

        return function

    record = run(function=halved(lambda t: {"x": {"m": level(1), **({"late": level(1)} if t == 2 else {})}}), chunk=4)
    np.testing.assert_array_equal(np.isfinite(record.metrics["late"][0, 0]), [False, False, True, False])
    assert record.ok.all()
    with pytest.raises(ConfigError, match="the algorithm 'y', but earlier trials of x"):
        run(function=halved(lambda t: {"xy"[t > 1]: {"m": level(1)}}), chunk=4)


def test_half_precision_images_are_kept(tmp_path: Path) -> None:
    import zarr

    run(
        tmp_path / "s",
        lambda p, d: {
            "m": level(len(d.trials)),
            "saved": {"x": {"y": torch.ones(len(d.trials), 3, dtype=torch.bfloat16)}},
        },
        save=[1],
    )
    kept: Any = zarr.open_group(str(tmp_path / "s" / "results.zarr"), mode="r")["saved"]
    assert [group["1/x.y"][:].tolist() for _, group in kept.groups()] == [[1, 1, 1]] * 2


# --- settings
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options, said",
    [
        ({"function": 5}, "must be a function"),
        ({"stop": "m"}, "must be a Stop"),
        ({"config": [1]}, "must be a mapping"),
        ({"save": 3}, "must list the numbers"),
        ({"save": [0]}, "give out as well"),
        ({"trials": 10**13}, "do not fit into memory"),
        ({"trials": 10**18}, "do not fit into memory"),
        ({"workers": 0}, "workers must be a whole number of at least 1, got 0"),
        ({"threads": 0}, "threads must be a whole number"),
        ({"threads": None}, "threads must be a whole number of at least 1, got None"),
        ({"trials": None}, "trials must be a whole number of at least 1, got None"),
        ({"seed": None}, "seed must be a whole number of at least 0, got None"),
        ({"out": "x" * 300}, "cannot be written: .*too long.*; choose another folder"),
        ({"out": b"x"}, "out must be the path of a folder, got b'x'"),
        ({"device": None}, "device None cannot be used"),
        ({"stop": Stop("ok", 0.1)}, "stop.metric names 'ok', which is no metric of the trials"),
    ],
)
def test_impossible_settings_are_refused(options: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        run(options.pop("out", None), **options)


@pytest.mark.parametrize("numbers", [[99], [-1], "01", [True]])
def test_trials_to_keep_are_trials_of_the_sweep(numbers: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="save must list numbers of trials, which are 0 to 3"):
        run(tmp_path / "s", save=numbers)
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("bad", [{"relative": "a"}, {"relative": float("nan")}, {"statistic": "mode"}])
def test_rules_of_ending_early_are_checked_at_once(bad: dict) -> None:
    with pytest.raises(ConfigError, match=f"stop.{next(iter(bad))} must"):
        Stop(**{"metric": "m", "relative": 0.1, **bad})


def test_a_metric_that_is_never_finite_ends_no_point() -> None:
    assert run(
        function=lambda p, d: {"m": level(len(d.trials)) * float("nan")}, stop=Stop("m", 0.1), trials=60
    ).done.all()


# --- folders
# --------------------------------------------------------------------------------------------------


def remove(*parts: str) -> Callable[[Path], Any]:
    return lambda root: (
        shutil.rmtree(root.joinpath(*parts)) if root.joinpath(*parts).is_dir() else root.joinpath(*parts).unlink()
    )


FAULTS = {
    "metric": (remove("error_m"), "'error_m' is missing"),
    "verdicts": (remove("outcome"), "'outcome' is missing"),
    "bound": (remove("error_m_bound_x"), "'error_m_bound_x' is missing"),
    "marks": (remove("done"), "'done' is missing"),
    "root": (remove("zarr.json"), "holds no results of a sweep"),
    "empty": (lambda root: (root / "done" / "zarr.json").write_text(""), "is damaged"),
    "cut": (
        lambda root: [file.write_bytes(b"x") for file in (root / "error_m" / "c").rglob("*") if file.is_file()],
        "is damaged",
    ),
}


@pytest.mark.parametrize("fault, said", FAULTS.values(), ids=FAULTS)
def test_a_broken_store_is_not_taken_for_results(fault: Callable[[Path], Any], said: str, tmp_path: Path) -> None:
    run(tmp_path / "s")
    fault(tmp_path / "s" / "results.zarr")
    for options in ({"resume": True}, {}):
        with pytest.raises(ConfigError, match=said):
            run(tmp_path / "s", **options)


def test_metrics_keep_their_order(tmp_path: Path) -> None:
    names = ["z", "b", "m", "a2", "y", "c"]
    run(tmp_path / "s", lambda p, d: {name: level(len(d.trials)) for name in names})
    assert list(read_sweep(tmp_path / "s").metrics) == names


def test_resuming_checks_what_is_asked_of_the_metrics(tmp_path: Path) -> None:
    run(tmp_path / "s", trials=60)
    with pytest.raises(ConfigError, match=r"stop.metric names 'eror_m'.*did you mean 'error_m'"):
        run(tmp_path / "s", trials=120, resume=True, stop=Stop("eror_m", 0.1))


def test_minus_zero_resumes_zero(tmp_path: Path) -> None:
    run(tmp_path / "s", grid={"a": [0.0]}, version=1)

    def never(parameters: dict, draws) -> dict:
        raise AssertionError("nothing is missing")

    never.__qualname__ = "trial"
    assert run(tmp_path / "s", never, grid={"a": [-0.0]}, resume=True, version=1).done.all()


def test_a_full_disk_loses_nothing_that_was_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    run(tmp_path / "s", trials=2)
    with monkeypatch.context() as patch:
        patch.setattr(Store, "_write", full)
        with pytest.raises(ConfigError, match=r"cannot be written \(No space left on device\).*go on with --resume"):
            run(tmp_path / "s", resume=True)
    assert read_sweep(tmp_path / "s").done.sum() == 4
    assert run(tmp_path / "s", resume=True).done.all()


def test_a_second_interrupt_marks_nothing_that_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Store, "entered", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "s", chunk=1)
    held = read_sweep(tmp_path / "s")
    assert not held.done.any()
    whole = run(tmp_path / "s", resume=True)
    assert np.isfinite(whole.metrics["error_m"]).all()


def test_an_algorithm_without_the_metric_neither_succeeds_nor_fails() -> None:
    def function(parameters: dict, draws) -> dict:
        x = level(len(draws.trials)) / 100
        return {"with": {"error_m": x.where(x > 0.011, torch.nan), "n": x}, "without": {"n": x}}

    record = run(function=function, grid={"a": [1.0]}, chunk=4)
    record.about = {**record.about, "title": "t"}
    points = {
        point["algorithm"]: point
        for point in summary_of(record, {"error_m": 0.5}).tree(record.about, {})["points"]
        if point["metric"] == "error_m"
    }
    assert points["with"]["success_share"] == 0.75 and np.isnan(points["without"]["success_share"])


# --- processes
# --------------------------------------------------------------------------------------------------


def test_workers_that_do_not_start_are_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")

    def fail(*_: Any, **__: Any) -> None:
        raise RuntimeError("Nanny failed to start.")

    monkeypatch.setattr(distributed, "SpecCluster", fail)
    with pytest.raises(ConfigError, match="did not start .*__main__"), engine(2):
        pass


# --- configs
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings, said",
    [
        ({"success": {"ok": 1.0}}, "sweep.success names 'ok', which is no metric of the trials"),
        ({"show": ["ok"]}, "sweep.show names 'ok', which is no metric of the trials"),
        ({"success": {"entropy_nats": -1.0}}, "greater than or equal to 0"),
        ({"save": {"trials": [2]}}, "save must list numbers of trials, which are 0 to 1"),
        ({"world.beam.dwell_s": [0.2, -0.1, 0.3]}, "got -0.1"),
        ({"trials": 10**13}, "do not fit into memory"),
    ],
)
def test_settings_of_a_config_are_checked(
    settings: dict, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = write_tiny(tmp_path, sweep={"world.noise.snr_db": [20.0], "trials": 2, **settings})
    assert main(["sweep", str(config), "--out", str(tmp_path / "s")]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_a_part_of_a_section_is_set_after_the_section(tmp_path: Path) -> None:
    loaded = load(str(write_tiny(tmp_path)))
    changed = loaded.changed({"world.beam.dwell_s": 0.1, "world.beam": {"kind": "dwell", "dwell_s": 0.3}})
    assert changed.config.world["beam"]["dwell_s"] == 0.1


def test_a_method_may_not_have_the_name_of_the_bounds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from tests.study.tiny import TINY

    config = write_tiny(
        tmp_path,
        processor={**TINY["processor"], "bounds": TINY["processor"]["clean"]},
        sweep={"world.noise.snr_db": [20.0], "trials": 1},
    )
    assert main(["sweep", str(config), "--out", str(tmp_path / "s")]) == 2
    assert "processor.bounds: a method of a sweep cannot have this name" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "error, said",
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the report cannot be written"),
        (KeyboardInterrupt(), "go on with --resume"),
    ],
)
def test_a_report_that_fails_leaves_the_results(
    error: BaseException, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: Any) -> None:
        raise error

    config = write_tiny(tmp_path, sweep={"world.noise.snr_db": [20.0], "trials": 1})
    arguments = ["sweep", str(config), "--out", str(tmp_path / "s"), "--resume"]
    with monkeypatch.context() as patch:
        patch.setattr("torchsar.study.commands.sweep.draw_sweep", fail)
        assert main(arguments) in (2, 130)
    assert said in capsys.readouterr().err and read_sweep(tmp_path / "s").done.all()
    assert main(arguments) == 0 and (tmp_path / "s" / "report.html").exists()


@pytest.mark.parametrize("ending", [SystemExit, GeneratorExit])
def test_a_trial_that_ends_the_program_is_named(ending: type[BaseException]) -> None:
    def leaves(parameters: Any, draws: Any) -> Any:
        raise ending(0)

    with pytest.raises(ConfigError, match=rf"trials 0 to \d+ of .* failed: {ending.__name__}: 0"):
        run(function=leaves)


def test_a_metric_without_its_trials_is_refused() -> None:
    def averages(parameters: Any, draws: Any) -> Any:
        return {"error_m": draws.normal("x", (3,)).mean()}

    with pytest.raises(
        ConfigError, match=r"each of the 2 trials, got torch.float64 of shape \(\); reduce over the last"
    ):
        sweep(averages, {"a": [1.0]}, trials=2, chunk=2)


def test_an_error_names_the_line_of_the_function(tmp_path: Path) -> None:
    def fails(parameters: Any, draws: Any) -> Any:
        x = draws.normal("x", (3,))
        return {"error_m": x @ torch.ones(4)}  # this line

    text = Path(__file__).read_text(encoding="utf-8").split("\n")
    line = 1 + next(i for i, one in enumerate(text) if one.endswith("# this line"))
    with pytest.raises(
        ConfigError, match=rf"RuntimeError: size mismatch.* \(line {line} of \S*test_sweep_attacks\.py\)"
    ):
        sweep(fails, {"a": [1.0]}, trials=2)


@pytest.mark.parametrize("drawn", [torch.rand, np.random.rand])
def test_numbers_of_a_global_generator_are_warned_of(drawn: Any, caplog: pytest.LogCaptureFixture) -> None:
    def trial(parameters: Any, draws: Any) -> Any:
        return {"error_m": torch.as_tensor(drawn(len(draws.trials))), "other_m": draws.normal("x", ())}

    sweep(trial, {"a": [1.0]}, trials=8, chunk=2)
    assert caplog.text.count("trials draw random numbers from a global generator") == 1
    caplog.clear()
    sweep(lambda parameters, draws: {"other_m": draws.normal("x", ())}, {"a": [1.0]}, trials=8)
    assert "global generator" not in caplog.text
