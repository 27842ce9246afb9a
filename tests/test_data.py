"""Simulated recordings as a data set: the same trials in any batches and by any workers."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from torch import Tensor
from torch.utils.data import DataLoader

from tests.study.tiny import write_tiny
from torchsar import compensate
from torchsar.core import Draws, Recording, Truth
from torchsar.data import Simulated
from torchsar.echo import simulate_turntable
from torchsar.radar import InverseRadar
from torchsar.scene import Aircraft, TurntableWorld, UniformStartPhase
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench

RADAR = InverseRadar(193.4e12, 150e9, 2000.0, 0.005)

SMALL = (
    "world.pulses=32",
    "world.samples=48",
    "world.scene.aircraft.length_m=0.04",
    "world.scene.aircraft.width_m=0.03",
)
DRAWS = Draws(5, "train", range(100, 111))


def noisy(draws: Draws) -> dict[str, Tensor]:
    return {"world.noise.snr_db": draws.uniform("snr_db", low=-10.0, high=20.0)}


def made(draws: Draws) -> tuple[Recording, Truth]:
    world = TurntableWorld(Aircraft(length_m=0.04, width_m=0.03), start_phase=[UniformStartPhase()], snr_db=0.0)
    return simulate_turntable(RADAR, world, 32, 48, draws)


def of_config(**changes: Any) -> Simulated:
    return Simulated("isal_snr", DRAWS, **{"overrides": SMALL, "vary": noisy, **changes})


def joined(batches: Any) -> tuple[Tensor, dict[str, Tensor]]:
    """Samples and true values of all trials, in order."""
    pairs = list(batches)
    names = [name for name, value in pairs[0][1].values.items() if value.ndim]
    return torch.cat([r.signal.data for r, _ in pairs]), {n: torch.cat([t.values[n] for _, t in pairs]) for n in names}


def assert_same(one: Any, other: Any) -> None:
    (x, truth), (y, true) = joined(one), joined(other)
    assert len(x) == 11 and torch.equal(x, y) and truth.keys() == true.keys()
    assert all(torch.equal(truth[name], true[name]) for name in truth)


@pytest.mark.parametrize("build", [of_config, lambda **changes: Simulated(made, DRAWS, **changes)])
def test_trials_are_the_same_in_any_batches(build: Any) -> None:
    whole = build(batch=11)
    assert len(whole) == 1 and len(build(batch=4)) == 3
    for batch in (1, 4, 7):
        assert_same(whole, build(batch=batch))
    assert_same(whole, whole)
    data, truth = joined(whole)
    assert len(set(data[:, 0, 0].tolist())) == 11 and truth["phase_rad"].shape == (11, 32)


def test_trials_of_another_system_are_the_same_in_any_batches(tmp_path: Path) -> None:
    one, other = (joined(Simulated(write_tiny(tmp_path), DRAWS, batch=batch))[0] for batch in (11, 4))
    assert torch.equal(one, other)


def test_a_batch_is_that_of_a_run() -> None:
    bench = Bench(load("isal_snr", SMALL))
    given = {"noise.snr_db": noisy(DRAWS)["world.noise.snr_db"]}
    trials = bench.trials(DRAWS, given)
    recording, truth = next(iter(of_config(batch=11)))
    assert torch.equal(recording.signal.data, trials.recording.signal.data) and truth.clean is not None
    assert torch.equal(truth.values["phase_rad"], trials.truth["phase_rad"])


def test_workers_share_the_trials_and_keep_their_order() -> None:
    data = of_config(batch=2)
    loader = DataLoader(data, batch_size=None, num_workers=2)
    assert len(loader) == 6
    assert_same(data, loader)


def test_a_data_set_is_sent_to_another_process_without_its_bench() -> None:
    data = of_config(batch=4)
    sent = pickle.dumps(data)
    assert len(sent) < 2000
    assert_same(data, pickle.loads(sent))


def test_draws_with_a_case_per_trial() -> None:
    draws = Draws(5, tuple("abcde"), range(5))
    data, _ = joined(Simulated(made, draws, batch=2))
    alone, _ = joined(Simulated(made, Draws(5, "d", [3])))
    assert torch.equal(data[3], alone[0])


def test_a_network_can_be_trained_on_it() -> None:
    recording, truth = next(iter(of_config()))
    gain = torch.ones((), requires_grad=True)
    found = compensate.sca(recording.signal.data * gain)["phase_rad"]
    (found - truth.values["phase_rad"]).square().mean().backward()
    assert gain.grad is not None and not recording.signal.data.requires_grad


def test_cases_of_a_config_are_chosen_by_name() -> None:
    data = Simulated("isal_table1", DRAWS, overrides=SMALL, case="1_100_90", batch=11)
    assert joined(data)[0].shape == (11, 32, 48)
    with pytest.raises(
        ValueError, match=r"isal_table1.*needs one case of the config, got case=None; its cases are '1_0"
    ):
        Simulated("isal_table1", DRAWS, overrides=SMALL)
    with pytest.raises(ValueError, match="got case='x'; its cases are none"):
        of_config(case="x")


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"batch": 0}, "batch must be a whole number of trials above 0, got 0"),
        ({"batch": 2.0}, "batch must be a whole number of trials above 0, got 2.0"),
        ({"device": "best"}, "the device 'best' cannot be used here: "),
        ({"overrides": ["world.pulse=3"]}, "key 'world.pulse' is not known"),
        ({"vary": lambda draws: {"world.pulses": torch.zeros(11)}}, "vary gives 'world.pulses', which cannot differ"),
        ({"vary": lambda draws: {"seed": torch.zeros(11)}}, "vary gives 'seed', which cannot differ"),
        (
            {"vary": lambda draws: {"world.noise.snr_db": torch.zeros(3)}},
            r"one number per trial .* \(11,\), got \(3,\)",
        ),
        ({"vary": lambda draws: {"world.noise.snr_db": 3.0}}, r"one number per trial .* \(11,\), got float"),
    ],
)
def test_mistakes_are_explained(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        of_config(**changes)


def test_a_config_without_the_extra_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchsar.study.table", None)
    with pytest.raises(ImportError, match=r"to read a config: pip install 'torchsar-lab\[study\]'"):
        of_config()


def test_wrong_sources_and_draws_are_explained(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="name or path of a config, or a function of Draws, got int"):
        Simulated(3, DRAWS)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"needs Draws, such as Draws\(1, trials=range\(100\)\), got int"):
        Simulated(made, 3)  # type: ignore[arg-type]
    for trials in (None, []):
        with pytest.raises(ValueError, match="needs numbers of trials, got Draws with trials="):
            Simulated(made, Draws(1, trials=trials))
    with pytest.raises(ValueError, match="are for a config, and the source is a function"):
        Simulated(made, DRAWS, vary=noisy)
    with pytest.raises(TypeError, match=r"must return a Recording and a Truth, got tuple of \['Recording'\]"):
        next(iter(Simulated(lambda draws: made(draws)[:1], DRAWS)))  # type: ignore[arg-type,return-value]
    with pytest.raises(ValueError, match="nowhere"):
        Simulated("nowhere", DRAWS)
    path, raw = tmp_path / "recorded.yaml", tmp_path / "raw.npz"
    raw.touch()
    path.write_text(
        yaml.safe_dump(
            {
                "title": "a recording",
                "data": {"file": str(raw)},
                "processor": {"recommended": {"stages": {"focus": {"stage": "omega_k"}}}},
            }
        )
    )
    with pytest.raises(ValueError, match="the config processes the recording data.file"):
        Simulated(path, DRAWS)
