"""What holds in every system alike: one frame runs, judges and stores all of them."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import zarr

from tests.study.scenes import IMAGE, ISAL, SCENES, bench_of, draw_first_panels, loaded_as, run, write
from torchsar.cli import main
from torchsar.compensate.pulse_phase import Sca
from torchsar.core import Axis, Draws, Outcome, Signal, numpy_random
from torchsar.study.commands.sweep import SweepTrial
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import cases_of
from torchsar.study.table import load, systems
from torchsar.study.trials import bench as benches
from torchsar.study.trials.batch import Batch, summary, verdict
from torchsar.study.trials.bench import Bench

EVERY = pytest.mark.parametrize("system", SCENES)
# absolute differences between batches, see test_numbers_follow_seed_and_trial_and_not_their_batch
LEEWAY = {"geo_ocean": 1e-3, "path": 1e-3}
CASES = {"one": {"seed": 5}, "other/two": {"seed": 6}}


def batch_of(bench: Bench, trials: list[int], seed: int | None = None, **options: Any) -> Batch:
    return bench.batch(Draws(bench.config.seed if seed is None else seed, bench.system.address, trials), **options)


def figures_of(batch: Batch) -> dict[str, dict[str, torch.Tensor]]:
    """Metrics of every method without its time."""
    return {n: {k: v for k, v in o.metrics.items() if k != "seconds"} for n, o in batch.outcomes.items()}


def test_the_scenes_are_those_of_all_systems() -> None:
    assert set(SCENES) == set(systems)


@EVERY
def test_a_run_means_the_same_in_every_system(
    system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    built = []

    def counted(*args, **context):
        built.append(args)
        return make(*args, **context)

    make = benches.build_chains
    monkeypatch.setattr(benches, "build_chains", counted)
    draw_first_panels(monkeypatch, other_two="one")
    trials = 1 if system == "geo_ocean" else 2
    world = {**SCENES[system]["world"], "trials": trials}
    out = tmp_path / "out"
    tree = run(write(tmp_path, system, cases=CASES, world=world), out)
    # chains are built once per case
    assert len(built) == len(CASES)
    assert str(out / "report.html") in capsys.readouterr().out
    names = {".torchsar", "arrays.zarr", "config.yaml", "figures", "metrics.json", "report.html"}
    assert {path.name for path in out.iterdir()} == names
    loaded = load(str(out / "config.yaml"))
    assert list(tree["methods"]) == list(SCENES[system]["processor"]) and tree["trials"] == trials
    _check_methods(tree, trials)
    _check_numbers(system, tree, loaded)
    _check_arrays(tree, out)
    _check_report(tree, loaded, out)


def _check_methods(tree: dict, trials: int) -> None:
    for name, method in tree["methods"].items():
        assert list(method["cases"]) == list(CASES) and not method["failed"] and method["targets_outside"] == []
        assert method["metrics"] == method["cases"]["one"] != method["cases"]["other/two"]
        plain = {key for key in method["metrics"] if not key.endswith("_sd")}
        # widths of a target that a method did not find are missing, in all trials or in all but one
        finite = {key for key in plain if key.partition("_")[0] not in ("irw", "pslr", "islr")}
        finite |= {key.removesuffix("_sd") for key in method["metrics"] if key.endswith("_sd")}
        spread = {f"{key}_sd" for key in finite - {"ok"}} if trials > 1 else set()
        assert set(method["metrics"]) == plain | spread, name
        missing = {key for key, value in method["metrics"].items() if not isinstance(value, (int, float))}
        assert all(method["metrics"][key] is None for key in missing) and not missing & finite
        assert all(case in ("one", "other_two") for case, _, _ in (t.partition("/") for t in method["targets"]))
    best = tree["methods"]["recommended"]
    assert best["metrics"]["ok"] == 1.0 and best["metrics"]["seconds"] > 0 and best["seconds_by_stage"]
    assert {name.partition("/")[0] for name in best["estimates"]} == {"one", "other_two"}
    for name, entry in best["estimates"].items():
        assert set(entry) == {"value", "std", "ok", "outcome"}, name
        flat = np.atleast_1d(entry["value"])
        assert len(flat) == trials and np.isfinite(flat).all() and len(np.atleast_1d(entry["ok"])) == trials, name
    assert "first case, 'one'" in tree["definitions"]["metrics"] and "snr" in tree["definitions"]
    assert {name.partition("/")[0] for name in tree["truth"]} == {"one", "other_two"}


def _check_numbers(system: str, tree: dict, loaded) -> None:
    """The resolved config gives the same numbers again, from the bench of its first case."""
    case = cases_of(loaded)["one"]
    assert case.config.seed == CASES["one"]["seed"]
    again = figures_of(batch_of(Bench(case), list(range(tree["trials"])), detail=True))
    for name, metrics in again.items():
        for key, value in summary(metrics).items():
            written = tree["methods"][name]["metrics"][key]
            assert (np.nan if written is None else written) == pytest.approx(value, rel=1e-9, abs=1e-12, nan_ok=True)
    assert loaded.system is systems[system]


def _check_arrays(tree: dict, out: Path) -> None:
    root = zarr.open_group(str(out / "arrays.zarr"), mode="r")
    assert {"truth", "estimate"} < set(root.group_keys())
    arrays = [array for _, array in root.members(max_depth=None) if isinstance(array, zarr.Array)]
    images = [array for array in arrays if array.path.endswith("/image")]
    assert images and all(image.metadata.zarr_format == 3 for image in images)
    for image in images:
        group = image.path.rpartition("/")[0]
        assert group.split("/")[0] in ("one", "other_two"), "a slash in the name of a case makes no group"
        for name, length in zip(image.metadata.dimension_names, image.shape, strict=True):
            assert root[f"{group}/{name}"].shape == (length,)
        assert np.abs(image[:]).max() > 0
    for name, entry in tree["methods"]["recommended"]["estimates"].items():
        stored = root[f"estimate/recommended/{name}"][...]
        value = entry["value"] if tree["trials"] == 1 else entry["value"][0]
        assert np.mean(stored) == pytest.approx(np.mean(value), rel=1e-6, abs=1e-12), name


def _check_report(tree: dict, loaded, out: Path) -> None:
    text = (out / "report.html").read_text(encoding="utf-8")
    for outside in ("http://", "https://", "<script", 'src="figures', "@import", "url("):
        assert outside not in text
    pictures = list((out / "figures").iterdir())
    assert len(pictures) >= 5 and all(png.read_bytes().startswith(b"\x89PNG") for png in pictures)
    # the images before and after come first, then the table of the methods, then all pictures
    head, rest = text.split('id="figures"')
    assert rest.count("data:image/png;base64,") == len(pictures) and "data:image/png;base64," in head
    assert 'class="lead"' in head and 'id="pictures"' in rest
    assert "Published values are in brackets" in text and f"seed: {loaded.config.seed}" in text


@EVERY
def test_numbers_follow_seed_and_trial_and_not_their_batch(system: str, tmp_path: Path) -> None:
    """In double precision. The search of a ship, whose speed along the track is known to some
    tenths of a metre per second, stops within a thousandth of that. Tiles are expanded about the
    mean path of a batch, which changes images by less than their error.
    """
    bench = bench_of(tmp_path, system, precision="complex128")
    both, alone = (figures_of(batch_of(bench, of, methods=["recommended"]))["recommended"] for of in ([0, 1], [1]))
    for key, value in alone.items():
        close = {"rtol": 1e-6, "atol": LEEWAY.get(system, 1e-9), "equal_nan": True}
        torch.testing.assert_close(both[key][1:], value, **close, msg=lambda said, key=key: f"{key}: {said}")
    assert any(float(value[0]) != float(value[1]) for value in both.values())
    first, other = (bench.trials(Draws(seed, bench.system.address, [0])) for seed in (1, 2))
    assert not torch.equal(first.recording.signal.data, other.recording.signal.data)


@EVERY
def test_all_random_numbers_of_a_world_are_of_the_source_of_the_config(
    system: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Functions of numpy's source fail here; `scene_seed` draws apart from the noise."""
    own = ["world.scene_seed=5"] if system == "isal_rotation" else []
    plain, other = (bench_of(tmp_path, system, *own, random=source) for source in ("numpy", "torch"))
    by_numpy = plain.trials(plain.draws("run", [0]))
    for name in ("normal", "uniform", "permutation"):
        monkeypatch.delattr(numpy_random, name)
    made = other.trials(other.draws("run", [0]))
    assert bool(made.recording.signal.data.isfinite().all())
    assert not torch.equal(made.recording.signal.data, by_numpy.recording.signal.data)


@EVERY
def test_truth_takes_the_road_of_oracles_alone(system: str, tmp_path: Path) -> None:
    """No recording carries what only the truth knows, and no other method may ask for it."""
    bench = bench_of(tmp_path, system)
    trials = bench.trials(Draws(1, "truth", [0]))
    true = {*trials.truth, *bench.system.truths}
    for recording in (trials.recording, trials.clean):
        assert not {name for name in recording.aux if name in true or "true" in name or "truth" in name}
    for name in bench.system.truths:
        processor = json.loads(json.dumps(SCENES[system]["processor"]))
        stage = list(processor["recommended"]["stages"].values())[-1]
        stage["uses"] = {**stage.get("uses", {}), name: f"truth.{name}"}
        processor["recommended"].pop("oracle", None)
        with pytest.raises(ConfigError, match=f"truth.{name} is a true value"):
            bench_of(tmp_path, system, processor=processor)
        processor["recommended"]["oracle"] = True
        stage["uses"][name] = "truth.colour"
        with pytest.raises(ConfigError, match="truth.colour does not exist"):
            bench_of(tmp_path, system, processor=processor)


@pytest.mark.parametrize("key", ["world.doppler_hz=1254.0", "world.velocity_m_s=6990.0"])
def test_the_reference_of_an_impaired_strip_is_that_of_its_own_truth(key: str) -> None:
    """The image of `clean` stays in focus when the world is changed from the command line."""
    small = ["world.lines=2560", "world.samples=1024", "world.scene.field.count=1", "world.impairments={}"]
    bench = Bench(load("stripmap_damaged", [*small, key]))
    found = batch_of(bench, [0], detail=True, methods=["clean"]).outcomes["clean"].judged
    near = [row for name, row in found.targets.items() if abs(float(row["position_error_azimuth_m"])) < 1]
    assert len(near) >= 8
    assert float(found.metrics["irw_azimuth_m"]) == pytest.approx(4.15, rel=0.03)
    assert float(found.metrics["pslr_azimuth_db"]) == pytest.approx(-13.26, abs=0.5)


@EVERY
def test_a_method_that_fails_loses_no_other(
    system: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TORCHSAR_DEBUG", raising=False)
    bench = bench_of(tmp_path, system)
    lost, other, *_ = bench.chains

    def fail(*_: object) -> None:
        raise ValueError("this chain is broken")

    list(bench.chains[lost].stages.values())[-1].register_forward_pre_hook(fail)
    batch = batch_of(bench, [0], methods=[lost, other])
    broken, kept = batch.outcomes[lost], batch.outcomes[other]
    assert broken.failed == "this chain is broken" and broken.metrics["ok"].tolist() == [False]
    assert f"{lost} failed: this chain is broken" in caplog.text
    assert bench.system.found(bench, broken, batch.trials) == {}
    assert not kept.failed and bool(torch.isfinite(kept.metrics["seconds"]).all())


def test_a_failed_method_stands_in_the_report_and_a_failed_recommended_one_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("no solution")

    monkeypatch.delenv("TORCHSAR_DEBUG", raising=False)
    monkeypatch.setattr(Sca, "forward", fail)
    methods = run(write(tmp_path, "isal"), tmp_path / "out")["methods"]
    assert methods["sca"]["failed"] == "no solution" and methods["sca"]["metrics"] == {"ok": 0.0}
    assert methods["recommended"]["metrics"]["ok"] == 1.0 and not methods["recommended"]["failed"]
    assert "It failed: no solution" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    processor = {**ISAL["processor"], "recommended": ISAL["processor"]["sca"]}
    assert main(["run", write(tmp_path, "isal", processor=processor), "--out", str(tmp_path / "none")]) == 2
    assert "processor.recommended: no solution" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "small.yaml"]


@EVERY
def test_benches_travel_as_configs(system: str, tmp_path: Path) -> None:
    """What goes to another process is small and gives the same numbers there."""
    loaded = loaded_as(tmp_path, system, processor={"recommended": _cheapest(system)}, metrics={})
    trial = SweepTrial(loaded)
    draws = Draws(1, "travel", [0])
    first = trial({}, draws)["recommended"]
    sent = pickle.dumps(trial)
    assert len(sent) < 50_000
    there = pickle.loads(sent)({}, draws)["recommended"]
    assert set(there) == set(first)
    for key in set(first) - {"seconds"}:
        torch.testing.assert_close(there[key], first[key], rtol=0, atol=0, equal_nan=True)


def _cheapest(system: str) -> dict:
    """A method with little work: the first one, unless it is the ideal."""
    methods = SCENES[system]["processor"]
    return next(method for name, method in methods.items() if name not in ("ideal", "clean"))


@EVERY
def test_an_oversized_world_is_a_slip_of_the_pen(system: str, tmp_path: Path) -> None:
    key = next(key for key in ("lines", "periods", "pulses") if key in SCENES[system]["world"])
    with pytest.raises(ConfigError, match=r"world: the raw data of a trial take .* GB, and this machine has"):
        bench_of(tmp_path, system, f"world.{key}=1000000000000")


@EVERY
def test_a_part_of_a_chain_runs_again(system: str, tmp_path: Path) -> None:
    recommended = SCENES[system]["processor"]["recommended"]
    last = list(recommended["stages"])[-1]
    again = {"rerun": {"method": "recommended", "start": last, "given": {}}}
    bench = bench_of(tmp_path, system, processor={"recommended": recommended, "again": again}, metrics={})
    batch = batch_of(bench, [0], detail=True)
    one, other = (batch.outcomes[name].signal for name in ("recommended", "again"))
    assert one is not None and other is not None and not batch.outcomes["again"].failed
    torch.testing.assert_close(other.data, one.data)
    assert batch.outcomes["again"].seconds.keys() == {"rerun"}


CASE_MISTAKES = [
    ({"empty": {}}, "cases.empty changes nothing"),
    ({"odd": {"world.nose.snr_db": 3.0}}, "does not exist, because there is no part 'nose'"),
    ({"odd": {"world.noise.snr_db": "loud"}}, "cases.odd: key 'world.noise.snr_db'"),
    ({"odd": {"metrics.reference": "sca"}}, "cases.odd: the key 'metrics.reference' is common to all cases"),
    ({"odd": {"world.trials": 2}}, "the key 'world.trials' is common to all cases"),
    ({"odd": {"data.file": __file__}}, "a simulation does not use the key 'data.file'"),
    ({"odd": {"processor.more": {"stages": {"image": IMAGE}}}}, "cases.odd adds or removes a method"),
    ({"../": {"seed": 2}}, "'../' is not a valid name of a case"),
    ({"all": {"seed": 2}}, "'all' is not a valid name of a case"),
    ({"truth": {"seed": 2}}, "'truth' is not a valid name of a case"),
    ({"x" * 61: {"seed": 2}}, "is not a valid name of a case"),
    ({"a\tb": {"seed": 2}}, "is not a valid name of a case"),
    ({"a b": {"seed": 2}, "a_b": {"seed": 3}}, "would have the same names"),
]


@pytest.mark.parametrize(("cases", "said"), CASE_MISTAKES, ids=[said for _, said in CASE_MISTAKES])
def test_cases_that_would_mislead_are_refused(tmp_path: Path, cases: dict, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        cases_of(loaded_as(tmp_path, "isal", cases=cases))
    assert said in str(caught.value)


@EVERY
def test_methods_cannot_take_the_names_of_groups_of_results(system: str, tmp_path: Path) -> None:
    processor = SCENES[system]["processor"]
    for name in ("truth", "estimate"):
        with pytest.raises(ConfigError, match=f"processor.{name}: a method cannot have this name"):
            loaded_as(tmp_path, system, processor={**processor, name: processor["recommended"]})


BAD_NAMES = ["", " ", ".", "..", "zarr.json", "a/b", "__a", "a\nb", "x" * 61, "é" * 31, "\ud800"]


def test_the_share_of_trials_that_are_ok_is_that_of_assessed_estimates() -> None:
    silent, best = torch.ones(3).long(), torch.tensor([Outcome.OK, Outcome.NOISE, Outcome.NOT_ASSESSED])
    found = verdict({"autofocus": best, "correct": silent})
    assert found["outcome"].tolist() == best.tolist() and summary(found) == {"ok": 0.5}


@pytest.mark.parametrize("name", BAD_NAMES, ids=range(len(BAD_NAMES)))
def test_methods_have_names_that_files_can_have(name: str, tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"a method cannot be called .*, since|a key must be a word|not readable"
    ) as error:
        loaded_as(tmp_path, "isal", processor={**SCENES["isal"]["processor"], name: {"stages": {"image": IMAGE}}})
    assert "\n" not in str(error.value)


def test_stages_have_names_that_files_can_have(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has 60 characters at most"):
        bench_of(tmp_path, "isal", processor={"recommended": {"stages": {"x" * 61: IMAGE}}}, metrics={})


FAULTS = {
    "division by zero": (ZeroDivisionError("division by zero"), "ZeroDivisionError: division by zero"),
    "index": (IndexError("index 3 is out of range"), "IndexError: index 3 is out of range"),
    "attribute": (AttributeError("'NoneType' object has no attribute 'x'"), "AttributeError: 'NoneType'"),
    "assertion": (AssertionError(), "AssertionError: no message"),
}


@pytest.mark.parametrize("error, said", FAULTS.values(), ids=FAULTS)
def test_a_method_may_fail_with_any_error(
    error: Exception, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.delenv("TORCHSAR_DEBUG", raising=False)
    bench = bench_of(tmp_path, "isal")
    lost, other, *_ = bench.chains
    list(bench.chains[lost].stages.values())[-1].register_forward_pre_hook(fail)
    outcomes = batch_of(bench, [0], methods=[lost, other], detail=True).outcomes
    assert outcomes[lost].failed.startswith(said) and not outcomes[other].failed
    with pytest.raises(MemoryError):
        error = MemoryError()
        batch_of(bench, [0], methods=[lost])


def test_an_image_with_infinite_cells_is_a_failed_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rate of rotation of one method may be estimated as zero."""
    monkeypatch.delenv("TORCHSAR_DEBUG", raising=False)
    bench = bench_of(tmp_path, "isal")
    lost, other, *_ = bench.chains

    def widened(stage: object, given: object, signal: Signal) -> Signal:
        first, second = signal.axes
        return Signal(signal.data, (Axis(first.name, first.n, 0.0, 1e308, first.unit), second))

    list(bench.chains[lost].stages.values())[-1].register_forward_hook(widened)
    outcomes = batch_of(bench, [0], methods=[lost, other], detail=True).outcomes
    assert "cells of infinite size" in outcomes[lost].failed and not outcomes[other].failed


def test_a_point_outside_the_image_of_a_strip_is_counted_and_named(tmp_path: Path) -> None:
    """Squint moves the second point beyond the last line; other systems have such tests too."""
    bench = bench_of(tmp_path, "stripmap", "world.doppler_hz=12.0")
    judged = batch_of(bench, [0], methods=["recommended"], detail=True).outcomes["recommended"].judged
    assert list(judged.outside) == ["points.1"] and set(judged.targets) == {"points.0"}
    assert float(judged.metrics["targets_found"]) == 1
