"""Config sections that follow from constructors.

Keys, types and defaults are those of the signatures of the constructors, and errors of values are
sentences.
"""

from __future__ import annotations

import dataclasses
import inspect
import logging
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
import yaml
from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from torch import Tensor

from torchsar.study.settings.errors import ConfigError, did_you_mean, one_line

log = logging.getLogger("torchsar")

_SCALARS = (float, int, str, bool, type(None))
_YAML = (*_SCALARS, tuple, list)
# value of a key that is replaced by the cheapest acceptable choice
AUTO = "auto"
Given = Mapping[str, Tensor]
_NOTHING: Given = {}


@dataclass(frozen=True)
class Key:
    """One parameter of a constructor as a key of a config.

    Args:
        type: Type of the value in YAML.
        default: The default in YAML's terms; `...` where the key is required.
        inner: The section or the catalogue that describes the value; None for plain values.
        many: Type of the parameter, "mapping" or "sequence", if the value in YAML is a mapping of
            names to several such sections; empty otherwise.
        per_trial: Whether the constructor accepts a tensor with one entry per trial for a number.
        as_tensor: Whether the constructor accepts a tensor for a list of numbers.
    """

    type: Any
    default: Any
    inner: Section | Catalogue | None = None
    many: str = ""
    per_trial: bool = False
    as_tensor: bool = False


class Section:
    """The keys of a config section, which are the parameters of a constructor.

    Args:
        target: A class or factory function.
        given: Parameters that are not keys of the config.
        automatic: Keys that may have the value `auto`.
    """

    def __init__(self, target: Callable[..., Any], given: Sequence[str] = (), automatic: Sequence[str] = ()) -> None:
        self.target, self.given, self.automatic = target, frozenset(given), automatic

    @cached_property
    def keys(self) -> dict[str, Key]:
        """Keys by name. Raises TypeError for a required parameter that YAML cannot represent."""
        initialised = inspect.isclass(self.target) and not hasattr(self.target, "__dataclass_fields__")
        hints = typing.get_type_hints(self.target.__init__ if initialised else self.target, include_extras=True)
        found = {}
        for parameter in inspect.signature(self.target).parameters.values():
            if parameter.name in self.given or parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
                continue
            key = _key(hints.get(parameter.name, Any), _default(self.target, parameter))
            if key is not None:
                found[parameter.name] = key
            elif parameter.default is parameter.empty:
                kind = f"the type {hints[parameter.name]}" if parameter.name in hints else "no annotation"
                raise TypeError(
                    f"{self.target.__name__}: its parameter {parameter.name!r} has {kind}, and cannot be written in a "
                    "config; annotate it as number, text or list, or register a factory instead"
                )
        return found

    @property
    def is_complete(self) -> bool:
        """True if YAML can represent all required parameters."""
        try:
            return self.keys is not None
        except TypeError:
            return False

    @cached_property
    def model(self) -> type[BaseModel]:
        fields: dict[str, Any] = {name: (key.type, key.default) for name, key in self.keys.items()}
        return create_model(getattr(self.target, "__name__", "section"), __base__=Strict, **fields)

    def check(self, tree: Any, where: str, file: str) -> dict[str, Any]:
        """Check a section and fill in all defaults.

        Args:
            tree: Content of the section.
            where: Dotted path of the section, for messages.
            file: Name of the config, for messages.

        Returns:
            Values of all keys.

        Raises:
            ConfigError: If the content is not valid. The message gives file, key, value and the
                accepted values.
        """
        tree = self._with_new_names(tree, where, file)
        open_keys = [key for key in self.automatic if isinstance(tree, dict) and tree.get(key) == AUTO]
        fixed = {key: value for key, value in tree.items() if key not in open_keys} if open_keys else tree
        try:
            values = self.model.model_validate(fixed).model_dump() | dict.fromkeys(open_keys, AUTO)
        except ValidationError as error:
            raise ConfigError(sentence(error, self.model, file, where)) from None
        for name, key in self.keys.items():
            path, value = f"{where}.{name}" if where else name, typing.cast(Any, values[name])
            if key.inner is None or value is None or name in open_keys:
                continue
            if key.many:
                values[name] = {part: key.inner.check(v, f"{path}.{part}", file) for part, v in value.items()}
            else:
                values[name] = key.inner.check(value, path, file)
        return values

    def _with_new_names(self, tree: Any, where: str, file: str) -> Any:
        """Return the section with renamed keys under their new names."""
        known = self.model.model_fields
        for key in [key for key in tree if key not in known] if isinstance(tree, dict) else []:
            first, _, inner = RENAMED.get(str(key), "").partition(".")
            held = tree.get(first, {} if inner else None)
            if first in known and (isinstance(held, dict) and inner not in held if inner else first not in tree):
                log.warning("%s: key '%s' is now called '%s'", file, f"{where}.{key}", RENAMED[key])
                value = {**held, inner: tree[key]} if inner else tree[key]
                tree = {**{k: v for k, v in tree.items() if k != key}, first: value}
        return tree

    def make(self, values: Mapping[str, Any], where: str, file: str, given: Given = _NOTHING, **context: Any) -> Any:
        """Build the object of a section.

        Args:
            values: Values of all keys, as `check` returns them.
            where: Dotted path of the section, for messages.
            file: Name of the config, for messages.
            given: Tensors with one entry per trial, by dotted key below this section.
            context: Values of parameters that are not keys of the config.

        Raises:
            ConfigError: If the constructor raises an error.
        """
        made = {name: self._made(name, values[name], where, file, below(given, name)) for name in self.keys}
        accepted = inspect.signature(self.target).parameters
        made.update({name: value for name, value in context.items() if name in accepted})
        try:
            return self.target(**{**made, **{name: value for name, value in given.items() if "." not in name}})
        except (ValueError, TypeError) as error:
            text = one_line(error)
            raise ConfigError(f"{file}: {text if text.startswith(f'{where}.') else f'{where}: {text}'}") from None

    def _made(self, name: str, value: Any, where: str, file: str, given: Given) -> Any:
        key, where = self.keys[name], f"{where}.{name}"
        if value is None or key.inner is None:
            return _converted(value, key, given)
        if not key.many:
            return key.inner.make(value, where, file, given)
        parts = {part: key.inner.make(v, f"{where}.{part}", file, below(given, part)) for part, v in value.items()}
        return parts if key.many == "mapping" else list(parts.values())

    def takes_tensor(self, path: Sequence[str], values: Mapping[str, Any]) -> bool:
        """Return whether the number at a path below this section may differ between trials."""
        key = self.keys.get(path[0])
        if key is None or (values.get(path[0]) is None and len(path) > 1):
            return False
        rest, value = path[1:], values[path[0]]
        if key.inner is None:
            index = rest[0] if rest else None
            return key.per_trial and (index is None) == (not isinstance(value, list)) and _is_index(index, value)
        if key.many:
            if not rest or rest[0] not in value:
                return False
            rest, value = rest[1:], value[rest[0]]
        return bool(rest) and key.inner.takes_tensor(rest, value)


class Catalogue:
    """Constructors by name, of which a config chooses one.

    Args:
        what: Kind of the entries, for messages.
        key: The key of a config that holds the name.
        entries: Classes or factories, whose names in snake case are those of the entries, or a
            mapping of other names to them.
        given: Parameters that are not keys of the config.
        automatic: Keys that may have the value `auto`, as `ENTRY.key`.
    """

    def __init__(
        self,
        what: str,
        key: str,
        entries: Sequence[Callable[..., Any]] | Mapping[str, Callable[..., Any]],
        given: Sequence[str] = (),
        automatic: Sequence[str] = (),
    ) -> None:
        self.what, self.key = what, key
        named = {snake(one.__name__): one for one in entries} if isinstance(entries, Sequence) else entries
        self.entries: dict[str, Callable[..., Any]] = dict(named)
        self.automatic = automatic
        free = [key.split(".") for key in automatic]
        self.sections = {
            n: Section(target, given, [k for m, k in free if m == n]) for n, target in self.entries.items()
        }

    def check(self, entry: Any, where: str, file: str) -> dict[str, Any]:
        """Check an entry {key: name, ...} and fill in all defaults.

        Args:
            entry: The entry, or the name alone.
            where: Dotted path of the entry, for messages.
            file: Name of the config, for messages.

        Returns:
            The complete entry.

        Raises:
            ConfigError: If the content is not valid. The message gives file, key, value and the
                accepted values.
        """
        if isinstance(entry, str):
            entry = {self.key: entry}
        if not isinstance(entry, dict):
            raise ConfigError(f"{file}: {where} must be a mapping with the key {self.key!r}, got {entry!r}")
        if self.key not in entry:
            raise ConfigError(f"{file}: {where} lacks the key {self.key!r}{did_you_mean('', self.entries)}")
        name, rest = entry[self.key], {key: value for key, value in entry.items() if key != self.key}
        if name == AUTO:
            return entry
        new, _, more = RENAMED.get(str(name), "").partition(", ")
        if new in self.entries and name not in self.entries:
            text = "%s: %s: '%s: %s' is now called '%s: %s'"
            log.warning(text, file, where, self.key, name, self.key, RENAMED[name])
            name, rest = new, {**yaml.safe_load(f"{{{more}}}"), **rest}
        if not isinstance(name, str) or name not in self.entries:
            hint = did_you_mean(str(name), self.entries, "`torchsar list` shows all" if self.what == "stage" else "")
            raise ConfigError(f"{file}: {where}.{self.key} names an unknown {self.what} {name!r}{hint}")
        return {self.key: name, **self.sections[name].check(rest, where, file)}

    def make(self, entry: Mapping[str, Any], where: str, file: str, given: Given = _NOTHING, **context: Any) -> Any:
        """Build the object of a checked entry; see `Section.make`."""
        rest = {key: value for key, value in entry.items() if key != self.key}
        return self.sections[entry[self.key]].make(rest, where, file, given, **context)

    def takes_tensor(self, path: Sequence[str], entry: Mapping[str, Any]) -> bool:
        """Return whether the number at a path below an entry may differ between trials."""
        return entry[self.key] in self.sections and self.sections[entry[self.key]].takes_tensor(path, entry)

    def describe(self, value: Any) -> dict[str, Any] | None:
        """Return the config entry that builds an object like `value`.

        The result is None if no entry of the catalogue has the class of `value`.
        """
        name = next((name for name, target in self.entries.items() if target is type(value)), None)
        return None if name is None else {self.key: name, **_described(value)}


def below(given: Given, name: str) -> dict[str, Tensor]:
    """Return the entries whose keys begin with a name and a dot, with this beginning removed.

    For the name "a", {"a.b": 1, "c": 2} gives {"b": 1}.
    """
    return {key.partition(".")[2]: value for key, value in given.items() if key.startswith(f"{name}.")}


def _key(hint: Any, default: Any) -> Key | None:
    """Key for a parameter of a type; None if YAML cannot represent the type."""
    arms, plain = members_of(hint), _plain(hint)
    if plain is not None:
        scalars = {item for arm in arms for item in (members_of(typing.get_args(arm)[0]) if _is_list(arm) else [arm])}
        as_tensor = Tensor in arms and not any(map(_is_list, arms))
        value = list(default) if isinstance(default, tuple) else default
        return Key(plain, value, per_trial={float, Tensor} <= scalars, as_tensor=as_tensor)
    classes: list[Any] = [arm for arm in arms if dataclasses.is_dataclass(arm)]
    if len(classes) > 1:
        inner, many = Catalogue("choice", "kind", classes), ""
    else:
        inner, many = next((found for found in map(_inner, arms) if found[0] is not None), (None, ""))
    if inner is None:
        return None
    kind = Any if isinstance(inner, Catalogue) and not many else dict[str, Any]
    kind = kind | None if None in (default, *(None for arm in arms if arm is not hint)) else kind
    return Key(kind, _described_default(default, inner, many), inner, many)


def _inner(hint: Any) -> tuple[Section | Catalogue | None, str]:
    """Section or catalogue of a type, and the kind of collection if the type is a collection of
    such objects.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return next(((extra, "") for extra in args[1:] if isinstance(extra, Catalogue)), (None, ""))
    if origin in (Mapping, dict) and args[0] is str:
        return _inner(args[1])[0], "mapping"
    if origin in (Sequence, list):
        return _inner(args[0])[0], "sequence"
    return (Section(hint), "") if hasattr(hint, "__dataclass_fields__") else (None, "")


def _described_default(default: Any, inner: Section | Catalogue, many: str) -> Any:
    if default is ... or default is None:
        return default
    if many:
        return {} if not default else None
    return inner.describe(default) if isinstance(inner, Catalogue) else _described(default)


def _described(value: Any) -> dict[str, Any]:
    """Fields of a dataclass object that YAML can represent."""
    found = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return {name: list(x) if isinstance(x, tuple) else x for name, x in found.items() if isinstance(x, _YAML)}


def _default(target: Callable[..., Any], parameter: inspect.Parameter) -> Any:
    """Default of a parameter, also if a field factory makes it; `...` if the parameter is
    required.
    """
    field = getattr(target, "__dataclass_fields__", {}).get(parameter.name)
    if field is not None and field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return ... if parameter.default is parameter.empty else parameter.default


def _is_list(hint: Any) -> bool:
    return typing.get_origin(hint) in (list, tuple, Sequence) and bool(typing.get_args(hint))


def _plain(hint: Any) -> Any | None:
    """Part of a type that YAML can represent; None if there is none. Tensors become numbers or
    lists of numbers.
    """
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if hint in _SCALARS or origin is typing.Literal:
        return hint
    if hint is Tensor:
        return list[float]
    if origin in (typing.Union, types.UnionType):
        arms = [arm for arm in args if not (arm is Tensor and float in args)]
        kept = [plain for plain in map(_plain, arms) if plain is not None]
        return typing.Union[tuple(kept)] if any(k is not type(None) for k in kept) else None  # noqa: UP007
    if _is_list(hint):
        item = _plain(args[0])
        return None if item is None else list[item]
    if origin in (dict, Mapping) and args and args[0] is str:
        item = _plain(args[1])
        return None if item is None else dict[str, item]
    return None


def _converted(value: Any, key: Key, given: Given) -> Any:
    """Convert a value for the constructor: a list becomes a tensor or a tuple, with values per
    trial.
    """
    if isinstance(value, list):
        value = [given.get(str(i), item) for i, item in enumerate(value)]
        return torch.tensor(value, dtype=torch.float64) if key.as_tensor else tuple(value)
    return value


def _is_index(text: str | None, value: Any) -> bool:
    return text is None or (text.isdecimal() and int(text) < len(value))


def snake(name: str) -> str:
    """Return the name of a class in snake case: `OmegaKStolt` gives `omega_k_stolt`."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


# keys, values, stages and kinds that were renamed; old names are accepted with a message
RENAMED = {
    "damages": "impairments",
    "told": "trigger_known",
    "published_ideal": "published.entropy_above_ideal_nats",
    "damaged": "impaired",
    **{
        key: f"objective.{key}" for key in ("order", "range_term", "yc_m", "variables", "oversampling", "lines", "taps")
    },
    "rotation_phase_fit": "coarse_rotation, fits: 4",
    "rotation_search": "entropy_rotation, method: grid",
    **{
        f"rotation_{name}": f"entropy_rotation, method: {name}"
        for name in ("genetic", "evolution", "newton", "descent")
    },
    **{
        f"{what}_{verb}": f"{verb}_{what}"
        for verb, whats in {
            "correct": ("imbalance", "response", "path", "pulse_phase", "migration"),
            "remove": ("synchronisation", "transmit_range"),
        }.items()
        for what in whats
    },
    **{f"interference_{verb}": f"{verb}_interference" for verb in ("subtract", "notch", "drop")},
    **{what: f"estimate_{what}" for what in ("imbalance", "response", "synchronisation")},
    "response_flat_band": "estimate_flat_response",
    "jitter_pilot": "pilot_jitter",
    "jitter_blind": "blind_jitter",
    "jitter_exact": "correct_jitter",
    "jitter_lagrange": "correct_jitter, method: {kind: lagrange, points: 4}",
    "jitter_band_limited": "correct_jitter, method: {kind: band_limited}",
    "channel_balance": "estimate_balance",
    "channel_balance_correct": "correct_balance",
    "rotation": "uneven_rotation",
    "rotation_coarse": "coarse_rotation",
    "rotation_entropy": "entropy_rotation",
    "rebuild_bands": "reconstruct",
    "intensity_ratio": "signal_intensity_ratio",
    "omega_k_padded": "padded_lines",
    "focus_target": "focus_azimuth",
    "dwell_s": "aperture.duration_s",
    "bands": "rebuild.bands",
    "u_r_reach_m_s": "search.u_r_m_s",
    "u_a_reach_m_s": "search.u_a_m_s",
    "y0_reach_m": "search.y0_m",
    "straight": "straight_path",
    "recorded": "recorded_path",
    "circular": "circular_path",
    "plane": "plane_ground",
    "normal": "start_phase",
    "uniform": "uniform_start_phase",
    "scintillation": "log_amplitude",
    "polynomial": "polynomial_sweep_error",
    "sinusoid": "sinusoid_sweep_error",
    "fibre": "calibration_fibre",
    "image": "image_sea",
    "exact": "exact_range",
    "taylor": "taylor_range",
    "clock_errors": "synchronisation_error",
    "channel_response": "smooth_response",
}


class Strict(BaseModel):
    """Base of all sections. It rejects unknown keys, wrong types and infinities."""

    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)


# Order in which errors are reported: an unknown key, a missing key, a wrong value. If both a number
# and a list are accepted, the error of the number is more informative.
_RANK = {"extra_forbidden": 0, "missing": 1, "list_type": 3}


def sentence(error: ValidationError, model: type[BaseModel], file: str, where: str = "") -> str:
    """Return one sentence about the most informative of the errors of a validation.

    Args:
        error: Error of pydantic.
        model: The model that was validated.
        file: Name of the config.
        where: Dotted path of the section that the model describes.

    Returns:
        The sentence, with file, key and value.
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
    if not key:  # the error concerns the whole config, not one key
        return f"{file}: {text}"
    shown = repr(given)
    if not text.startswith("should"):
        return f"{file}: key {key!r}: {text}"
    return f"{file}: key {key!r} has the value {shown if len(shown) < 80 else shown[:77] + '...'}; it {text}"


def _descend(model: type[BaseModel], path: list[str]) -> tuple[list[str], type[BaseModel] | None]:
    """Keys in a pydantic location, without tags of unions, and the section of the last key."""
    names: list[str] = []
    section, hint = None, model
    for part in path:
        members = members_of(hint)
        hint = members[0] if len(members) == 1 else hint
        if inspect.isclass(hint) and issubclass(hint, BaseModel):
            names.append(part)
            section, hint = hint, hint.model_fields[part].annotation if part in hint.model_fields else None
        elif typing.get_origin(hint) in (dict, list):
            names.append(part)
            hint = typing.get_args(hint)[-1]
    return names, section


def members_of(hint: Any) -> list[Any]:
    """Return the members of a union without None, or the type itself if it is no union."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return [member for member in typing.get_args(hint) if member is not type(None)]
    return [hint]
