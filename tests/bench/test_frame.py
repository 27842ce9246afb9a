"""Scores repeat, methods of all kinds are entered, and cheats are exposed."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from torchsar.cli import main
from torchsar.compensate import Autofocus, Sca, autofocus, sharpest_phase
from torchsar.core import Chain, Estimate
from torchsar.metrics import phase_rmse
from torchsar.repair import RemoveConstant
from torchsar.study.bench import blocks, entrant, frame, methods, records, show
from torchsar.study.bench.frame import Bench, Entry, World, scored
from torchsar.study.bench.learned import networks, trained
from torchsar.study.bench.scenes import Scenes

WORLDS = methods.WORLDS
SOME = [w for w in WORLDS if w.label in ("noise", "direct, 10 dB", "clutter 60 %, 5 dB", "lost pulses, 10 dB")]


def few(run: Callable[..., Any], worlds: list[World] = SOME, name: str = "mine", **options: Any) -> dict[str, Any]:
    """Rows of one method."""
    run = entrant.entrant(run, "phase_rad", per_pulse=True)
    found = scored(methods.BENCH, [Entry(name, run, worlds, methods.PHASES)], 6, **options)
    return found[name]


def without_time(rows: Any) -> Any:
    """Rows without what differs from run to run."""
    if isinstance(rows, dict):
        return {key: without_time(value) for key, value in rows.items() if key not in ("pairs", "memory")}
    return rows


def numbers(rows: Any) -> list[float]:
    """All numbers of rows."""
    if isinstance(rows, dict | list):
        return [x for value in (rows.values() if isinstance(rows, dict) else rows) for x in numbers(value)]
    return [] if rows is None else [float(rows)]


def test_scores_repeat_to_the_bit_and_hardly_depend_on_batches_and_threads() -> None:
    first = without_time(few(Sca()))
    assert first == without_time(few(Sca()))
    assert np.allclose(numbers(first), numbers(without_time(few(Sca(), batch=4))), rtol=1e-5, atol=1e-5)
    before, one = torch.get_num_threads(), SOME[1:2]
    first = without_time(few(Sca(), one))
    torch.set_num_threads(3 - min(before, 2))
    try:
        again = without_time(few(Sca(), one))
    finally:
        torch.set_num_threads(before)
    assert np.allclose(numbers(first), numbers(again), rtol=1e-5, atol=1e-5)


def test_trials_of_a_world_do_not_depend_on_their_number() -> None:
    for world in WORLDS:
        (few_trials,), (more,) = world.blocks(1), world.blocks(2)
        assert torch.allclose(few_trials.data.data[0], more.data.data[0], atol=1e-4), world.label


def test_splits_and_draws_are_other_scenes() -> None:
    world = SOME[1]
    parts = [world.blocks(1), world.blocks(1, "validation"), world.blocks(1, "train"), world.blocks(1, draw=1)]
    assert len({float(part[0].data.data.abs().sum()) for part in parts}) == 4


def of_lags(x: Any) -> Any:
    """Phases from products of adjacent pulses, for tensors and arrays alike."""
    steps = (x[:, 1:] * x[:, :-1].conj()).sum(-1)
    if isinstance(x, np.ndarray):
        return np.concatenate([np.zeros((len(x), 1)), np.angle(steps).cumsum(-1)], -1)
    return torch.cat([torch.zeros(len(x), 1), steps.angle().cumsum(-1)], -1)


class Lags(nn.Module):
    """The same as a module."""

    def forward(self, x: Tensor) -> Tensor:
        return of_lags(x)


def only_arrays(x: Any) -> Any:
    """The same for arrays alone."""
    return of_lags(np.ascontiguousarray(x.astype(np.complex128)))


def test_modules_classes_functions_and_arrays_score_alike() -> None:
    rows = [without_time(few(method)) for method in (of_lags, Lags, Lags(), only_arrays)]
    for other in rows[1:]:
        assert np.allclose(numbers(other), numbers(rows[0]), rtol=1e-3, atol=1e-4)


def test_a_method_may_give_its_deviation_and_its_verdict() -> None:
    def honest(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = autofocus(x)
        return found["phase_rad"], found.std["phase_rad"], found.ok

    assert without_time(few(honest)) == without_time(few(autofocus))
    silent = few(lambda x: (autofocus(x)["phase_rad"], None, None))
    assert silent["all"]["ok"][0] == 1 and silent["all"]["calibration"] is None


def test_a_wrong_shape_is_one_sentence() -> None:
    with pytest.raises(entrant.MethodError, match=r"real values phase_rad of shape \(6, 128\).*got torch.complex64"):
        few(lambda x: x.mean(-1))
    with pytest.raises(entrant.MethodError, match="class, module or function, got int"):
        entrant.entrant(3, "phase_rad")


def test_values_that_are_not_finite_are_no_results() -> None:
    """A method may find nothing, but it cannot be sure of it."""
    nothing = lambda x: torch.full(x.shape[:-1], torch.nan)  # noqa: E731
    rows = few(lambda x: (nothing(x), None, torch.zeros(len(x), dtype=torch.bool)))
    assert rows["all"]["ok"][0] == 0 and rows["all"]["merit"][0] == 0
    for sure in (nothing, lambda x: (nothing(x), None, torch.ones(len(x), dtype=torch.bool))):
        with pytest.raises(entrant.MethodError, match="6 of 6 trials are sure of values that are NaN or Inf"):
            few(sure)
    with pytest.raises(entrant.MethodError, match="standard deviations of at least 0, got -1"):
        few(lambda x: (torch.zeros(x.shape[:-1]), -torch.ones(x.shape[:-1])))


def test_a_method_cannot_change_the_data() -> None:
    def spoils(x: Tensor) -> Tensor:
        x.zero_()
        return torch.zeros(x.shape[:-1])

    entries = [
        Entry(name, entrant.entrant(f, "phase_rad", True), SOME, methods.PHASES)
        for name, f in (("a", spoils), ("b", of_lags))
    ]
    found = scored(methods.BENCH, entries, 6)
    assert without_time(found["b"]) == without_time(few(of_lags))


# Three methods that seem good by one figure alone.


def statistics(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Phases of the statistics of the truth, with their own standard deviation."""
    draws = torch.Generator().manual_seed(1)
    phase = 2 * torch.pi * torch.rand(x.shape[:-1], generator=draws)
    return phase, torch.full_like(phase, 2.5), torch.ones(len(x), dtype=torch.bool)


def sharpest(x: Tensor) -> Tensor:
    """The image of least entropy, whatever its pulses are."""
    return sharpest_phase(x, steps=60, assess=False)["phase_rad"]


def always_ok(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Good phases, of which all are said to be right."""
    found = autofocus(x)
    return found["phase_rad"], found.std["phase_rad"], torch.ones(len(x), dtype=torch.bool)


def of_frames(x: Tensor) -> Tensor:
    """Whatever the frames above hold that has the shape of phases, the arguments of a test too."""

    def phases(value: Any, depth: int) -> Iterator[Tensor]:
        if isinstance(value, Tensor) and value.shape == x.shape[:-1] and value.is_floating_point():
            yield value
        parts = value if isinstance(value, list | tuple) else value.values() if isinstance(value, dict) else ()
        for part in [*parts, *getattr(value, "__dict__", {}).values()] if depth else ():
            yield from phases(part, depth - 1)

    above, frame_above = [], sys._getframe(1)
    while frame_above is not None:
        above += [found for value in list(frame_above.f_locals.values()) for found in phases(value, 3)]
        frame_above = frame_above.f_back
    return above[0].clone() if above else torch.zeros(x.shape[:-1])


def test_no_frame_above_a_method_holds_the_truth() -> None:
    rows = few(of_frames)
    assert rows["all"]["right"][0] == 0 and without_time(rows) == without_time(few(methods.uncorrected))


def test_phases_far_below_the_bound_are_said_to_leak_and_are_not_ranked(tmp_path: Path) -> None:
    known = [block for world in SOME[1:] for block in world.blocks(6)]

    def truthful(x: Tensor) -> Tensor:
        (same,) = (block for block in known if torch.equal(block.data.data, x))
        return (same.truth or {})["phase_rad"].nan_to_num()

    found = few(autofocus, SOME[1:])
    leak = few(truthful, SOME[1:], "leak")
    assert leak["all"]["merit"][0] == 1 and leak["all"]["over_bound"][0] < 0.01
    whole = {**records.recorded("autofocus"), "methods": {"leak": leak, "mine": found}}
    head, _, *lines = show.table(whole).splitlines()
    assert "below the bound: check for a leak of the truth" in head
    assert [line.split()[0] for line in lines] == ["mine", "leak"] and lines[1].split()[1:3] == ["*", "-"]
    assert "leak *" in show.latex(whole) and "below the bound" in show.latex(whole)
    show.save(whole, [tmp_path / "leak.pdf"])
    assert "below the bound" not in show.table(records.recorded("autofocus"))


def test_cheats_are_exposed() -> None:
    honest = few(autofocus)["all"]
    assert honest["sure_wrong"][0] == 0 and honest["merit"][0] > 0.4
    # its errors are within its deviation, but none of its images is right
    drawn = few(statistics)
    assert 0.5 < drawn["all"]["calibration"] < 2
    assert drawn["all"]["right"][0] == 0 and drawn["all"]["sure_wrong"][0] == 1 and drawn["all"]["merit"][0] == -1
    # its images are sharper than the true ones, also where they are wrong, and of noise
    sharp = few(sharpest, [*SOME, *(w for w in WORLDS if w.label == "vehicle 5 dB, 10 dB")])
    vehicle = sharp["worlds"]["vehicle 5 dB, 10 dB"]
    assert vehicle["entropy_excess_nats"][0] < -0.5 and vehicle["sharper_wrong"][0] == 1
    assert vehicle["sure_wrong"][0] == sharp["worlds"]["noise"]["sure_wrong"][0] == 1
    # it has the values of the honest method, and loses by its verdicts alone
    sure = few(always_ok)["all"]
    assert sure["error"] == honest["error"] and sure["right"] == honest["right"]
    assert sure["sure_wrong"][0] > 0.3 and sure["merit"][0] < honest["merit"][0] - 0.3
    assert [x["merit"][0] for x in (honest, sure, sharp["all"], drawn["all"])] == sorted(
        (x["merit"][0] for x in (honest, sure, sharp["all"], drawn["all"])), reverse=True
    )


def test_a_refusal_of_a_built_in_method_is_named_and_an_error_of_an_own_one_ends_the_run() -> None:
    def refuses(data: Any) -> Estimate:
        raise ValueError("not for me")

    rows = scored(methods.BENCH, [Entry("refuses", refuses, SOME, methods.PHASES)], 6)["refuses"]
    assert rows["worlds"]["noise"]["refused"] == "not for me" and rows["all"]["ok"][0] == 0
    with pytest.raises(entrant.MethodError, match="the method refuses failed with ValueError: not for me"):
        few(refuses)


def test_a_chain_is_entered_with_its_last_estimate() -> None:
    leaking = [w for w in WORLDS if w.label == "leakage 0 dB, 10 dB"]
    repaired = Chain(repair=RemoveConstant(), phase=Autofocus())
    assert few(autofocus, leaking)["all"]["right"][0] == 0
    assert few(repaired, leaking)["all"]["ok"][0] == few(repaired, leaking)["all"]["right"][0] == 1
    with pytest.raises(entrant.MethodError, match="no stage of the chain repair estimates phase_rad"):
        few(Chain(repair=RemoveConstant()), leaking)


def test_rows_of_worlds_with_a_wrong_trial_have_more_trials() -> None:
    entry = Entry("mine", entrant.entrant(of_lags, "phase_rad", per_pulse=True), SOME[:2], methods.PHASES)
    rows = scored(methods.BENCH, [entry], 4, most=8)["mine"]
    counts = {world: row["trials"] for world, row in rows["worlds"].items()}
    assert counts == {"noise": 8, "direct, 10 dB": 8 if rows["worlds"]["direct, 10 dB"]["sure_wrong"][0] else 4}
    assert rows["all"]["trials"] == 8 and rows["tracks"]["nothing to be found"]["trials"] == 4


class ByHeart:
    """The frozen phases, with errors of the size of the bound, by the data they belong to."""

    def __init__(self, worlds: list[World]) -> None:
        noise = torch.Generator().manual_seed(1)
        self.known = {}
        for block in (block for world in worlds for block in world.blocks(6)):
            for x, phase in zip(block.data.data, (block.truth or {})["phase_rad"].nan_to_num(), strict=True):
                error = 0.12 * torch.randn(phase.shape, generator=noise)
                self.known[float(x.abs().sum())] = phase + error

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = [self.known.get(float(part.abs().sum())) for part in x]
        ok = torch.tensor([phase is not None for phase in found])
        phase = torch.stack([torch.zeros(x.shape[1]) if phase is None else phase for phase in found])
        return phase, torch.full_like(phase, 0.12), ok


def of_neighbours(x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sure of all trials of a world if it is sure of most."""
    found = autofocus(x)
    return found["phase_rad"], found.std["phase_rad"], (found.ok.double().mean() > 0.5).expand(len(x))


def test_what_was_learnt_by_heart_is_worth_nothing_on_other_draws() -> None:
    cheat, world = ByHeart(SOME[1:2]), SOME[1:2]
    frozen = few(cheat, world)["all"]
    assert frozen["merit"][0] == 1 and 0.5 < frozen["over_bound"][0] < 5 and 0.5 < frozen["calibration"] < 2
    assert few(cheat, world, draw=1)["all"]["right"][0] == 0
    assert few(autofocus, world, draw=1)["all"]["merit"][0] == few(autofocus, world)["all"]["merit"][0] == 1


def test_scores_without_neighbours_show_what_a_method_reads_from_them() -> None:
    half = [w for w in WORLDS if w.label == "scintillating 8 points, 0 dB"]
    honest, cheat = (without_time(few(method, half)["all"]) for method in (autofocus, of_neighbours))
    alone = without_time(few(of_neighbours, half, batch=1)["all"])
    assert cheat["ok"] != honest["ok"] and alone["ok"] == honest["ok"]


def test_time_of_a_process_that_a_method_starts_counts() -> None:
    def elsewhere(x: Tensor) -> Tensor:
        subprocess.run([sys.executable, "-c", "for i in range(2_000_000): pass"], check=True)
        return torch.zeros(x.shape[:-1])

    here, there = (few(method, SOME[1:2])["all"]["pairs"] for method in (methods.uncorrected, elsewhere))
    assert there > 20 * here


def test_recorded_pulses_get_remarks_and_no_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (block,) = SOME[1].blocks(1)
    profiles = block.data.data[0].mT.numpy()
    np.savez(tmp_path / "mine.npz", profiles=profiles, range_step_m=1.0, bandwidth_hz=150e6, prf_hz=100.0)
    monkeypatch.setitem(blocks.BLOCKS, blocks.checksum_of(tmp_path / "mine.npz"), "a block of mine")
    words = ["bench", "autofocus", "uncorrected", "autofocus", "--recorded", str(tmp_path / "mine.npz")]
    assert main(words) == 0
    title, head, none, found = capsys.readouterr().out.splitlines()
    assert title == "mine.npz: a block of mine; without a truth, so that nothing is ranked"
    assert head.split() == ["method", "entropy", "ok", "from", "others", "from", "itself"]
    assert float(found.split()[1]) < float(none.split()[1]) - 0.5
    assert float(found.split()[4]) < 0.05 and float(none.split()[4]) > 1 and found.split()[3] == none.split()[3]
    assert main([*words[:2], "recorded", *words[2:]]) == 2 and "no records" in capsys.readouterr().err


@pytest.fixture
def three(monkeypatch: pytest.MonkeyPatch) -> None:
    """The benchmark with few worlds."""
    entries = [replace(entry, worlds=SOME) for entry in methods.entries() if entry.name in ("sca", "uncorrected")]
    small = Bench("autofocus", "phases", lambda: entries, methods.scores, per_pulse=True)
    monkeypatch.setattr(records, "bench", lambda name: small)


@pytest.mark.usefixtures("three")
def test_the_command_scores_beside_records(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_methods.py").write_text("import numpy as np\n\n\ndef zero(x):\n    return np.zeros(x.shape[:-1])\n")
    out = [word for name in ("mine.json", "mine.tex", "mine.pdf", "mine.txt") for word in ("--out", name)]
    assert main(["bench", "autofocus", "my_methods:zero", "sca", "--trials", "6", *out]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("torchsar bench autofocus, version 2026.2, checksum ")
    assert [line.split()[0] for line in lines[1:]] == ["method", "sca", "my_methods:zero"]
    record = json.loads((tmp_path / "mine.json").read_text())
    assert set(record["methods"]) == {"sca", "my_methods:zero"} and record["version"] == records.VERSION
    assert record["checksum"] in (tmp_path / "mine.tex").read_text()
    assert r"\begin{tabular}" in (tmp_path / "mine.tex").read_text()
    assert (tmp_path / "mine.pdf").read_bytes().startswith(b"%PDF")
    assert main(["bench", "autofocus", "mine.json", "recorded"]) == 0
    both = [line.split()[0] for line in capsys.readouterr().out.splitlines()[2:]]
    assert {"my_methods:zero", "autofocus", "textbook_pga"} <= set(both)


MISTAKEN = """
class Width:
    def __init__(self, width): ...


def boolean(x):
    return x.real.sum(-1), x.real.sum((-1, -2)) > 0


def named(x):
    return {"phase_rad": x.real.sum(-1)}


def fails(x):
    return 1 / 0


def refuses(x):
    raise ValueError("not for me")
"""


@pytest.mark.usefixtures("three")
@pytest.mark.parametrize(
    "words, sentence",
    [
        (["nobody"], "'nobody' is no method of autofocus: give package.module:Name, or one of sca, uncorrected"),
        (["os.path:nothing"], "the method 'os.path:nothing' cannot be imported"),
        (["other.json"], "other.json is not a record of torchsar bench"),
        (["old.json"], "old.json is a record of version"),
        (["sca", "--out", "mine.doc"], "--out mine.doc: the name must end in .json"),
        (["recorded", "small.json"], "small.json was made with --small, and recorded was not; run it without"),
        (["sca", "recorded", "--small"], "this run was made with --small, and recorded was not"),
        (["drawn.json", "recorded"], "drawn.json was made with --draw 1, and recorded with --draw 0"),
        (["sca", "--out", "old.json"], "--out old.json: the file exists"),
        (["nomod:lags"], "'nomod:lags' is no method of autofocus: there is no nomod.py in the working folder"),
        (["./mistaken.py:boolean"], "give mistaken:boolean"),
        (["mistaken:Width"], "Width() without arguments (an instance may be given in its place) failed with TypeError"),
        (["mistaken:boolean"], "std of shape (6, 128), got torch.bool of shape (6,); the order is (value, std, ok)"),
        (["mistaken:named"], "a method must return phase_rad of shape (6, 128), or (value, std, ok), got dict"),
        (["mistaken:refuses"], "the method refuses failed with ValueError: not for me (line 19 of "),
        (["mistaken:fails"], "the method fails failed with ZeroDivisionError: division by zero (line 15 of "),
    ],
)
def test_mistakes_get_one_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    whole = records.recorded("autofocus")
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "old.json").write_text(json.dumps({**whole, "version": "2025.1"}))
    (tmp_path / "small.json").write_text(json.dumps({**whole, "small": True}))
    (tmp_path / "drawn.json").write_text(json.dumps({**whole, "draw": 1}))
    (tmp_path / "mistaken.py").write_text(MISTAKEN)
    sys.modules.pop("mistaken", None)
    assert main(["bench", "autofocus", *words, "--trials", "6"]) == 2
    assert sentence in capsys.readouterr().err


def test_an_unknown_benchmark_gets_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "weather"]) == 2
    assert "there is no benchmark 'weather'; choose one of autofocus, alignment, doppler" in capsys.readouterr().err


def test_words_name_methods_records_and_worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "of_mine.py").write_text("def zero(x):\n    return 0 * x.real.mean(-1)\n")
    words = ["pga_sca:synchronised", "PhaseIncrement=of_mine:zero", "recorded", "a.json"]
    theirs, files = records.methods_of(words)
    assert files == ["recorded", "a.json"] and theirs["pga_sca:synchronised"] is None
    assert theirs["PhaseIncrement=of_mine:zero"].__name__ == "zero"


def test_other_benchmarks_take_methods_of_users() -> None:
    one = records.bench("doppler")
    first = one.entries()[0]
    world = next(w for w in first.worlds if w.label == "own, 10 dB")
    run = entrant.entrant(lambda x: np.zeros(len(x)), "doppler_hz")
    rows = scored(one, [frame.in_worlds_of(replace(first, worlds=[world]), "zero", run)], 6)["zero"]
    path = records.bench("path")
    strip = next(entry for entry in path.entries() if entry.name == "StripAutofocus")
    worlds = [w for w in strip.worlds if w.label == "strip, 3 mm, 0 dB"]
    for method in (lambda x: torch.zeros(x.shape[:-1]), lambda x, transmitter_m: 0 * transmitter_m[..., 0]):
        run = entrant.entrant(method, "phase_rad", path.per_pulse)
        found = scored(path, [Entry("mine", run, worlds, strip.judged)], 1)["mine"]
        assert found["all"]["right"][0] == 0 and found["all"]["error"][0] > 0.5
    assert 5 < rows["all"]["error"][0] < 60 and show.cells({"methods": {"zero": rows}})[0][0] == "method"


def test_scenes_for_training_are_not_those_that_are_scored() -> None:
    train, validation = (Scenes("autofocus", split, length=60, batch=1) for split in ("train", "validation"))
    data, phase = train[30]
    assert data.shape[:2] == phase.shape and len(train) == 60
    world = train.worlds[30 % len(train.worlds)]
    scored_data = world.blocks(1)[0].data.data
    assert not torch.allclose(data, scored_data) and not torch.allclose(data, validation[30][0])
    assert torch.equal(data, train[30][0])
    with pytest.raises(ValueError, match="the splits 'train' and 'validation', got 'test'"):
        Scenes("autofocus", "test")
    with pytest.raises(ValueError, match="1 to 25 trials, got 26"):
        Scenes("autofocus", batch=26)
    with pytest.raises(IndexError):
        train[60]


@pytest.mark.parametrize("name", networks())
def test_networks_follow_added_phases_and_stay_finite(name: str) -> None:
    network = trained()[name]
    (batch,) = SOME[1].blocks(2)
    added = 6 * torch.rand(batch.data.data.shape[:-1], generator=torch.Generator().manual_seed(1))
    moved = network(batch.data.data * torch.polar(torch.ones_like(added), added)[..., None])
    assert float(phase_rmse(moved - added, network(batch.data.data)).max()) < 0.05
    assert bool(network(torch.zeros(2, 32, 8, dtype=torch.complex64)).isfinite().all())
