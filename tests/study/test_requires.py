"""What `torchsar requires` predicts against what `torchsar trade` measures, and `auto`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from tests.scripting import script
from torchsar.cli import main
from torchsar.focus import OmegaKStolt
from torchsar.metrics import error_after_gain_db
from torchsar.study.commands.requires import needs
from torchsar.study.settings.errors import ConfigError
from torchsar.study.systems.stripmap.choices import probe_of
from torchsar.study.table import SYSTEMS, load
from torchsar.study.trials.bench import Bench
from torchsar.study.trials.choice import choices_of

ROOT = Path(__file__).parents[2]
ACCURACY = script("requires_accuracy")
# where each key may be left to choose: config, the key that is `auto`, and other changes
PLACES: dict[tuple[str, str], tuple[str, str, list[str]]] = {
    ("stripmap", "stage"): ("stripmap_damaged", "processor.recommended.stages.focus.stage", []),
    ("stripmap", "world.path"): ("stripmap_damaged", "world.path.kind", []),
    ("isal", "world.fidelity"): ("isal_table1", "world.fidelity.kind", []),
    ("isal_rotation", "world.fidelity"): ("isal_corner_cubes", "world.fidelity.kind", ["radar.pulse_s=1e-6"]),
    ("isal_rotation", "uneven_rotation.order"): (
        "isal_rotation_points",
        "processor.recommended.stages.rotation.order",
        [],
    ),
    ("isal_rotation", "matched_fourier.transform"): (
        "isal_rotation_points",
        "processor.recommended.stages.image.transform",
        [],
    ),
    ("sal", "world.fidelity"): ("sal_points", "world.fidelity.kind", ["world.periods=64"]),
    ("geo", "world.receive"): ("geo_point_targets", "world.receive.kind", ["world.samples=null"]),
    ("geo", "remove_transmit_range.order"): (
        "geo_pattern",
        "processor.recommended.stages.transmit.order",
        ["world.pulses=900"],
    ),
    ("geo", "correct_migration.migration"): (
        "geo_point_targets",
        "processor.recommended.stages.migration.migration",
        [],
    ),
    ("path", "stage"): ("airborne_spotlight", "processor.recommended.stages.image.stage", []),
    ("geo_ocean", "stationary_image.form"): ("geo_ocean", "processor.conventional.stages.image.form", []),
}


def at(tree: Any, path: str) -> Any:
    """The mapping that holds the last key of a dotted path in a checked config."""
    for key in path.split(".")[:-1]:
        tree = tree[key] if isinstance(tree, dict) else getattr(tree, key)
    return tree


def test_every_key_that_may_be_left_to_choose_is_tried() -> None:
    assert {(name, place) for name in SYSTEMS for place in load_system(name).exact} == set(PLACES)


def load_system(name: str) -> Any:
    return load(next(config for (system, _), (config, _, _) in PLACES.items() if system == name), []).system


@pytest.mark.slow
@pytest.mark.parametrize("place", PLACES, ids=lambda place: "-".join(place))
def test_auto_takes_what_the_tolerance_dictates(place: tuple[str, str]) -> None:
    """The tolerance lies just above and just below the loss of the cheapest alternatives."""
    config, path, changes = PLACES[place]
    choice = next(one for one in choices_of(Bench(load(config, changes))) if one.at == place[1])
    predicted = [one for one in choice.alternatives if one.loss is not None]
    lossy = [one for one in predicted[:-1] if one.loss][:2]
    assert lossy
    for one in lossy:
        ((metric, loss),) = one.loss.items()  # pyright: ignore[reportOptionalMemberAccess]
        for tolerance in (loss + 0.01, loss - 0.01):
            limit = f"trade.tolerance.{metric}={tolerance!r}"
            bench = Bench(load(config, [*changes, f"{path}=auto", limit]))
            taken = next((x for x in predicted if not x.loss or x.loss[metric] <= tolerance), predicted[-1])
            entry = at(bench.config, path)
            assert {key: entry[key] for key in taken.keys} == dict(taken.keys)
            assert len(bench.chosen) == 1 and f"{taken.name} was chosen" in bench.chosen[0]
            assert ("the most exact" in bench.chosen[0]) == bool(taken.loss and taken.loss[metric] > tolerance)
            assert (taken is one) <= (tolerance > loss)


@pytest.mark.slow
def test_what_stolt_interpolation_loses_are_the_weights_of_the_range_band() -> None:
    """A bandwidth of 30 % of the carrier and 20 degrees of squint, against the direct sum."""
    pulse = "radar.pulse={bandwidth_hz: 2.88e9, duration_s: 0.15e-6}"
    squint = [f"{key}=2190" for key in ("radar.pointing_doppler_hz", "world.doppler_hz")]
    speed = [f"{key}=100" for key in ("radar.velocity_m_s", "world.velocity_m_s")]
    sizes = ["radar.prf_hz=1000", "world.lines=1024", "world.samples=2048", "world.beam.dwell_s=0.5"]
    radar = ["radar.carrier_hz=9.6e9", pulse, "radar.sampling_hz=3.2e9", "radar.near_range_m=10e3"]
    bench = Bench(load("stripmap_damaged", [*radar, *squint, *speed, *sizes, "radar.integration_s=0.5"]))
    forms = next(one for one in choices_of(bench) if one.at == "stage")
    (predicted,) = (forms.alternatives[-1].loss or {}).values()
    raw, patches, known = probe_of(bench).seen()
    image = OmegaKStolt(bench.radar, velocity_m_s=known[1], doppler_hz=known[0])(raw).data
    weight = (1 + bench.radar.range_frequency_hz(image.shape[-1]) / bench.radar.carrier_hz).rsqrt()
    weighted = torch.fft.ifft(torch.fft.fft(image) * weight)
    exact = patches.exact(raw, *known)
    measured, left = (float(error_after_gain_db(patches.cut(x), exact).max()) for x in (image, weighted))
    assert predicted == pytest.approx(measured, abs=0.5) and left < measured - 15


@pytest.mark.slow
def test_the_direct_sum_has_the_gain_over_range_of_transforms() -> None:
    """A swath of a fifth of its range: the sum grows with the range, so that images at its edges
    differed by -25 dB.
    """
    radar = ["radar.carrier_hz=9.6e9", "radar.sampling_hz=72e6", "radar.near_range_m=4000", "radar.prf_hz=400"]
    pulse = ["radar.pulse={bandwidth_hz: 60e6, duration_s: 0.5e-6}", "radar.integration_s=0.5"]
    broadside = [f"{key}=0" for key in ("radar.pointing_doppler_hz", "world.doppler_hz")]
    speed = [f"{key}=100" for key in ("radar.velocity_m_s", "world.velocity_m_s")]
    sizes = ["world.lines=1024", "world.samples=512", "world.beam.dwell_s=0.5"]
    bench = Bench(load("stripmap_damaged", [*radar, *pulse, *broadside, *speed, *sizes]))
    raw, patches, known = probe_of(bench).seen()
    image = OmegaKStolt(bench.radar, velocity_m_s=known[1], doppler_hz=known[0])(raw).data
    error = error_after_gain_db(patches.cut(image), patches.exact(raw, *known))
    assert (error < -45).all()


def test_auto_is_refused_where_nothing_is_to_choose() -> None:
    with pytest.raises(ConfigError, match="this system accepts .auto. only for"):
        Bench(load("isal_corner_cubes", ["processor.none.stages.image.stage=auto"]))
    with pytest.raises(ConfigError, match="this config has no alternatives for it"):
        Bench(load("isal_corner_cubes", ["world.fidelity.kind=auto"]))  # whose pulses have no length


@pytest.mark.slow
@pytest.mark.parametrize("system", list(ACCURACY.FAMILIES))
def test_predictions_agree_with_measurements(system: str) -> None:
    """On other scenes than the recorded ones: right advice, except close to the tolerance."""
    rows = ACCURACY.assessed(system, 2, first=100)["comparisons"]
    assert rows
    for row in rows:
        near = abs(row["measured"] - row["tolerance"]) < (0.1 if row["metric"] == "peak_loss_db" else 5.0)
        assert row["advice_right"] or near, row


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "requires").glob("*.json")), ids=lambda path: path.stem)
def test_the_recorded_accuracy_is_that_of_its_comparisons(path: Path) -> None:
    tree = json.loads(path.read_text(encoding="utf-8"))
    rows = tree["comparisons"]
    assert tree["system"] == path.stem and path.stem in ACCURACY.FAMILIES
    assert {key: tree[key] for key in ACCURACY.summary(rows)} == ACCURACY.summary(rows)
    assert tree["precision"] >= 0.95 and tree["recall"] >= 0.9
    # both sides of the threshold are shown
    assert 0 < tree["acceptable"] < tree["rows"]


def test_every_system_has_a_recorded_accuracy() -> None:
    recorded = {path.stem for path in (ROOT / "docs" / "requires").glob("*.json")}
    said = "a system needs a family in scripts/requires_accuracy.py, which writes its record to docs/requires"
    assert recorded == set(ACCURACY.FAMILIES) == set(SYSTEMS), said


@pytest.mark.parametrize("config", ["isal_table1", "isal_corner_cubes", "sal_points", "geo_ocean", "stripmap_damaged"])
def test_rows_and_choices_give_one_advice(config: str) -> None:
    """A row of the table of simplifications that is about an alternative is judged by its loss."""
    tree = needs(Bench(load(config, [])))
    rows = {row["effect"]: row for row in tree["requirements"]}
    choices = choices_of(Bench(load(config, [])))
    shown = {a["name"]: a["within_tolerance"] for choice in tree["choices"] for a in choice["alternatives"]}
    for one in (one for choice in choices for one in choice.alternatives if one.effect in rows and one.loss):
        assert rows[one.effect]["ok"] == shown[one.name], one.name


def test_the_text_names_limits_losses_and_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["requires", "sal_points", "--out", str(tmp_path / "out")]) == 0
    text = capsys.readouterr().out
    assert "echo model (auto at world.fidelity): quadratic_in_sweep" in text or "every_sample" in text
    assert "flight time ignored" in text and "too much" in text and "enough" in text
