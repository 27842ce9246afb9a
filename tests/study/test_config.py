"""Configs: what is read, what is refused, and in which words."""

from __future__ import annotations

from pathlib import Path

import pytest
from torchsar.study.build import build_chain, resolved
from torchsar.study.config import load
from torchsar.study.stripmap.build import build_radar
from torchsar.study.stripmap.run import prepare

from tests.study.tiny import TINY, write_tiny
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.text import dump, override, packaged_configs, parse
from torchsar.study.systems import system_of


def refused(tmp_path: Path, *assignments: str, **changes: object) -> str:
    with pytest.raises(ConfigError) as error:
        loaded = load(str(write_tiny(tmp_path, **changes)), assignments)
        prepare(loaded)
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize(
    "text, value",
    [
        ("1e-6", 1e-6),
        ("3.2e9", 3.2e9),
        ("-5E+3", -5e3),
        ("1_000.5", 1000.5),
        (".5", 0.5),
        ("7", 7),
        ("yes", "yes"),
        ("true", True),
        ("null", None),
        ("1.2.3", "1.2.3"),
        ("1e", "1e"),
    ],
)
def test_yaml_reads_numbers_as_numbers(text: str, value: object) -> None:
    assert parse(text, "text") == value
    assert type(parse(text, "text")) is type(value)


def test_yaml_dump_comes_back() -> None:
    tree = {"a": 1e-6, "b": [1.0, 2.5e9], "c": {"d": None, "e": "text: with colon"}}
    assert parse(dump(tree), "text") == tree


def test_a_key_given_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match="file.yaml, line 2.*'a' is given twice"):
        parse("a: 1\na: 2\n", "file.yaml")


def test_overrides_make_sections_and_keep_the_rest() -> None:
    tree = override(
        {"world": {"noise": {"snr_db": 5.0}, "lines": 3}}, ["world.noise.snr_db=1e1", "data.file=/x y.npz", "seed=7"]
    )
    assert tree == {"world": {"noise": {"snr_db": 10.0}, "lines": 3}, "data": {"file": "/x y.npz"}, "seed": 7}


def test_override_through_a_value_is_refused() -> None:
    with pytest.raises(ConfigError, match="world.lines.x cannot be set"):
        override({"world": {"lines": 3}}, ["world.lines.x=1"])


@pytest.mark.parametrize("name", sorted(packaged_configs()))
def test_packaged_configs_are_complete(name: str) -> None:
    for spelled in (name, f"{name}.yaml", f"configs/{name}.yaml"):
        # any file: only its presence is checked here
        loaded = load(spelled, [f"data.file={__file__}"])
        assert "recommended" in loaded.config.processor
    if loaded.config.radar is not None:
        system_of(loaded).check(loaded)
        assert parse(dump(resolved(loaded)), name)["seed"] == loaded.config.seed


def test_resolved_config_runs_to_the_same_chain(tmp_path: Path) -> None:
    loaded = load(str(write_tiny(tmp_path)))
    again = tmp_path / "again.yaml"
    again.write_text(dump(resolved(loaded)), encoding="utf-8")
    second = load(str(again))
    assert resolved(second) == resolved(loaded)
    assert resolved(second)["processor"]["recommended"]["stages"]["focus"]["velocity_m_s"] is None


def test_unknown_config_names_what_there_is() -> None:
    with pytest.raises(ConfigError, match="'stripmap_damagd'.*did you mean 'stripmap_damaged'"):
        load("stripmap_damagd")


@pytest.mark.parametrize(
    "assignments, expected",
    [
        (["world.noise.snr_dbb=3"], ["tiny.yaml", "'world.noise.snr_dbb' is not known", "did you mean 'snr_db'"]),
        (["world.noise.snr_db=loud"], ["'world.noise.snr_db' has the value 'loud'", "valid number"]),
        (["world.noise.snr_db=.nan"], ["world.noise.snr_db", "finite"]),
        (["radar.prf_hz=-4"], ["'radar.prf_hz' has the value -4", "greater than 0"]),
        (["radar.pulse.direction=2"], ["radar.pulse.direction", "1 or -1"]),
        (["radar.pulse.bandwidth_hz=60e6"], ["radar:", "exceeds the complex sampling rate"]),
        (["world.lines=abc"], ["'world.lines' has the value 'abc'", "integer"]),
        (["world.beam.kind=dwel"], ["world.beam.kind", "'dwel'", "did you mean 'dwell'"]),
        (["world.beam.dwell_s=long"], ["world.beam.dwell_s", "'long'", "valid number"]),
        (["world.beam.dwels=1"], ["world.beam.dwels", "not known", "did you mean 'dwell_s'"]),
        (["world.scene.points.azimuth_m=[1,x]"], ["world.scene.points.azimuth_m", "'x'"]),
        (["world.scene.points.kind=null"], ["world.scene.points.kind", "unknown scene None"]),
        (["world.impairments.x.kind=nothing"], ["world.impairments.x.kind", "unknown impairment 'nothing'"]),
        (
            ["processor.recommended.stages.focus.stage=omega"],
            ["processor.recommended.stages.focus.stage", "unknown stage 'omega'", "did you mean 'omega_k'"],
        ),
        (
            ["processor.recommended.stages.focus.velocity=3"],
            ["processor.recommended.stages.focus.velocity", "did you mean 'velocity_m_s'"],
        ),
        (
            ["processor.recommended.stages.focus.reference=best"],
            ["processor.recommended.stages.focus", "'best'", "matched"],
        ),
        (
            ["processor.recommended.stages.focus.uses.doppler_hz=velocity"],
            ["processor.recommended", "no earlier stage provides"],
        ),
        (["processor.recommended.stages.focus.uses.dopler_hz=doppler"], ["processor.recommended", "'dopler_hz'"]),
        (["processor.recommended.stages.focus.uses=7"], ["processor.recommended.stages.focus.uses", "7"]),
        (["processor.recommended.stages.a-b.stage=omega_k"], ["a-b", "stage name"]),
        (["processor.recommended.stages=null"], ["processor.recommended", "'stages'"]),
        (["processor.squint_ignored.rerun.method=other"], ["processor.squint_ignored.rerun.method", "'other'"]),
        (["processor.squint_ignored.rerun.start=fokus"], ["rerun.start", "did you mean 'focus'"]),
        (["processor.squint_ignored.rerun.given={doppler.x_hz: 1.0}"], ["rerun.given.doppler.x_hz"]),
        (["processor.truth.stages.focus.stage=omega_k"], ["processor.truth", "taken"]),
        (["metrics.reference=ideal"], ["metrics.reference", "'ideal'"]),
        (["seed=-1"], ["'seed' has the value -1"]),
        (["seed=1.5"], ["'seed' has the value 1.5", "integer"]),
        (["precision=float32"], ["precision", "'complex64' or 'complex128'"]),
        (["data.file=/nowhere/raw.npz"], ["data.file", "'/nowhere/raw.npz' does not exist"]),
        (["nonsense"], ["'nonsense' is not an override"]),
        (["=3"], ["is not an override"]),
        ([".seed=3"], ["'.seed=3' is not an override"]),
        (["world=3"], ["'world' has the value 3", "mapping of keys"]),
        (["world.scene={}"], ["'world.scene' has the value {}", "not an empty one"]),
        (["data.file=/tmp"], ["data.file", "'/tmp' is no file"]),
        (["world.lines=1000000000000"], ["world", "1000000000000 lines of 128 samples", "GB"]),
        (["world.scene.points.azimuth_m=[1.0, 2.0, 3.0]"], ["world.scene.points", "as many ranges", "[3, 2]"]),
        (["world.scene.points.range_m=[-5000.0, 0.0]"], ["world", "behind the radar"]),
        (["world.scene.field.count=0"], ["world.scene.field", "count=0"]),
        (["world.scene.field.azimuth_extent_m=-1.0"], ["world.scene.field", "-1.0"]),
        (["world.scene.field.level_db=9999.0"], ["world.scene.field", "level_db", "9999"]),
        (["world.beam.dwell_s=-1.0"], ["world.beam", "dwell_s", "-1.0"]),
        (["world.doppler_hz=3000.0"], ["world", "Doppler", "squint beyond 90 degrees"]),
        (["radar.pulse.duration_s=1.0"], ["world", "a line of 128 samples does not hold the pulse of 50000000"]),
        (
            ["world.impairments={x: {kind: periodic_jitter, offset_samples: []}}"],
            ["world.impairments.x", "at least one offset"],
        ),
        (["processor.recommended.stages.keys.stage=omega_k"], ["processor.recommended", "cannot be called 'keys'"]),
        (
            ["processor.recommended.stages.lines.stage=line_integrity"],
            ["processor.recommended", "'lines'", "needs the value 'line_number'", "aux.NAME"],
        ),
        (["seed=[1"], ["command line, seed", "not readable as YAML"]),
    ],
)
def test_mistakes_are_named(tmp_path: Path, assignments: list[str], expected: list[str]) -> None:
    text = refused(tmp_path, *assignments)
    for part in expected:
        assert part in text


def test_missing_sections_are_named(tmp_path: Path) -> None:
    assert "'world' is missing" in refused(tmp_path, world=None)
    assert "'radar' is missing" in refused(tmp_path, radar=None)
    assert "data.file is not set" in refused(tmp_path, radar=None, world=None)
    assert "'recommended'" in refused(tmp_path, processor={"mine": TINY["processor"]["clean"]})
    assert "'title' is missing" in refused(tmp_path, title=None)


def test_chain_of_a_method_is_built_as_written(tmp_path: Path) -> None:
    loaded = load(str(write_tiny(tmp_path)))
    chain = build_chain(
        loaded.config.processor["recommended"], "processor.recommended", loaded.file, radar=build_radar(loaded)
    )
    assert list(chain.stages) == ["doppler", "focus"]
    assert chain.uses["focus"] == {"doppler_hz": "doppler.doppler_baseband_hz"}
