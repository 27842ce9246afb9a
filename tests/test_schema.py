"""The JSON schema of configs accepts every packaged config and refuses what the loader refuses."""

from __future__ import annotations

import copy
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from torchsar.cli import main
from torchsar.schema import config_schema, schema_text
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.sections import checked
from torchsar.study.settings.text import packaged_configs, read_tree
from torchsar.study.table import systems

CONFIGS = packaged_configs()
KINDS = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float), "boolean": bool}
ANNOTATIONS = {"$schema", "title", "description", "default", "definitions"}
LIMITS = {
    "minimum": lambda x, limit: x >= limit,
    "exclusiveMinimum": lambda x, limit: x > limit,
    "exclusiveMaximum": lambda x, limit: x < limit,
}


@cache
def schema() -> dict[str, Any]:
    return json.loads(schema_text(config_schema(systems)))


def has_kind(value: Any, kind: str) -> bool:
    if kind == "null" or value is None:
        return kind == "null" and value is None
    return isinstance(value, KINDS[kind]) and (isinstance(value, bool) == (kind == "boolean"))


def fits(value: Any, rules: Any) -> bool:
    """Whether a value is valid by a schema; knows the words that the schema uses, and no others."""
    if isinstance(rules, bool):
        return rules
    if "$ref" in rules:
        name = rules["$ref"].removeprefix("#/definitions/").replace("%20", " ")
        return fits(value, schema()["definitions"][name])
    known = {"properties", "patternProperties", "additionalProperties", "required", "minProperties", "then", *LIMITS}
    for word, rule in rules.items():
        if word == "type" and not has_kind(value, rule):
            return False
        if (word == "enum" and value not in rule) or (word == "const" and value != rule):
            return False
        if word == "anyOf" and not any(fits(value, one) for one in rule):
            return False
        if word == "allOf" and not all(fits(value, one) for one in rule):
            return False
        if word == "if" and fits(value, rule) and not fits(value, rules["then"]):
            return False
        if word == "items" and isinstance(value, list) and not all(fits(one, rule) for one in value):
            return False
        if word in LIMITS and isinstance(value, int | float) and not LIMITS[word](value, rule):
            return False
        assert word in known | ANNOTATIONS | {"type", "enum", "const", "anyOf", "allOf", "if", "items"}, word
    return not isinstance(value, dict) or has_fitting_keys(value, rules)


def has_fitting_keys(value: dict[str, Any], rules: dict[str, Any]) -> bool:
    if set(rules.get("required", ())) - set(value) or len(value) < rules.get("minProperties", 0):
        return False
    for key, one in value.items():
        found = [rule for pattern, rule in rules.get("patternProperties", {}).items() if re.search(pattern, key)]
        found += [rules["properties"][key]] if key in rules.get("properties", {}) else []
        if not all(fits(one, rule) for rule in found or [rules.get("additionalProperties", True)]):
            return False
    return True


@pytest.mark.parametrize("name", CONFIGS)
def test_every_packaged_config_is_valid(name: str) -> None:
    assert fits(read_tree(CONFIGS[name]), schema())


def placed(tree: Any, path: str, value: Any) -> Any:
    tree = copy.deepcopy(tree)
    *above, last = path.split(".")
    section = tree
    for part in above:
        section = section[part]
    section[last] = value
    return tree


WRONG = [
    ("isal_snr", "tilte", "a title"),
    ("isal_snr", "system", "radar"),
    ("isal_snr", "seed", -1),
    ("isal_snr", "seed", "one"),
    ("isal_snr", "radar.carier_hz", 1e9),
    ("isal_snr", "radar.prf_hz", "fast"),
    ("isal_snr", "world.lines", 3),
    ("isal_snr", "world.noise.snr", 3.0),
    ("isal_snr", "world.scene.aircraft.kind", "aeroplane"),
    ("isal_snr", "world.scene.aircraft.azimuth_extent_m", 3.0),
    ("isal_snr", "processor.sca.input", "raw"),
    ("isal_snr", "processor.sca.stages.phase.stage", "scaa"),
    ("isal_snr", "processor.sca.stages.phase.kernel", "ml"),
    ("isal_snr", "processor.sca.stages.phase", "sca"),
    ("isal_snr", "processor.sca.stages.correct.in_doubt", "ignore"),
    ("isal_snr", "processor.sca.stages.correct.uses", "phase"),
    ("isal_snr", "sweep.trails", 3),
    ("isal_snr", "sweep.trials", 0),
    ("isal_snr", "trade", {"tolerances": {}}),
    ("stripmap_damaged", "radar.pulse", {"bandwidth_hz": 1e6}),
    ("stripmap_damaged", "world.impairments.tone.kind", "noise"),
    ("isal_snr", "processor.pga.stages.phase.kernel", "mll"),
    ("sal_points", "world.motion.slow.frequency", 3.0),
    ("geo_ocean", "world.targets.ship1.u_x_m_s", 3.0),
]


@pytest.mark.parametrize(("name", "key", "value"), WRONG, ids=lambda x: str(x)[:40])
def test_a_mistake_is_refused_as_by_the_loader(name: str, key: str, value: Any) -> None:
    right = read_tree(CONFIGS[name])
    tree = placed(right, key, value)
    assert fits(right, schema()) and not fits(tree, schema())
    # the key `system` chooses what checks the rest, and axes of a sweep are checked when it begins
    if key not in ("system", "sweep.trails"):
        with pytest.raises(ConfigError):
            checked(tree, systems[right.get("system", "stripmap")], name)


def test_missing_keys_are_refused() -> None:
    for name, key in (("isal_snr", "title"), ("isal_snr", "processor"), ("isal_snr", "radar.carrier_hz")):
        tree = copy.deepcopy(read_tree(CONFIGS[name]))
        section, _, last = key.rpartition(".")
        del (tree[section] if section else tree)[last]
        # only the loader knows that one of carrier_hz and wavelength_m is needed
        assert fits(tree, schema()) == (key == "radar.carrier_hz")
    stage = placed(read_tree(CONFIGS["isal_snr"]), "processor.sca.stages.phase", {"kernel": "ml"})
    assert not fits(stage, schema())


def test_another_validator_agrees() -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    validator = jsonschema.Draft7Validator(schema())
    validator.check_schema(schema())
    assert all(validator.is_valid(read_tree(path)) for path in CONFIGS.values())
    wrong = [placed(read_tree(CONFIGS[name]), key, value) for name, key, value in WRONG]
    assert not any(validator.is_valid(tree) for tree in wrong)


@pytest.mark.parametrize("name", CONFIGS)
def test_configs_name_the_schema_that_editors_read(name: str) -> None:
    path = CONFIGS[name]
    first = path.read_text(encoding="utf-8").splitlines()[0]
    found = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", first)
    assert found
    assert (path.parent / found[1]).resolve() == CONFIGS["spotlight"].parent / "schema.json"


def test_the_commands_print_a_config_and_its_schema_for_one_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["config", "schema"]) == 0
    assert json.loads(capsys.readouterr().out) == schema()
    assert main(["config", "show", "isal_snr"]) == 0
    shown = capsys.readouterr()
    assert shown.out.startswith("# yaml-language-server: $schema=schema.json\n") and not shown.err
    own = tmp_path / "own.yaml"
    own.write_text(shown.out, encoding="utf-8")
    assert read_tree(own) == read_tree(CONFIGS["isal_snr"])
    assert main(["config", "show", "isal_sner"]) == 2
    assert "did you mean 'isal_snr'" in capsys.readouterr().err
    for words in (["show"], ["schema", "isal_snr"]):
        with pytest.raises(SystemExit):
            main(["config", *words])
