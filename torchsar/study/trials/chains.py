"""Chains of stages from a checked config."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchsar.core import Chain, use
from torchsar.study.settings.errors import ConfigError, did_you_mean, one_line
from torchsar.study.settings.sections import LONGEST_NAME, OF_CHAIN, Loaded, Method

# errors whose text says what is wrong; torch itself raises RuntimeError
_PLAIN = (ValueError, TypeError, KeyError, RuntimeError)
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
        if not name.isidentifier() or len(name) > LONGEST_NAME:
            raise ConfigError(
                f"{loaded.file}: {path}: a stage name has only letters, digits and '_', does not begin with a digit, "
                f"and has {LONGEST_NAME} characters at most"
            )
        rest = {key: value for key, value in entry.items() if key not in OF_CHAIN}
        try:
            stage = loaded.system.stages.make(rest, path, loaded.file, **context)
        except ConfigError:
            raise
        except Exception as error:  # a stage of the user may raise any error
            raise ConfigError(f"{loaded.file}: {path}: {reason_of(error, context.get('radar'))}") from error
        built[name] = use(
            stage,
            in_doubt=entry.get("in_doubt", "apply"),
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


def reason_of(error: Exception, radar: Any) -> str:
    """Return the reason why a stage failed.

    Args:
        error: The error of the stage.
        radar: The radar that it was given.

    Returns:
        The text of the error in one line, with its kind where the text alone may say too little.
    """
    if isinstance(missing := error.__cause__ or error, AttributeError) and radar is not None and missing.obj is radar:
        return (
            f"this stage needs radar.{missing.name}, which a radar of this system does not have; use a stage of this "
            "system"
        )
    return ("" if isinstance(error, _PLAIN) and one_line(error) else f"{type(error).__name__}: ") + (
        one_line(error) or "no message"
    )
