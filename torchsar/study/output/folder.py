"""Result folders, each with one result and possibly other files of the user.

A result folder has a directory `.torchsar` with a lock, the manifest of the files that the program
wrote, and, while a command runs, its incomplete result. The program replaces and removes only files
of the manifest that were not changed since. A complete result is moved to its final path; if the
move is interrupted or fails, the next command completes it according to a journal.
"""

from __future__ import annotations

import itertools
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar.study.output.own_files import OwnFiles, remove_empty
from torchsar.study.settings.errors import ConfigError

try:
    import fcntl
except ImportError:  # not available on every operating system; there is then no lock
    fcntl = None

log = logging.getLogger("torchsar")
STATE = ".torchsar"
# files whose presence means that a result is complete: they are removed first and moved last
_LAST = ("report.html", "metrics.json", "summary.json", "trade.json", "requires.json")


@dataclass(frozen=True)
class ResultFolder:
    """A result folder that is locked for this process; see `opened`.

    Args:
        path: The folder.
        kind: The command of its result: run, sweep, trade or requires.
    """

    path: Path
    kind: str

    @property
    def files(self) -> OwnFiles:
        """The files that the program wrote."""
        return OwnFiles(self.path, self.path / STATE, _LAST)

    @contextmanager
    def staged(self) -> Iterator[Path]:
        """Provide an empty folder for a new result.

        Its content replaces the earlier result at the end of the block, and is removed if the block
        raises an error. A complete result is never removed: if it cannot replace the earlier one,
        it is kept in a new folder or, if the replacement had begun, completed by the next command.

        Raises:
            ConfigError: If the result cannot replace the earlier one, for example because a file of
                the user has the path of one of its files; the message says where it is.
        """
        new = self.files.new
        new.mkdir()
        try:
            yield new
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        self._publish(new)

    @property
    def claimed(self) -> bool:
        """Whether the folder is reserved for, or holds, a result of this kind."""
        return self.files.manifest()["kind"] == self.kind

    def claim(self) -> None:
        """Reserve the folder for a result of this kind."""
        self.files.claim(self.kind)

    def refuse_conflicts(self, names: Sequence[str]) -> None:
        """Check that no file of the user has the name of a file of the result.

        Args:
            names: Files and folders of the result, directly below the result folder.

        Raises:
            ConfigError: If there is such a file, or the result of another command.
        """
        kind = self.files.manifest()["kind"]
        if kind not in (None, self.kind):
            raise ConfigError(f"--out {self.path} holds the result of another command, {kind}; choose another folder")
        name = self.files.foreign(names)
        if name:
            raise ConfigError(
                f"--out {self.path}: torchsar did not write {name}, or it was changed since; move it, or choose "
                "another folder"
            )

    def finish(self) -> None:
        """Complete an interrupted replacement."""
        for name in self.files.finish():
            _say_kept(self.path, name)

    def _publish(self, new: Path) -> None:
        try:
            self.refuse_conflicts(sorted(path.name for path in new.iterdir()))
            for name in self.files.replace(self.kind):
                _say_kept(self.path, name)
        except (ValueError, OSError) as error:
            why = getattr(error, "strerror", None)
            text = f"--out {self.path}: the result could not be moved to its place ({why})" if why else str(error)
            if self.files.pending:
                raise ConfigError(f"{text}; the next command with this folder completes the move") from error
            places = (self.path / f"kept-{i}" for i in itertools.count(1))
            kept = new.rename(next(path for path in places if not os.path.lexists(path)))
            raise ConfigError(f"{text}; this result was kept in {kept}") from error


def _say_kept(out: Path, name: str) -> None:
    log.warning("warning: %s: %s is a file of the user and was kept; the new one was removed", out, name)


@contextmanager
def opened(out: Path, kind: str, names: Sequence[str] = ()) -> Iterator[ResultFolder]:
    """Lock a result folder for this process, and make it if it does not exist.

    An interrupted move of an earlier command is completed first. If nothing is written, folders
    that were made are removed again.

    Args:
        out: The folder.
        kind: Command of the result: run, sweep, trade or requires.
        names: Files and folders of the result, directly below `out`.

    Raises:
        ConfigError: If the folder cannot be written, another command is writing to it, it has the
            result of another command, or a file of the user has one of the names.
    """
    made = [folder for folder in (out, *out.parents) if not os.path.exists(folder)]
    with _locked(out):
        try:
            folder = ResultFolder(out, kind)
            try:
                folder.finish()
                folder.refuse_conflicts(names)
            except ValueError as error:  # a manifest or a journal that is damaged
                raise ConfigError(str(error)) from None
            yield folder
        finally:
            _tidy(out, made)


@contextmanager
def fresh_result(out: Path, kind: str, names: Sequence[str]) -> Iterator[Path]:
    """Provide an empty folder, whose content becomes the result in `out` at the end of the block.

    See `opened` and `ResultFolder.staged`.
    """
    try:
        with opened(out, kind, names) as folder, folder.staged() as new:
            yield new
    except BrokenPipeError:  # of stdout, not of the folder
        raise
    except OSError as error:
        raise ConfigError(
            f"--out {out}: the result cannot be written ({error.strerror or error}); make room, or choose another "
            "folder"
        ) from error


def _locked(out: Path) -> Any:
    """The locked file of a result folder; the operating system releases it with the process."""
    state = out / STATE
    for attempts_left in reversed(range(10_000)):
        try:
            state.mkdir(parents=True, exist_ok=True)
            if any(state.iterdir()) and not (state / "lock").is_file():
                raise ConfigError(f"--out {out}: {state} was not made by torchsar; move it, or choose another folder")
            file = (state / "lock").open("a")
        except (OSError, ValueError) as error:
            if isinstance(error, FileNotFoundError) and attempts_left:
                continue  # another command may just have removed the empty folder
            raise ConfigError(f"--out {str(out)!r} cannot be written: {error}; choose another folder") from None
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(file.fileno()), (state / "lock").stat()):
                return file
        except FileNotFoundError:
            pass
        except OSError:
            file.close()
            raise ConfigError(
                f"--out {out}: another torchsar command is writing there; wait for its end, or choose another folder"
            ) from None
        file.close()


def _tidy(out: Path, made: Sequence[Path]) -> None:
    """Remove a state directory with only the lock, and then those of `made` that are empty."""
    state = out / STATE
    if {path.name for path in state.iterdir()} <= {"lock"}:
        shutil.rmtree(state, ignore_errors=True)
        remove_empty(made)
