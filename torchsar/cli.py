"""Command line of the program `torchsar`."""

from __future__ import annotations

import _thread
import argparse
import logging
import os
import shlex
import sys
import textwrap
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from torchsar.spelling import entries_with
from torchsar.study.settings.errors import ConfigError

_MOST = 10_000  # limit for numbers of threads and processes, far above those of any machine
_LONGEST = 2000  # largest number of characters of a message; only a long path or value exceeds it
EXIT_BAD_INPUT = 2  # exit status that argparse uses for a rejected command line
_COMMANDS = {
    "run": "run an experiment and write its images, figures and report",
    "focus": "focus a recorded strip that is longer than memory, block by block",
    "sweep": "run the Monte Carlo sweep of a config: many trials of every point of its grid",
    "requires": "show the requirements of the scene of a config on models and methods",
    "trade": "measure the time and the loss of alternative methods, relative to an exact reference",
}
_BENCHES = ("autofocus", "alignment", "doppler", "velocity", "radial", "rotation", "repair", "channels", "path")
_EXCHANGE = {
    "import": "write recorded data of another format, which a sidecar describes, as a recording (.npz)",
    "export": "write the images of a finished run, or its recording, in another format",
}
_BENCH = "score methods, your own among them, on frozen scenes with known truth"
_REPRODUCE = "make the figures, tables and numbers of the papers, and compare them with what was published"


# commands that only print and do not compute on a device
_PRINTED = {
    "list": "experiments, systems, stages and data keys",
    "config": "print a packaged config, to begin one's own with, or the JSON schema of configs for editors",
    "completion": "print a script by which a shell completes the commands",
}


def parser() -> argparse.ArgumentParser:
    """Return the argument parser of the program `torchsar`.

    Returns:
        Parser of all commands and their options.
    """
    top = argparse.ArgumentParser(
        prog="torchsar", description="Simulate and process data of synthetic aperture radar and ladar."
    )
    top.add_argument("--version", action="store_true", help="print the version and end")
    top.add_argument(
        "--threads",
        type=_positive,
        metavar="N",
        help="threads of torch (default: all cores; one in a sweep's processes)",
    )
    commands = top.add_subparsers(dest="command", metavar="COMMAND")
    for name, text in _COMMANDS.items():
        one = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        chosen = one.add_argument("config", help="a YAML file, or the name of a packaged config (see `torchsar list`)")
        chosen.completer = _configs  # pyright: ignore[reportAttributeAccessIssue]
        one.add_argument(
            "overrides", nargs="*", default=[], metavar="key=value", help="overrides, such as world.noise.snr_db=10"
        )
        one.add_argument(
            "--out", type=_place, metavar="DIR", help=f"result folder (default: {_folder(name, 'CONFIG')})"
        )
        one.add_argument("--device", default="cpu", metavar="NAME", help="cpu (default), cuda, cuda:1, ...")
    sweep = commands.choices["sweep"]
    for one, what in ((sweep, "sweep"), (commands.choices["focus"], "image")):
        one.add_argument("--resume", action="store_true", help=f"go on with the {what} in the folder, if there is one")
    text = "go on although the code of torchsar, a file or a key differs; the report names it"
    sweep.add_argument("--allow-changed", action="store_true", help=text)
    sweep.add_argument("--workers", type=_positive, metavar="N", help="compute in N processes (extra `cluster`)")
    sweep.add_argument("--cluster", metavar="ADDRESS", help="compute on a running dask scheduler, tcp://host:8786")
    for name, text in _EXCHANGE.items():
        commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    one = commands.choices["import"]
    one.add_argument("file", metavar="FILE", help="HDF5, MATLAB, numpy or flat binary data")
    one.add_argument("--sidecar", required=True, metavar="YAML", help="its content, see torchsar.io.import_recording")
    one.add_argument("--out", type=_place, required=True, metavar="NPZ", help="new file for data.file of a config")
    one = commands.choices["export"]
    one.add_argument("file", metavar="RUN_DIR", help="the result folder of torchsar run or torchsar focus")
    one.add_argument("--to", choices=("netcdf", "sicd", "geotiff", "cphd"), required=True, help="the format")
    one.add_argument("--out", type=_place, required=True, metavar="DIR", help="folder of the new files")
    one.add_argument(
        "--origin",
        type=float,
        nargs=3,
        metavar=("LATITUDE", "LONGITUDE", "HEIGHT"),
        help="origin of local coordinates in degrees and metres, for recordings without `origin_deg_m`",
    )
    one = commands.add_parser("reproduce", help=_REPRODUCE, description=_REPRODUCE[0].upper() + _REPRODUCE[1:] + ".")
    one.add_argument("paper", nargs="?", metavar="PAPER", help="sal, geo, isal, isal_rotation or stripmap; all without")
    one.add_argument("item", nargs="?", metavar="ITEM", help="such as table2, figure5 or text1; all without")
    one.add_argument("--small", action="store_true", help="the reduced form, which takes minutes in all")
    one.add_argument(
        "--out", type=_place, default=Path("out") / "reproduce", metavar="DIR", help="folder of records and pictures"
    )
    one = commands.add_parser("bench", help=_BENCH, description=_BENCH[0].upper() + _BENCH[1:] + ".")
    one.add_argument("bench", metavar="BENCH", help=f"{', '.join(_BENCHES)}")
    text = "a built-in method, package.module:Name, a record FILE.json, or `recorded`; all built-in methods without"
    one.add_argument("methods", nargs="*", metavar="METHOD", help=text)
    one.add_argument("--small", action="store_true", help="every fourth world with 6 trials, in two minutes")
    one.add_argument("--trials", type=_positive, default=20, metavar="N", help="trials in a world (default: 20)")
    text = "trials in the row of a world in which a method was sure and wrong (default: as --trials)"
    one.add_argument("--most", type=_positive, default=0, metavar="N", help=text)
    one.add_argument(
        "--draw", type=int, default=0, metavar="N", help="other scenes than the frozen ones, N = 1, 2, ..."
    )
    text = "pulses of a recording in place of the scenes: entropy and agreement of phases, without a ranking"
    one.add_argument("--recorded", type=_place, metavar="FILE", help=text)
    text = "record (.json), table (.tex, .txt) or figure (.pdf, .png, .svg); may be repeated"
    one.add_argument("--out", type=_place, action="append", default=[], metavar="FILE", help=text)
    for name, text in _PRINTED.items():
        commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    words = "only entries that contain all these words, such as `torchsar list stripmap prf_hz`"
    commands.choices["list"].add_argument("words", nargs="*", metavar="WORD", help=words)
    commands.choices["list"].add_argument("--all", action="store_true", help="all entries with all their keys")
    one = commands.choices["config"]
    one.add_argument("what", choices=("show", "schema"), help="a packaged config, or the schema of all configs")
    chosen = one.add_argument("config", nargs="?", help="name of the packaged config (see `torchsar list`)")
    chosen.completer = _configs  # pyright: ignore[reportAttributeAccessIssue]
    commands.choices["completion"].add_argument("shell", choices=("bash", "zsh", "fish"), help="the shell")
    return top


def _configs(**_: object) -> list[str]:
    """Names of the packaged configs, which `argcomplete` suggests as arguments."""
    from torchsar.study.settings.text import packaged_configs

    return [*packaged_configs()]


def _folder(command: str, config: str) -> Path:
    """Default result folder of a command for a config."""
    return Path("out") / (config if command == "run" else f"{config}_{command}")


def _positive(text: str) -> int:
    if not (text.isdecimal() and len(text) <= 9 and 0 < int(text) <= _MOST):
        raise argparse.ArgumentTypeError(
            f"{textwrap.shorten(text, 50)!r} is not a whole number above 0, at most {_MOST}"
        )
    return int(text)


def _place(text: str) -> Path:
    if not text:  # empty, for instance from a shell variable that is not set
        raise argparse.ArgumentTypeError("the name of the folder is empty; '.' is the working folder")
    return Path(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command of the program `torchsar`.

    Args:
        arguments: Command line after the name of the program; by default that of this process.

    Returns:
        Exit status: 0 after success, 1 if stdout was closed, 2 if the input is invalid, or
        `requires` finds that `run` refuses it (a message on stderr says why), 130 if the user
        interrupted the command.
    """
    # the shell asks for completions of a word; the program then ends
    if "_ARGCOMPLETE" in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser())
    given = list(sys.argv[1:] if arguments is None else arguments)
    wrong = next((word for word in given if not _is_text(word)), None)
    if wrong is not None:
        return _fail(f"the argument {wrong!r} has characters that are no text; rename the file or folder, or retype it")
    options = _parse(given)
    # OpenMP threads that wait actively slow down the working ones; torch reads the variable when it
    # is imported
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        if options.version:
            from importlib.metadata import version

            print(f"torchsar-lab {version('torchsar-lab')}", flush=True)
            return 0
        if options.command in ("reproduce", "bench"):
            subject = options.bench if options.command == "bench" else options.paper or "all papers"
            print(f"torchsar: {options.command} {subject}", file=sys.stderr, flush=True)
        # checked before the import of torch, which takes seconds
        elif options.command not in _PRINTED:
            subject = options.file if options.command in _EXCHANGE else options.config
            print(f"torchsar: {options.command} {subject}", file=sys.stderr, flush=True)
        with _log_to_stderr(), warnings.catch_warnings(), _short_memory(), _interrupts_kept():
            warnings.showwarning = _show_warning
            status = _dispatch(options, "torchsar " + shlex.join(given))
            sys.stdout.flush()
            return status
    except ImportError as error:
        # an error of the program, not of the installation
        if (error.name or "").startswith("torchsar"):
            raise
        if "torchsar-lab[" in str(error):  # the message names the missing extra
            return _fail(str(error))
        return _fail(f"{error.name or error} is not installed; install the extra: pip install 'torchsar-lab[study]'")
    except ConfigError as error:
        return _fail(str(error))
    except MemoryError as error:
        return _fail(f"{error}; make the scene smaller, or take a larger machine")
    except BrokenPipeError:  # the program that reads stdout, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        return _fail(f"{error}; make room, or mend the file or folder")
    except KeyboardInterrupt as stopped:
        print(f"torchsar: interrupted, {stopped if stopped.args else 'nothing was written'}", file=sys.stderr)
        return 130


def _is_text(word: str) -> bool:
    """True if a word can be printed and can be a file name: valid UTF-8 without NUL."""
    try:
        return "\0" not in word and bool(word.encode() or True)
    except UnicodeEncodeError:
        return False


def _parse(given: Sequence[str]) -> argparse.Namespace:
    """Parse the command line; overrides may be written before and after options."""
    top = parser()
    options, rest = top.parse_known_args(given)
    if rest and (not hasattr(options, "overrides") or any(word.startswith("-") for word in rest)):
        top.error(f"unrecognized arguments: {' '.join(rest)}")
    if options.command is None and not options.version:
        names = (*_COMMANDS, *_EXCHANGE, "bench", "reproduce", *_PRINTED)
        top.error(f"a command is missing: choose one of {', '.join(names)}")
    if options.command == "config" and (options.what == "show") == (options.config is None):
        top.error("`torchsar config show` needs the name of a config, and `torchsar config schema` takes none")
    if rest:
        options.overrides = [*options.overrides, *rest]
    return options


def _dispatch(options: argparse.Namespace, command: str) -> int:
    from torchsar.study.settings.text import find_config

    actions = {"import": _import, "export": _export, "reproduce": _reproduce, "bench": _bench}
    if options.command in actions:
        try:
            return actions[options.command](options)
        except (ValueError, FileNotFoundError, FileExistsError) as error:
            raise ConfigError(str(error)) from error
    if options.command in _PRINTED:
        return _print(options)
    find_config(options.config)  # detects an unknown name before the import of torch
    import torch

    from torchsar.core import device_fault
    from torchsar.study.memory import keep_freed_memory
    from torchsar.study.table import load

    # not for `focus`, whose blocks are too large for memory that is kept for reuse
    if options.command != "focus":
        keep_freed_memory()
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    reason = device_fault(options.device)
    if reason:
        raise ConfigError(f"--device {options.device} cannot be used here: {reason}; leave it out to use the CPU")
    loaded = load(options.config, options.overrides)
    out = options.out or _folder(options.command, loaded.name)
    if options.command == "run":
        from torchsar.study.commands.run import run

        print(run(loaded, out, command, options.device))
    elif options.command == "focus":
        from torchsar.strips import focus_recording

        try:
            print(focus_recording(loaded, out, options.resume, options.device))
        except ValueError as error:
            raise ConfigError(str(error)) from error
    elif options.command == "sweep":
        from torchsar.study.commands.sweep import sweep

        if torch.device(options.device).type != "cpu" and not options.workers and not options.cluster:
            drawn = "" if loaded.config.random != "numpy" else ", and draw the random numbers there with random=torch"
            logging.getLogger("torchsar").info(
                "one process keeps %s busy only in part; let several share it with --workers 6%s", options.device, drawn
            )
        engine = (options.resume, options.workers, options.cluster, options.threads or 1, options.device)
        print(sweep(loaded, out, *engine, command, options.allow_changed))
    else:
        from torchsar.study.commands.requires import requires
        from torchsar.study.commands.trade import trade

        asks = options.command == "requires"
        text, refused = requires(loaded, out, options.device) if asks else (trade(loaded, out, options.device), "")
        print(text, out, sep="\n", flush=True)
        if refused:
            raise ConfigError(refused)
    return 0


def _print(options: argparse.Namespace) -> int:
    from torchsar.study.settings.text import experiments, find_config

    if options.command == "completion":
        import argcomplete

        print(argcomplete.shellcode(["torchsar"], shell=options.shell))  # pyright: ignore[reportPrivateImportUsage]
        return 0
    if options.command == "config" and options.config is not None:
        print(find_config(options.config).read_text(encoding="utf-8").replace("=../schema", "=schema"), end="")
        return 0
    if options.command == "list":
        names = entries_with(options.words, experiments())
        print(names, end="\n" if names else "", flush=True)  # printed before the import of torch
    from torchsar.study.table import systems

    if options.command == "list":
        from torchsar.study.commands.listing import listing, overview

        brief = not options.words and not options.all
        others = overview(systems) if brief else entries_with(options.words, listing(systems))
        if not names and not others:
            raise ConfigError(f"no entry of `torchsar list` contains {' and '.join(map(repr, options.words))}")
        print(others, end="\n" if others else "")
    else:
        from torchsar.schema import config_schema, schema_text

        print(schema_text(config_schema(systems)), end="")
    return 0


def _import(options: argparse.Namespace) -> int:
    from torchsar.study.settings.text import read_tree

    sidecar = read_tree(Path(options.sidecar))  # read before the import of torch
    from torchsar.io import import_recording

    print(import_recording(options.file, sidecar, options.out, options.sidecar))
    return 0


def _export(options: argparse.Namespace) -> int:
    config, strip = (Path(options.file) / name for name in ("config.yaml", "image.zarr"))
    if strip.is_dir():
        from torchsar.strips import export_strip

        export_strip(strip, options.to, options.out)
        print(options.out)
        return 0
    if not config.is_file():
        raise ConfigError(f"{config} does not exist; give the folder of the result of torchsar run")
    from torchsar.radar import LocalFrame
    from torchsar.study.commands.export import export
    from torchsar.study.table import load

    origin = None if options.origin is None else LocalFrame(*options.origin)
    export(Path(options.file), load(config), options.to, options.out, origin)
    print(options.out)
    return 0


def _reproduce(options: argparse.Namespace) -> int:
    import torch

    from torchsar.reproduce import reproduce
    from torchsar.study.memory import keep_freed_memory

    keep_freed_memory()
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    print(reproduce(options.paper, options.item, options.out, options.small))
    return 0


def _bench(options: argparse.Namespace) -> int:
    import torch

    from torchsar.study.bench.blocks import remarks
    from torchsar.study.bench.entrant import MethodError
    from torchsar.study.bench.records import methods_of, read, recorded, same_scenes, score, together
    from torchsar.study.bench.show import new_files, save, table
    from torchsar.study.memory import keep_freed_memory
    from torchsar.study.output.progress import told

    keep_freed_memory()
    if options.threads is not None:
        torch.set_num_threads(options.threads)
    new_files(options.out)
    methods, files = methods_of(options.methods)
    if options.recorded and (options.bench != "autofocus" or files or options.out):
        raise ConfigError("--recorded takes `torchsar bench autofocus` and methods, no records and no --out")
    records = [recorded(options.bench) if file == "recorded" else read(Path(file)) for file in files]
    chosen = {"trials": options.trials, "most": options.most, "small": options.small, "draw": options.draw}
    runs = bool(methods or not files)
    this = {"this run": {"bench": options.bench, **chosen}} if runs else {}
    same_scenes({**dict(zip(files, records, strict=True)), **this})
    try:
        if options.recorded:
            print(remarks(options.recorded, methods or None))
            return 0
        if runs:
            records.append(score(options.bench, methods or None, **chosen, say=told("worlds")))
    except MethodError as error:
        raise ConfigError(str(error)) from error
    record = together(records)
    print(table(record))
    save(record, options.out)
    return 0


def _fail(sentence: str) -> int:
    text = " ".join(sentence.split())
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    print(f"torchsar: {text}", file=sys.stderr)
    return EXIT_BAD_INPUT


@contextmanager
def _short_memory() -> Iterator[None]:
    """Raise a MemoryError instead of the errors that torch raises if memory is insufficient."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        from torchsar.core import is_out_of_memory

        if not is_out_of_memory(error):
            raise
        raise MemoryError(
            f"memory is too short ({str(error).splitlines()[0] if str(error) else 'no message'})"
        ) from error


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Repeat an interrupt (Ctrl-C) that Python has ignored.

    Python ignores every exception in a callback of the garbage collector or of an import.
    """
    earlier, again = sys.unraisablehook, list[threading.Timer]()

    def hook(dropped: sys.UnraisableHookArgs) -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            return earlier(dropped)
        again.append(threading.Timer(0.1, _thread.interrupt_main))
        again[-1].start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = earlier
        for timer in again:
            timer.cancel()


@contextmanager
def _log_to_stderr() -> Iterator[None]:
    """Write the log of the program to stderr, each warning only once."""
    level = os.environ.get("TORCHSAR_LOG", "INFO").upper()
    if level not in logging.getLevelNamesMapping():
        raise ConfigError(
            f"the environment variable TORCHSAR_LOG={level} is no log level; choose DEBUG, INFO, WARNING or ERROR"
        )
    log, handler, shown = logging.getLogger("torchsar"), logging.StreamHandler(), set[str]()

    def is_new(record: logging.LogRecord) -> bool:
        text, known = record.getMessage(), len(shown)
        if record.levelno >= logging.WARNING:
            shown.add(text)
        return record.levelno < logging.WARNING or len(shown) > known

    handler.setFormatter(logging.Formatter("torchsar: %(message)s"))
    handler.addFilter(is_new)
    log.setLevel(level)
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Write a Python warning as one line of the log, without its position in the code."""
    logging.getLogger("torchsar").warning("warning: %s", " ".join(str(message).split()))
