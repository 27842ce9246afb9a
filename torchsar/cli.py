"""The command `torchsar`."""

from __future__ import annotations

import argparse
import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

EXIT_BAD_INPUT = 2


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(prog="torchsar", description="Synthetic aperture radar experiments from a config.")
    top.add_argument(
        "--threads",
        type=_positive,
        metavar="N",
        help="threads of torch (default: all cores; of a sweep, one in each process)",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in (
        ("run", "run an experiment and write its images, figures and report"),
        ("sweep", "run the Monte Carlo sweep of a config: many trials of every point of its grid"),
        ("requires", "what the scene of a config requires of its models"),
        ("trade", "speed against accuracy of the alternatives, beside the exact yardstick"),
    ):
        one = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        one.add_argument("config", help="a YAML file, or the name of a packaged config (see `torchsar list`)")
        one.add_argument(
            "overrides",
            nargs="*",
            metavar="key=value",
            help="overrides with dotted keys, such as world.noise.snr_db=10",
        )
        one.add_argument(
            "--out",
            type=Path,
            metavar="DIR",
            help="result folder" + (" (default: out/<config name>)" if name in ("run", "sweep") else ""),
        )
    sweep = commands.choices["sweep"]
    sweep.add_argument(
        "--resume", action="store_true", help="go on with the sweep in the folder; on an empty folder it simply starts"
    )
    sweep.add_argument(
        "--workers", type=_positive, metavar="N", help="compute in N processes of this machine (extra `cluster`)"
    )
    sweep.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="compute on the workers of a running dask scheduler, such as tcp://host:8786",
    )
    sweep.add_argument("--device", default="cpu", metavar="NAME", help="cpu (default), cuda, cuda:1, ...")
    commands.add_parser("list", help="experiments, stages and data keys")
    return top


def _positive(text: str) -> int:
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above 0")
    return int(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns 0, or 2 after one sentence on stderr for bad input, or 130 when interrupted.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parse(given)
    try:
        from torchsar.study.settings.errors import ConfigError
    except ImportError as error:
        return _fail(f"{error}; install the extra: pip install 'torchsar-lab[study]'")
    try:
        _log_to_stderr()
        with warnings.catch_warnings():
            warnings.showwarning = _show_warning
            return _dispatch(options, "torchsar " + shlex.join(given))
    except ImportError as error:
        # a fault of the program, not of the installation
        if (error.name or "").startswith("torchsar"):
            raise
        return _fail(f"{error.name or error} is not installed; install the extra: pip install 'torchsar-lab[study]'")
    except ConfigError as error:
        return _fail(str(error))
    except KeyboardInterrupt as stopped:
        print(f"torchsar: interrupted, {stopped if stopped.args else 'nothing was written'}", file=sys.stderr)
        return 130


def _parse(given: Sequence[str]) -> argparse.Namespace:
    """Overrides may stand before and after options; anything else that is left over is refused by
    argparse.
    """
    top = parser()
    options, rest = top.parse_known_args(given)
    if rest and (not hasattr(options, "overrides") or any(word.startswith("-") for word in rest)):
        top.error(f"unrecognized arguments: {' '.join(rest)}")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


def _dispatch(options: argparse.Namespace, command: str) -> int:
    from torchsar.study.config import load

    if options.threads is not None:
        import torch

        torch.set_num_threads(options.threads)
    if options.command == "list":
        from torchsar.study.listing import listing

        print(listing())
        return 0
    from torchsar.study.systems import system_of

    loaded = load(options.config, options.overrides)
    if options.command == "run":
        print(system_of(loaded).run(loaded, options.out or Path("out") / loaded.name, command))
    elif options.command == "sweep":
        from torchsar.study.sweeping import sweep_config

        print(
            sweep_config(
                loaded,
                options.out or Path("out") / loaded.name,
                options.resume,
                options.workers,
                options.cluster,
                options.threads or 1,
                options.device,
                command,
            )
        )
    elif options.command == "requires":
        print(system_of(loaded).requires(loaded, options.out))
    else:
        print(system_of(loaded).trade(loaded, options.out))
    return 0


def _fail(sentence: str) -> int:
    print(f"torchsar: {' '.join(sentence.split())}", file=sys.stderr)
    return EXIT_BAD_INPUT


def _log_to_stderr() -> None:
    from torchsar.study.settings.errors import ConfigError

    log = logging.getLogger("torchsar")
    if not log.handlers:
        handler = logging.StreamHandler()
        handler.setFormatter(logging.Formatter("torchsar: %(message)s"))
        log.addHandler(handler)
    level = os.environ.get("TORCHSAR_LOG", "INFO").upper()
    if level not in logging.getLevelNamesMapping():
        raise ConfigError(f"TORCHSAR_LOG={level} is no level of the log; choose DEBUG, INFO, WARNING or ERROR")
    log.setLevel(level)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """A Python warning as one line of the log, without the place in the code."""
    logging.getLogger("torchsar").warning("warning: %s", " ".join(str(message).split()))


if __name__ == "__main__":
    sys.exit(main())
