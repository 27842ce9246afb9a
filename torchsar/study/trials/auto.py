"""Choices that a config leaves open: the cheapest with an acceptable predicted loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from torchsar.study.settings.errors import ConfigError, one_line
from torchsar.study.settings.sections import Config, Loaded
from torchsar.study.settings.signature import AUTO
from torchsar.study.trials.choice import Alternative, Choice


def tolerance_of(loaded: Loaded) -> dict[str, float]:
    """Largest acceptable loss by metric: the system's own, and what the config says."""
    unknown = next((name for name in loaded.config.trade.tolerance if name not in loaded.system.tolerance), None)
    if unknown is not None:
        known = ", ".join(loaded.system.tolerance)
        raise ConfigError(f"{loaded.file}: trade.tolerance names {unknown!r}, which is no loss here; there is {known}")
    return {**loaded.system.tolerance, **loaded.config.trade.tolerance}


def within(loss: Mapping[str, float] | None, tolerance: Mapping[str, float]) -> bool:
    """Whether every loss is known and acceptable; one that is not a number is not."""
    return loss is not None and all(value <= tolerance[name] for name, value in loss.items() if name in tolerance)


def cheapest(choice: Choice, tolerance: Mapping[str, float]) -> Alternative:
    """The first alternative whose predicted loss is acceptable, else the exact one."""
    kept = [one for one in choice.alternatives if one.loss is not None and within(one.loss, tolerance)]
    return kept[0] if kept else choice.alternatives[-1]


def choices_of(bench: Any) -> Sequence[Choice]:
    """The decisions of a config. Raises ConfigError where nothing can be predicted for it."""
    try:
        return bench.system.choices(bench)
    except ConfigError:
        raise
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{bench.file}: {one_line(error)}") from None


def resolved(loaded: Loaded, bench_of: Callable[[Loaded], Any]) -> tuple[Loaded, tuple[str, ...]]:
    """The config with every `auto` settled, and what was taken and why, in sentences.

    Args:
        loaded: The config.
        bench_of: Builds the bench of a config without `auto`.

    Raises:
        ConfigError: If `auto` stands where the system has nothing to choose.
    """
    places = list(_places(loaded.config))
    if not places:
        return loaded, ()
    exact = loaded.system.exact
    unknown = next((path for at, path, _ in places if at not in exact), None)
    if unknown is not None:
        raise ConfigError(
            f"{loaded.file}: {unknown} is 'auto', and this system chooses nothing there; it does at "
            f"{', '.join(exact) or 'no key'}"
        )
    bench = bench_of(loaded.changed({path: {**entry, **exact[at]} for at, path, entry in places}, "auto"))
    choices = {choice.at: choice for choice in choices_of(bench)}
    tolerance, changes, said = tolerance_of(loaded), {}, []
    for at, path, entry in places:
        taken = cheapest(choices[at], tolerance)
        changes[path] = {**entry, **taken.keys}
        why = ", ".join(
            f"{name} {value:.3g} (at most {tolerance[name]:g})" for name, value in (taken.loss or {}).items()
        )
        said.append(f"{path}: {taken.name} was taken, the cheapest with an acceptable predicted loss: {why or 'exact'}")
    return loaded.changed(changes, "auto"), tuple(said)


def _places(config: Config) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """What each `auto` is about, the dotted path of the mapping that holds it, and the mapping."""
    for key, value in (config.world or {}).items():
        if isinstance(value, Mapping) and value.get("kind") == AUTO:
            yield f"world.{key}", f"world.{key}", value
    for name, method in config.processor.items():
        for stage, entry in (method.stages or {}).items():
            path = f"processor.{name}.stages.{stage}"
            if entry["stage"] == AUTO:
                yield "stage", path, entry
            for key in (key for key, value in entry.items() if value == AUTO and key != "stage"):
                yield f"{entry['stage']}.{key}", path, entry
