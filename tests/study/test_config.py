"""Configs: what is read, what is refused, and in which words."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from tests.study.tiny import TINY, write_tiny
from torchsar.core import Draws
from torchsar.study.commands.sweep import SweepTrial, sweep_grid
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import cases_of
from torchsar.study.settings.text import dump, override, packaged_configs, parse
from torchsar.study.table import load
from torchsar.study.trials.bench import Bench


def refused(tmp_path: Path, *assignments: str, **changes: object) -> str:
    with pytest.raises(ConfigError) as error:
        bench = Bench(load(str(write_tiny(tmp_path, **changes)), assignments))
        bench.batch(Draws(1, "test", range(1)), detail=True)
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
        ("1:30", "1:30"),
        ("1:30:00.5", "1:30:00.5"),
        ("017", 17),
        ("0o17", 15),
        ("0x1F", 31),
        ("0b101", "0b101"),
        ("1_000", 1000),
        ("2024-01-31", "2024-01-31"),
        ("2024-01-31 10:20:30", "2024-01-31 10:20:30"),
        ("=", "="),
        ("~", None),
        ("no", "no"),
        ("+1.", 1.0),
    ],
)
def test_yaml_reads_numbers_as_numbers(text: str, value: object) -> None:
    assert parse(text, "text") == value
    assert type(parse(text, "text")) is type(value)


LARGE = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 10)}]\n" for old, new in pairwise("abcdefgh")
)


@pytest.mark.parametrize(
    "text, said",
    [
        ("[" * 600 + "]" * 600, "line 1: .*more than 50 parts inside each other"),
        ("\n".join("  " * i + "a:" for i in range(600)), "line 50: .*more than 50 parts"),
        (LARGE, "more than 200000 values with all repetitions"),
        ("a: &a [*a]", "more than 200000 values with all repetitions"),
        ("a: &a {b: *a}", "more than 200000 values with all repetitions"),
        ('a: "\\ud800"', "not readable as YAML"),
        ("? [1, 2]\n: 3", "a key must be a word"),
        ("'': 3", "a key must be a word"),
        ("a: " + "9" * 5000, "not readable as YAML"),
        ("a: !!python/object:os.system {}", "not readable as YAML"),
    ],
    ids=range(10),
)
def test_documents_that_no_step_could_use_are_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        parse(text, "file.yaml")
    assert "\n" not in str(error.value)


def test_repetitions_may_be_used() -> None:
    assert parse("a: &a [1, 2]\nb: [*a, *a]", "text") == {"a": [1, 2], "b": [[1, 2], [1, 2]]}
    assert parse("010: 1\ntrue: 2\n~: 3", "text") == {"010": 1, "true": 2, "~": 3}


@pytest.mark.parametrize("text", ["0o17", "017", "1:30", "1e-6", "yes", "no", "~", "2024-01-31", "0b1", "1_0", "null"])
def test_texts_that_look_like_numbers_stay_texts(text: str) -> None:
    assert parse(dump({"a": text}), "text") == {"a": text}


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
    # any file where a recording is asked for: only its presence is checked here
    recorded = [f"data.file={__file__}"] if "\nradar:" not in packaged_configs()[name].read_text() else []
    for spelled in (name, f"{name}.yaml", f"configs/{name}.yaml"):
        loaded = load(spelled, recorded)
        assert "recommended" in loaded.config.processor
    again = loaded.text()
    assert dump(parse(again, name)) == again
    if loaded.config.sweep.grid:
        assert len(sweep_grid(loaded, SweepTrial(loaded)).points()) > 1
    elif not recorded:
        assert all(Bench(case).chains for case in cases_of(loaded).values())


def test_a_resolved_config_reads_as_itself(tmp_path: Path) -> None:
    loaded = load(str(write_tiny(tmp_path)))
    again = tmp_path / "again.yaml"
    again.write_text(loaded.text(), encoding="utf-8")
    second = load(str(again))
    assert second.config == loaded.config
    assert second.config.processor["recommended"].stages["focus"]["velocity_m_s"] is None  # pyright: ignore


def test_unknown_config_names_what_there_is() -> None:
    with pytest.raises(ConfigError, match="'stripmap_damagd'.*did you mean 'stripmap_damaged'"):
        load("stripmap_damagd")


@pytest.mark.parametrize(
    "assignments, expected",
    [
        (["world.noise.snr_dbb=3"], ["tiny.yaml", "'world.noise.snr_dbb' is not known", "did you mean 'snr_db'"]),
        (["world.noise.snr_db=loud"], ["'world.noise.snr_db' has the value 'loud'", "valid number"]),
        (["world.noise.snr_db=.nan"], ["world.noise.snr_db", "finite"]),
        (["radar.prf_hz=-4"], ["radar.prf_hz must be a positive number", "-4"]),
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
            [
                "processor.recommended.stages.focus.stage",
                "'omega'; did you mean 'omega_k'? (`torchsar list` shows all)",
            ],
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
        (
            ["processor.recommended.stages.focus.in_doubt=zero"],
            ["processor.recommended.stages.focus.in_doubt", "'neutral'", "'apply'", "'zero'"],
        ),
        (["processor.recommended.stages.a-b.stage=omega_k"], ["a-b", "stage name"]),
        (["processor.recommended.stages=null"], ["processor.recommended", "'stages'"]),
        (["processor.squint_ignored.rerun.method=other"], ["processor.squint_ignored.rerun.method", "'other'"]),
        (["processor.squint_ignored.rerun.start=fokus"], ["rerun.start", "did you mean 'focus'"]),
        (["processor.squint_ignored.rerun.given={doppler.x_hz: 1.0}"], ["rerun.given.doppler.x_hz"]),
        (["processor.truth.stages.focus.stage=omega_k"], ["processor.truth", "choose another"]),
        (["metrics.reference=ideal"], ["metrics.reference", "'ideal'"]),
        (["seed=-1"], ["'seed' has the value -1"]),
        (["seed=1.5"], ["'seed' has the value 1.5", "integer"]),
        (["precision=float32"], ["precision", "'complex64' or 'complex128'"]),
        (["random=philox"], ["key 'random' has the value 'philox'", "it should be 'numpy' or 'torch'"]),
        (["data.file=/nowhere/raw.npz"], ["data.file", "'/nowhere/raw.npz' does not exist"]),
        (["nonsense"], ["'nonsense' is not an override"]),
        (["=3"], ["is not an override"]),
        ([".seed=3"], ["'.seed=3' is not an override"]),
        (["world=3"], ["'world' has the value 3", "mapping of keys"]),
        (["world.scene={}"], ["world", "world needs at least 1 scene"]),
        (["data.file=/tmp"], ["data.file", "'/tmp' is no file"]),
        (["world.lines=1000000000000"], ["world", "raw data of a trial take 1.02e+06 GB"]),
        (["world.scene.points.azimuth_m=[1.0, 2.0, 3.0]"], ["world.scene.points", "as many ranges", "[3, 2]"]),
        (["world.scene.points.range_m=[-5000.0, 0.0]"], ["world", "behind the radar"]),
        (["world.scene.field.count=0"], ["world.scene.field", "count=0"]),
        (["world.scene.field.azimuth_extent_m=-1.0"], ["world.scene.field", "-1.0"]),
        (["world.scene.field.level_db=9999.0"], ["world.scene.field", "level_db", "9999"]),
        (["world.beam.dwell_s=-1.0"], ["world.beam", "dwell_s", "-1.0"]),
        (["world.doppler_hz=3000.0"], ["world", "Doppler", "squint beyond 90 degrees"]),
        (["radar.pulse.duration_s=4e-6"], ["world", "a line of 128 samples does not hold the pulse of 200"]),
        (
            ["world.impairments={x: {kind: periodic_jitter, offset_samples: []}}"],
            ["world.impairments.x", "at least one entry of offset_samples"],
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


@pytest.mark.parametrize(
    "assignments, expected",
    [
        (["world.damages={}"], ["'world.damages' is now called 'impairments'"]),
        (["data.damages={}"], ["'data.damages' is now called 'impairments'"]),
        (["processor.clean.input=damaged"], ["should be 'impaired', as it is now called"]),
        (
            ["processor.recommended.stages.focus.uses.doppler_hz=aux.true_doppler_hz"],
            ["'aux.true_doppler_hz' is now called 'truth.doppler_hz'"],
        ),
        (
            ["processor.recommended.stages.r={stage: entropy_rotation, method: descent, order: 2}"],
            ["'processor.recommended.stages.r.order' is now called 'objective.order'"],
        ),
        (["world.noise.order=2"], ["'world.noise.order' is not known"]),
        (
            ["processor.recommended.stages.r.stage=rotation_genetic"],
            ["processor.recommended.stages.r: ", "now called 'stage: entropy_rotation, method: genetic'"],
        ),
        (
            ["processor.recommended.stages.r.stage=rotation_phase_fit"],
            ["'stage: rotation_phase_fit' is now called 'stage: coarse_rotation, fits: 4'"],
        ),
        (
            ["processor.recommended.stages.r.stage=pulse_phase_correct"],
            ["'stage: pulse_phase_correct' is now called 'stage: correct_pulse_phase'"],
        ),
        (
            ["processor.recommended.stages.r={stage: interferometry, dwell_s: 4.5}"],
            ["stages.r.dwell_s' is now called 'aperture.duration_s'"],
        ),
    ],
)
def test_old_names_are_given_the_new_ones(
    tmp_path: Path, assignments: list[str], expected: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Whether the old name is accepted, or the config is refused for it or for another reason."""
    text = ""
    try:
        Bench(load(str(write_tiny(tmp_path)), assignments))
    except ConfigError as error:
        text = str(error)
    assert all(part in text + caplog.text for part in expected), text + caplog.text


@pytest.mark.parametrize(
    "old, new",
    [
        ("{stage: rotation_phase_fit}", "{stage: coarse_rotation, fits: 4}"),
        ("{stage: rotation_search, lines: 3}", "{stage: entropy_rotation, method: grid, objective: {lines: 3}}"),
    ],
)
def test_old_names_are_accepted_as_the_new_ones(old: str, new: str) -> None:
    key = "processor.recommended.stages.rotation"
    found = [load("isal_rotation_points", [f"{key}={entry}"]).config.processor for entry in (old, new)]
    assert found[0] == found[1]


# a config of each system, and a number of it in another unit: kHz for Hz, km for m, ...
MISTAKEN = {
    "stripmap_damaged": [
        ("radar.prf_hz=0.4", "1 Hz to 1e+08 Hz", "did you mean 0.4 kHz, which is 400?"),
        ("radar.pulse.duration_s=3.0", "1e-10 s to 0.1 s", "did you mean 3 ms"),
        ("radar.near_range_m=0.7", "1 m to 1e+08 m", "did you mean 0.7 km"),
        ("world.noise.snr_db=2000.0", "2000 dB", "0 dB to 400 dB"),
        ("sweep.world.noise.snr_db=[0.0, 2000.0]", "2000 dB", "0 dB to 400 dB"),
    ],
    "isal_table1": [("radar.carrier_hz=193.4e3", "2e+07 Hz to 1e+16 Hz", "did you mean 193400 kHz")],
    "isal_satellite": [
        ("radar.wavelength_m=1550.0", "3e-08 m to 15 m", "did you mean 1550 mm"),
        ("world.rotation.omega_rad_s=20000.0", "20000 rad/s", "0 rad/s to 1000 rad/s"),
    ],
    "sal_points": [("radar.period_s=16.0", "1e-08 s to 0.01 s", "did you mean 16 us")],
    "geo_point_targets": [
        ("radar.prf_hz=0.18", "0.18 Hz", "did you mean 0.18 kHz, which is 180?"),
        ("world.targets.at_2.u_r_m_s=4e4", "40000 m/s", "0 m/s to 30000 m/s"),
    ],
    "geo_velocity_prf": [("sweep.radar.prf_hz=[180.0, 0.18]", "0.18 Hz", "did you mean 0.18 kHz")],
    "geo_ocean": [("radar.reference_range_m=5.7", "5.7 m", "did you mean 5.7 km, which is 5700?")],
}


@pytest.mark.parametrize("grid", [5, [1, 2], "x"])
def test_a_grid_that_is_no_mapping_is_refused_beside_other_keys(grid: object) -> None:
    with pytest.raises(ConfigError, match="'sweep.grid' has the value"):
        load("stripmap_doppler", [f"sweep.grid={grid}", "sweep.world.noise.snr_db=[0, 1]"])


@pytest.mark.parametrize("name", MISTAKEN)
def test_numbers_of_no_use_are_refused_with_their_unit(name: str) -> None:
    for assignment, *expected in MISTAKEN[name]:
        with pytest.raises(ConfigError) as error:
            loaded = load(name, [assignment, *(["cases={}"] if assignment.startswith("sweep") else [])])
            sweep_grid(loaded, SweepTrial(loaded))
        assert all(part in str(error.value) for part in expected), str(error.value)


@pytest.mark.parametrize(
    "assignment",
    [
        "radar.prf_hz=10.0",
        "radar.pulse.bandwidth_hz=1e6",
        "world.noise.snr_db=-60.0",
        "world.noise.snr_db=null",
        "world.velocity_m_s=100.0",
        "world.doppler_hz=-150.0",
        "world.scene.points.azimuth_m=[0.0, -1e-9]",
        "world.beam={kind: dwell, dwell_s: 0.02}",
        "world.scene.field.azimuth_extent_m=1e-6",
    ],
)
def test_unusual_numbers_are_accepted(assignment: str, tmp_path: Path) -> None:
    assert Bench(load(str(write_tiny(tmp_path)), [assignment])).chains


def test_missing_sections_are_named(tmp_path: Path) -> None:
    assert "'world' is missing" in refused(tmp_path, world=None)
    assert "'radar' is missing" in refused(tmp_path, radar=None)
    assert "data.file is not set" in refused(tmp_path, radar=None, world=None)
    assert "'recommended'" in refused(tmp_path, processor={"mine": TINY["processor"]["clean"]})
    assert "'title' is missing" in refused(tmp_path, title=None)


def test_chain_of_a_method_is_built_as_written(tmp_path: Path) -> None:
    chain = Bench(load(str(write_tiny(tmp_path)))).chains["recommended"]
    assert list(chain.stages) == ["doppler", "focus"]
    assert chain.uses["focus"] == {"doppler_hz": "doppler.doppler_baseband_hz"}
