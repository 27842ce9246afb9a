"""Classes that a config may name, with their keys read from their signatures."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from torchsar.study.settings.errors import ConfigError, did_you_mean

_SCALARS = (float, int, str, bool, type(None))


class Strict(BaseModel):
    """Base of all sections: unknown keys, wrong types and infinities are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


def _plain(hint: Any) -> Any | None:
    """The part of a type that YAML can hold, None where there is nothing.

    Tensors become numbers or lists of numbers.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint in _SCALARS or origin is typing.Literal:
        return hint
    if hint is torch.Tensor:
        return list[float]
    if origin in (typing.Union, types.UnionType):
        kept = [plain for plain in map(_plain, args) if plain is not None]
        return typing.Union[tuple(kept)] if any(k is not type(None) for k in kept) else None  # noqa: UP007, built at run time
    if origin in (list, tuple, Sequence) and args:
        item = _plain(args[0])
        return None if item is None else list[item]
    if origin in (dict, Mapping) and args and args[0] is str:
        item = _plain(args[1])
        return None if item is None else dict[str, item]
    return None


class Catalogue:
    """Names to classes or factories.

    `what` and `key` make the messages: Catalogue("stage", "stage", {...}).
    """

    def __init__(
        self, what: str, key: str, entries: Mapping[str, Callable[..., Any]], given: Sequence[str] = ()
    ) -> None:
        self.what, self.key, self.entries, self.given = what, key, dict(entries), frozenset(given)
        self._models: dict[str, type[BaseModel]] = {}

    def model(self, name: str) -> type[BaseModel]:
        """The keys of one entry and their types, as a pydantic model."""
        if name not in self._models:
            self._models[name] = create_model(name, __base__=Strict, **self._fields(name))
        return self._models[name]

    def _fields(self, name: str) -> dict[str, Any]:
        target = self.entries[name]
        function = target.__init__ if inspect.isclass(target) else target
        hints = typing.get_type_hints(function)
        fields: dict[str, Any] = {}
        for parameter in inspect.signature(target).parameters.values():
            if parameter.name in self.given or parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                continue
            plain = _plain(hints.get(parameter.name, Any))
            required = parameter.default is inspect.Parameter.empty
            if plain is None and required:
                raise TypeError(
                    f"{self.what} {name!r}: its parameter {parameter.name!r} of type "
                    f"{hints.get(parameter.name)} cannot be written in a config; register a factory "
                    "instead"
                )
            if plain is not None:
                default = (
                    ...
                    if required
                    else list(parameter.default)
                    if isinstance(parameter.default, tuple)
                    else parameter.default
                )
                fields[parameter.name] = (plain, default)
        return fields

    def check(self, entry: Any, where: str, file: str) -> tuple[str, dict[str, Any]]:
        """Name and complete keys of an entry {key: name, ...}.

        Raises ConfigError naming file, key and what is accepted.
        """
        if not isinstance(entry, dict):
            raise ConfigError(f"{file}: {where} must be a mapping with the key {self.key!r}, got {entry!r}")
        if self.key not in entry:
            raise ConfigError(f"{file}: {where} lacks the key {self.key!r}{did_you_mean('', self.entries)}")
        name = entry[self.key]
        if not isinstance(name, str) or name not in self.entries:
            raise ConfigError(
                f"{file}: {where}.{self.key} names an unknown {self.what} "
                f"{name!r}{did_you_mean(str(name), self.entries)}"
            )
        try:
            parameters = self.model(name).model_validate({k: v for k, v in entry.items() if k != self.key})
        except ValidationError as error:
            raise ConfigError(sentence(error, self.model(name), file, where)) from None
        return name, parameters.model_dump()

    def make(self, entry: Any, where: str, file: str, **given: Any) -> Any:
        """The object that an entry describes; `given` are the values that do not come from the
        config.
        """
        name, parameters = self.check(entry, where, file)
        target = self.entries[name]
        accepted = inspect.signature(target).parameters
        try:
            return target(**{k: v for k, v in given.items() if k in accepted}, **_converted(target, parameters))
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{file}: {where}: {' '.join(str(error).split())}") from None


def _converted(target: Callable[..., Any], parameters: dict[str, Any]) -> dict[str, Any]:
    """Lists become tuples, or float64 tensors where the signature asks for a tensor and for no
    sequence.
    """
    hints = typing.get_type_hints(target.__init__ if inspect.isclass(target) else target)

    def convert(value: Any, hint: Any) -> Any:
        arms = (hint, *typing.get_args(hint)) if typing.get_origin(hint) in (typing.Union, types.UnionType) else (hint,)
        sequence = any(typing.get_origin(arm) in (list, tuple, Sequence) for arm in arms)
        return torch.tensor(value, dtype=torch.float64) if torch.Tensor in arms and not sequence else tuple(value)

    return {k: convert(v, hints.get(k)) if isinstance(v, list) else v for k, v in parameters.items()}


def sentence(error: ValidationError, model: type[BaseModel], file: str, where: str = "") -> str:
    """One sentence from the most telling of pydantic's errors: an unknown key first, then a missing
    one, then a wrong value.
    """
    rank = {
        "extra_forbidden": 0,
        "missing": 1,
        "list_type": 3,
    }  # a number or a list of them: what is wrong with the number tells more
    worst = min(error.errors(), key=lambda e: rank.get(e["type"], 2))
    path = [str(part) for part in worst["loc"]]
    names, section = _descend(model, path)
    key = ".".join(([where] if where else []) + names)
    if worst["type"] == "extra_forbidden":
        return f"{file}: key {key!r} is not known{did_you_mean(path[-1], section.model_fields if section else ())}"
    if worst["type"] == "missing":
        return f"{file}: key {key!r} is missing"
    text = worst["msg"].removeprefix("Value error, ").removeprefix("Input ")
    if worst["type"] in ("too_short", "too_long") and isinstance(worst["input"], list | tuple):
        limits = worst.get("ctx", {})
        text = (
            f"should be a list of {'at least' if 'min_length' in limits else 'at most'} "
            f"{limits.get('min_length', limits.get('max_length'))} entries"
        )
    elif worst["type"] in ("dict_type", "model_type", "too_short"):
        text = (
            "should be a mapping of keys, and not an empty one"
            if worst["type"] == "too_short"
            else "should be a mapping of keys"
        )
    if not key:  # what a whole config contradicts, not one key of it
        return f"{file}: {text}"
    shown = repr(worst["input"])
    return (
        f"{file}: key {key!r} has the value {shown if len(shown) < 80 else shown[:77] + '...'}; it {text}"
        if text.startswith("should")
        else f"{file}: key {key!r}: {text}"
    )


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
    arms = (
        [arm for arm in typing.get_args(hint) if arm is not type(None)]
        if typing.get_origin(hint) in (typing.Union, types.UnionType)
        else []
    )
    return arms[0] if len(arms) == 1 else hint
