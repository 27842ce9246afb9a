"""Choices that a config makes, such as the form of the focusing, and their alternatives, of which
`auto` takes the cheapest one with an acceptable predicted loss, or the most exact one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import Config, Loaded
from torchsar.study.settings.signature import AUTO
from torchsar.study.trials.direct_images import DirectlySummed


@dataclass(frozen=True)
class Alternative:
    """One alternative of a choice.

    Args:
        name: Name in tables.
        keys: Keys and values that select it in the mapping of the choice.
        loss: Predicted loss by metric; None if there is no prediction.
        neglects: Description of the effects that the alternative neglects.
        effect: Field `effect` of the `Requirement` about the same simplification; empty if there is
            none. The verdict of that requirement then follows from `loss`.
    """

    name: str
    keys: Mapping[str, Any] = field(default_factory=dict)
    loss: Mapping[str, float] | None = None
    neglects: str = ""
    effect: str = ""


# lower levels are differences by rounding in double precision
EXACT_DB = -280.0


@dataclass(frozen=True)
class Measured:
    """Measurement of the time and the loss of alternatives.

    Args:
        run: Function of an alternative that computes its result, and whose time is measured.
        loss: Function of an alternative and its result that returns the loss by metric, relative to
            an exact result.
        share: Function of an alternative that returns which part of the whole work `run` does,
            between 0 and 1; measured times are divided by it.
    """

    run: Callable[[Alternative], Any]
    loss: Callable[[Alternative, Any], Mapping[str, float]]
    share: Callable[[Alternative], float] = lambda alternative: 1.0


@dataclass(frozen=True)
class Choice:
    """A choice that a config makes, with its alternatives from the cheapest to the exact one.

    Args:
        name: Name in tables.
        at: The key that may have the value `auto`: a dotted key of the world such as
            `world.fidelity`, `stage`, or `STAGE.key` for a key of all stages of that name.
        alternatives: The alternatives, the cheapest first and the most exact one last.
        measured: Function that prepares the measurement of the alternatives, which may take long;
            None if they cannot be measured.
        yardstick: Exact alternative to which losses are relative, if it is not the last one of
            `alternatives`; None otherwise.
    """

    name: str
    at: str
    alternatives: Sequence[Alternative]
    measured: Callable[[], Measured] | None = None
    yardstick: Alternative | None = None


def beside_direct_sum(prepared: Callable[[], DirectlySummed], neglects: str) -> Choice:
    """Return the comparison of the recommended image with the direct sum at random pixels.

    Args:
        prepared: Function that prepares the image.
        neglects: What the recommended image neglects.
    """

    def measured() -> Measured:
        of = prepared()
        return Measured(
            lambda one: of.exact() if one.keys else of.image(),
            lambda one, made: {"image_error_db": of.error_db(made if one.keys else of.at(made))},
            lambda one: of.share if one.keys else 1.0,
        )

    return Choice(
        "image beside the direct sum",
        "image",
        [
            Alternative("recommended image", {}, None, neglects),
            Alternative("direct sum, times extrapolated from random pixels", {"exact": True}),
        ],
        measured,
    )


def tolerance_of(loaded: Loaded) -> dict[str, float]:
    """Return the largest acceptable loss of each metric, by the config or else by the system."""
    unknown = next((name for name in loaded.config.trade.tolerance if name not in loaded.system.tolerance), None)
    if unknown is not None:
        known = ", ".join(loaded.system.tolerance)
        raise ConfigError(
            f"{loaded.file}: trade.tolerance names {unknown!r}, which is no loss of this system (losses: {known})"
        )
    return {**loaded.system.tolerance, **loaded.config.trade.tolerance}


def within(loss: Mapping[str, float] | None, tolerance: Mapping[str, float]) -> bool:
    """Return whether the losses are known and within their tolerances; NaN is not within any."""
    return loss is not None and all(value <= tolerance[name] for name, value in loss.items() if name in tolerance)


def cheapest(choice: Choice, tolerance: Mapping[str, float]) -> Alternative:
    """Return the first alternative with an acceptable predicted loss, or else the last one."""
    kept = [one for one in choice.alternatives if one.loss is not None and within(one.loss, tolerance)]
    return kept[0] if kept else choice.alternatives[-1]


def choices_of(bench: Any) -> Sequence[Choice]:
    """Return the choices between alternatives that a config has.

    Raises:
        ConfigError: If the losses of the alternatives cannot be predicted.
    """
    try:
        return bench.system.choices(bench)
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{bench.file}: {one_line(error)}") from None


def resolved(loaded: Loaded, bench_of: Callable[[Loaded], Any]) -> tuple[Loaded, tuple[str, ...]]:
    """Replace every `auto` of a config by the cheapest alternative with a predicted loss within the
    tolerance, or by the most exact one where there is none.

    Args:
        loaded: The config.
        bench_of: Function that prepares a config without `auto` for simulation and processing, see
            `Bench`.

    Returns:
        The config without `auto`, and a sentence about each replacement with its reason.

    Raises:
        ConfigError: If the system has no alternatives for a key with the value `auto`.
    """
    found = list(_automatic(loaded.config, loaded.system.stages.automatic))
    if not found:
        return loaded, ()
    exact = loaded.system.exact
    unknown = next((path for at, path, _ in found if at not in exact), None)
    if unknown is not None:
        raise ConfigError(
            f"{loaded.file}: {unknown} is 'auto', but this system accepts 'auto' only for "
            f"{', '.join(exact) or 'no key'}"
        )
    bench = bench_of(loaded.changed({path: {**entry, **exact[at]} for at, path, entry in found}, "auto"))
    choices = {choice.at: choice for choice in choices_of(bench)}
    fixed = next((path for at, path, _ in found if at not in choices), None)
    if fixed is not None:
        raise ConfigError(f"{loaded.file}: {fixed} is 'auto', but this config has no alternatives for it; give a value")
    tolerance, changes, reasons = tolerance_of(loaded), {}, []
    for at, path, entry in found:
        taken = cheapest(choices[at], tolerance)
        changes[path] = {**entry, **taken.keys}
        why = ", ".join(
            f"{name} {value:.3g} (at most {tolerance[name]:g})" for name, value in (taken.loss or {}).items()
        )
        best = "the cheapest with an acceptable" if within(taken.loss, tolerance) else "the most exact, with a"
        reasons.append(f"{path}: {taken.name} was chosen, {best} predicted loss: {why or 'exact'}")
    return loaded.changed(changes, "auto"), tuple(reasons)


def _automatic(config: Config, keys: Collection[str]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Every `auto`: the key of its choice (`Choice.at`), the path of its mapping, the mapping.

    keys: "STAGE.KEY" of the keys that may be left to choose; other keys may have such a value too.
    """
    for key, value in (config.world or {}).items():
        if isinstance(value, Mapping) and value.get("kind") == AUTO:
            yield f"world.{key}", f"world.{key}", value
    for name, method in config.processor.items():
        for stage, entry in (method.stages or {}).items():
            path = f"processor.{name}.stages.{stage}"
            if entry["stage"] == AUTO:
                yield "stage", path, entry
            for key in (key for key, value in entry.items() if value == AUTO and key != "stage"):
                if f"{entry['stage']}.{key}" in keys:
                    yield f"{entry['stage']}.{key}", path, entry
