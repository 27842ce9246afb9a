"""One sentence from what the validation of a config finds wrong."""

from __future__ import annotations

import inspect
import types
import typing
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from torchsar.study.settings.errors import did_you_mean

# keys and values that were renamed: a config that still has the old one is given the new one
RENAMED = {
    "damages": "impairments",
    "told": "trigger_known",
    "published_ideal": "published.entropy_above_ideal_nats",
    "damaged": "impaired",
    **{
        key: f"objective.{key}" for key in ("order", "range_term", "yc_m", "variables", "oversampling", "lines", "taps")
    },
}


class Strict(BaseModel):
    """Base of all sections: unknown keys, wrong types and infinities are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


# the error that says most comes first: an unknown key, a missing one, a wrong value; where a number
# or a list of them is accepted, what is wrong with the number says more
_RANK = {"extra_forbidden": 0, "missing": 1, "list_type": 3}


def sentence(error: ValidationError, model: type[BaseModel], file: str, where: str = "") -> str:
    """One sentence from the most telling error of a validation.

    Args:
        error: What pydantic raised.
        model: The model that was validated.
        file: Name of the config.
        where: Dotted path of the section that the model describes.
    """
    worst = min(error.errors(), key=lambda e: _RANK.get(e["type"], 2))
    path = [str(part) for part in worst["loc"]]
    names, section = _descend(model, path)
    key, kind, given = ".".join(([where] if where else []) + names), worst["type"], worst.get("input")
    if kind == "extra_forbidden":
        new = RENAMED.get(path[-1], "")
        if section is not None and new.split(".")[0] in section.model_fields:
            return f"{file}: key {key!r} is now called {new!r}; rename it"
        return f"{file}: key {key!r} is not known{did_you_mean(path[-1], section.model_fields if section else ())}"
    if kind == "missing":
        return f"{file}: key {key!r} is missing"
    text = worst["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if kind in ("dict_type", "model_type", "too_short"):
        text = "should be a mapping of keys" + (", and not an empty one" if kind == "too_short" else "")
    if isinstance(given, str) and given in RENAMED:
        text = f"should be {RENAMED[given]!r}, as it is now called"
    if not key:  # what a whole config contradicts, not one key of it
        return f"{file}: {text}"
    shown = repr(given)
    if not text.startswith("should"):
        return f"{file}: key {key!r}: {text}"
    return f"{file}: key {key!r} has the value {shown if len(shown) < 80 else shown[:77] + '...'}; it {text}"


def _descend(model: type[BaseModel], path: list[str]) -> tuple[list[str], type[BaseModel] | None]:
    """The real keys of a pydantic location (union tags dropped), and the section in which the last
    of them was looked up.
    """
    names: list[str] = []
    section, hint = None, model
    for part in path:
        hint = _without_none(hint)
        if inspect.isclass(hint) and issubclass(hint, BaseModel):
            names.append(part)
            section, hint = hint, hint.model_fields[part].annotation if part in hint.model_fields else None
        elif typing.get_origin(hint) in (dict, list):
            names.append(part)
            hint = typing.get_args(hint)[-1]
    return names, section


def _without_none(hint: Any) -> Any:
    """X for X | None; unions of several types stay, since their members are scalars here."""
    union = typing.get_origin(hint) in (typing.Union, types.UnionType)
    arms = [arm for arm in typing.get_args(hint) if arm is not type(None)] if union else []
    return arms[0] if len(arms) == 1 else hint
