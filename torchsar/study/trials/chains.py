"""Chains of stages from a checked config."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.core import Chain, use
from torchsar.study.settings.errors import ConfigError, did_you_mean, one_line
from torchsar.study.settings.sections import OF_CHAIN, Loaded, Method

# prefix of true values in a config, and prefix of input values in a chain
_TRUTH, _GIVEN = "truth.", "given."


def build_chains(loaded: Loaded, **context: Any) -> dict[str, Chain]:
    """Build the chain of every method.

    Args:
        loaded: The config.
        context: Parameters of constructors that are not keys of the config, such as `radar`.

    Returns:
        Chains by method; a rerun has the chain of the method that it repeats.

    Raises:
        ConfigError: If a key, a connection of stages or a value given to a rerun is not accepted.
    """
    chains: dict[str, Chain] = {}
    for name, method in loaded.config.processor.items():
        where = f"{loaded.file}: processor.{name}"
        if method.rerun is None:
            chains[name] = _chain(loaded, method, f"processor.{name}", context)
        else:
            chains[name] = chains[method.rerun.method]
            offered = {
                f"{n}.{key}" for n, stage in chains[name].stages.items() for key in getattr(stage, "provides", ())
            }
            unknown = next((value for value in method.rerun.given if value not in offered), None)
            if unknown is not None:
                raise ConfigError(
                    f"{where}.rerun.given.{unknown} does not name an estimate (STAGE.NAME) that the method "
                    f"{method.rerun.method!r} makes"
                    f"{did_you_mean(unknown, offered)}"
                )
    return chains


def true_names(chain: Chain) -> set[str]:
    """Return the names of the true values that a chain uses."""
    sources = {source for uses in chain.uses.values() for source in uses.values()}
    return {source.removeprefix(_GIVEN) for source in sources if source.startswith(_GIVEN)}


def _chain(loaded: Loaded, method: Method, where: str, context: Mapping[str, Any]) -> Chain:
    built = {}
    for name, entry in (method.stages or {}).items():
        path = f"{where}.stages.{name}"
        if not name.isidentifier():
            raise ConfigError(
                f"{loaded.file}: {path}: a stage name has only letters, digits and '_', and does not begin with a digit"
            )
        rest = {key: value for key, value in entry.items() if key not in OF_CHAIN}
        try:
            stage = loaded.system.stages.make(rest, path, loaded.file, **context)
        except AttributeError as error:
            raise ConfigError(f"{loaded.file}: {path}: {unknown_attribute(error, context)}") from None
        built[name] = use(
            stage,
            in_doubt=entry.get("in_doubt", "neutral"),
            **_sources(entry.get("uses", {}), method, loaded, path),
        )
    try:
        return Chain(**built)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{loaded.file}: {where}: {one_line(error)}") from None


def _sources(uses: Mapping[str, str], method: Method, loaded: Loaded, where: str) -> dict[str, str]:
    """The sources of the values of a stage; only an oracle may use true values."""
    found = {}
    for key, source in uses.items():
        true, name = source.startswith(_TRUTH), source.removeprefix(_TRUTH)
        if true and not method.oracle:
            raise ConfigError(
                f"{loaded.file}: {where}.uses.{key}: {source} is a true value; set 'oracle: true' for the method if it "
                "shall show the best possible result"
            )
        if true and name not in loaded.system.truths:
            raise ConfigError(
                f"{loaded.file}: {where}.uses.{key}: {source} does not exist{did_you_mean(name, loaded.system.truths)}"
            )
        found[key] = f"{_GIVEN}{name}" if true else source
    return found


def unknown_attribute(error: AttributeError, context: Mapping[str, Any]) -> str:
    """Return the message about a stage that needs an attribute which the radar does not have.

    Args:
        error: The error of the stage. Any other AttributeError is a fault of the program and is
            raised again.
        context: Parameters of the constructor of the stage, with `radar`.

    Returns:
        The message.
    """
    if error.obj is not context.get("radar") or error.obj is None:
        raise error
    return (
        f"this stage needs radar.{error.name}, which a radar of this system does not have; use a stage of this system"
    )
