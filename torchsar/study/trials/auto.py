"""Keys with the value `auto` get the cheapest alternative with an acceptable predicted loss, or the
most exact one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import Config, Loaded
from torchsar.study.settings.signature import AUTO
from torchsar.study.trials.choice import Alternative, Choice


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
