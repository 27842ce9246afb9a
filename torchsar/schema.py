"""JSON schema of configs, by which editors complete keys and mark mistakes while one types.

It is derived from what the loader itself checks by: the sections of `torchsar.study.settings`, and
the constructors of the radar, the world, the metrics and the stages of every system.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, get_args

from pydantic import TypeAdapter

from torchsar.study.commands.listing import arguments
from torchsar.study.settings.sections import Config
from torchsar.study.settings.signature import AUTO, Catalogue, Key, Section
from torchsar.study.trials.system import System

Schema = dict[str, Any]
# editors support this draft best
_DRAFT = "http://json-schema.org/draft-07/schema#"
# keys of a config that may be axes of the parameter grid of a sweep
_AXES = r"\.|^(seed|random|precision)$"
_AUTO: Schema = {"const": AUTO}
_NULL: Schema = {"type": "null"}
_NOTHING: Mapping[str, Schema] = {}
# keys that connect a stage to earlier stages of its chain
_CONNECTIONS: Schema = {
    "uses": {"type": "object", "additionalProperties": {"type": "string"}},
    "in_doubt": {"enum": ["neutral", "apply"]},
}


def config_schema(systems: Mapping[str, System]) -> Schema:
    """Return the JSON schema of the configs of some systems.

    Args:
        systems: Systems by name.

    Returns:
        Schema of draft 7. Values that only the loader can judge, such as names of connected stages
        and dotted keys of cases, are free in it.
    """
    whole = Config.model_json_schema(ref_template="#/definitions/{model}")
    known = _Definitions(whole.pop("$defs"))
    known.found["Sweep"]["patternProperties"] = {_AXES: {}}
    whole["properties"]["system"] |= {"enum": list(systems)}
    default = Config.model_fields["system"].default
    chosen = [_of_system(name, system, known, name != default) for name, system in systems.items()]
    return {"$schema": _DRAFT, **whole, "allOf": chosen, "definitions": known.found}


def schema_text(schema: Schema) -> str:
    """Return a schema as JSON with a line for each definition, so that versions can be compared.

    Args:
        schema: The schema, with definitions.

    Returns:
        The text, which ends with a newline.
    """
    rest = [f" {json.dumps(key)}: {json.dumps(value)}," for key, value in schema.items() if key != "definitions"]
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in schema["definitions"].items()]
    return "\n".join(["{", *rest, ' "definitions": {', ",\n".join(lines), " }", "}"]) + "\n"


class _Definitions:
    """Definitions of a schema by name.

    Args:
        found: Those that exist already.
    """

    def __init__(self, found: dict[str, Schema]) -> None:
        self.found = found

    def add(self, name: str, schema: Schema) -> Schema:
        """Add a definition and return the reference to it.

        If there is a different definition of the same name, a number is appended to the name.
        """
        same = (f"{name}{'' if i == 1 else f' {i}'}" for i in range(1, len(self.found) + 2))
        free = next(one for one in same if self.found.get(one, schema) == schema)
        self.found[free] = schema
        return {"$ref": f"#/definitions/{free.replace(' ', '%20')}"}

    def section(self, section: Section, name: str = "") -> Schema:
        """Add a section as a definition and return the reference to it."""
        return self.add(name or section.target.__name__, self.keys(section))

    def keys(self, section: Section, fixed: Mapping[str, Schema] = _NOTHING) -> Schema:
        """Schema of the keys of a section.

        fixed: schemas of further keys, which are the same in every section.
        """
        about, found, required = arguments(section.target), dict(fixed), []
        for name, key in section.keys.items():
            schema = self.key(key)
            found[name] = {"anyOf": [schema, _AUTO]} if name in section.automatic else schema
            if name in about:
                found[name] = {"description": about[name], **found[name]}
            required += [name] if key.default is ... else []
        return {"type": "object", "properties": found, "required": required, "additionalProperties": False}

    def key(self, key: Key) -> Schema:
        """Schema of the values of a key."""
        if key.inner is None:
            return TypeAdapter(key.type).json_schema()
        one = self.section(key.inner) if isinstance(key.inner, Section) else self.catalogue(key.inner)
        schema = {"type": "object", "additionalProperties": one} if key.many else one
        return {"anyOf": [schema, _NULL]} if type(None) in get_args(key.type) or key.default is None else schema

    def catalogue(self, catalogue: Catalogue, further: Mapping[str, Schema] = _NOTHING, name: str = "") -> Schema:
        """Add the schema of the entries of a catalogue and return the reference to it.

        An entry without keys may be written as its name instead of a mapping.
        """
        entries: list[Schema] = [{"enum": list(catalogue.entries)}] if not further else []
        if any(section.automatic for section in catalogue.sections.values()) or not further:
            entries.append({"type": "object", "properties": {catalogue.key: _AUTO}, "required": [catalogue.key]})
        for entry, section in catalogue.sections.items():
            schema = self.keys(section, {catalogue.key: {"const": entry}, **further})
            schema["required"].insert(0, catalogue.key)
            entries.append(self.add(f"{catalogue.what} {entry}", schema))
        return self.add(name or f"any {catalogue.what}", {"anyOf": entries})


def _of_system(name: str, system: System, known: _Definitions, named: bool) -> Schema:
    """Schema of the sections and stages that a config may have if it names this system or no
    system.
    """
    sections = {section: known.section(keys, f"{name} {section}") for section, keys in system.sections.items()}
    for section in ("radar", "world"):
        sections[section] = {"anyOf": [sections[section], _NULL]}
    stage = known.catalogue(system.stages, _CONNECTIONS)
    sections["processor"] = {"additionalProperties": {"properties": {"stages": {"additionalProperties": stage}}}}
    if system.impairments.entries:
        impairment = known.catalogue(system.impairments)
        sections["data"] = {"properties": {"impairments": {"additionalProperties": impairment}}}
    condition: Schema = {"properties": {"system": {"const": name}}}
    return {"if": condition | ({"required": ["system"]} if named else {}), "then": {"properties": sections}}
