"""Result folders, each with one result and possibly other files of the user.

A result folder has a directory `.torchsar` with a lock, the manifest of the files that the program
wrote, and, while a command runs, its incomplete result. The program replaces and removes only files
of the manifest that were not changed since. A complete result is moved to its final path; if the
move is interrupted, the next command completes it according to a journal.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar.study.settings.errors import ConfigError

try:
    import fcntl
except ImportError:  # not available on every operating system; there is then no lock
    fcntl = None

log = logging.getLogger("torchsar")
STATE = ".torchsar"
# larger files are compared by their size alone: reading gigabytes would take as long as a run
_HASHED_BYTES = 1 << 22
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

    @contextmanager
    def staged(self) -> Iterator[Path]:
        """Provide an empty folder for a new result.

        Its content replaces the earlier result at the end of the block, and is removed if the block
        raises an error.

        Raises:
            ConfigError: If a file of the user has the path of a file of the result; the result is
                then kept in a new folder, which the message names.
        """
        new = self.path / STATE / "new"
        new.mkdir()
        try:
            yield new
            self._publish(new)
        finally:
            shutil.rmtree(new, ignore_errors=True)

    @property
    def claimed(self) -> bool:
        """Whether the folder is reserved for, or holds, a result of this kind."""
        return _manifest(self.path)["kind"] == self.kind

    def claim(self) -> None:
        """Reserve the folder for a result of this kind."""
        _write_whole(self.path / STATE / "manifest.json", {**_manifest(self.path), "kind": self.kind})

    def refuse_conflicts(self, names: Sequence[str]) -> None:
        """Check that no file of the user has the name of a file of the result.

        Args:
            names: Files and folders of the result, directly below the result folder.

        Raises:
            ConfigError: If there is such a file, or the result of another command.
        """
        held = _manifest(self.path)
        if held["kind"] not in (None, self.kind):
            raise ConfigError(
                f"--out {self.path} holds the result of another command, {held['kind']}; choose another folder"
            )
        for path in (path for name in names for path in _files_below(self.path / name)):
            name = path.relative_to(self.path).as_posix()
            if not _is_as_written(path, held["files"].get(name)):
                raise ConfigError(
                    f"--out {self.path}: torchsar did not write {name}, or it was changed since; move it, or choose "
                    "another folder"
                )

    def _publish(self, new: Path) -> None:
        """Write the journal of the new result, and then execute it."""
        files = {path.relative_to(new).as_posix(): _print_of(path) for path in _files_below(new)}
        try:
            self.refuse_conflicts(sorted({name.split("/")[0] for name in files}))
        except ConfigError as error:
            kept = tempfile.mkdtemp(prefix=f"{self.path.name}-", dir=self.path.parent)
            for path in new.iterdir():
                shutil.move(path, kept)
            raise ConfigError(f"{error}; this result was kept in {kept}") from None
        manifest = {"format": 1, "kind": self.kind, "files": files}
        _write_whole(self.path / STATE / "journal.json", {"new": manifest, "old": _manifest(self.path)["files"]})
        _finish(self.path)


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
            _finish(out)
            folder = ResultFolder(out, kind)
            folder.refuse_conflicts(names)
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


def _finish(out: Path) -> None:
    """Execute the remaining steps of the journal, and remove incomplete results."""
    state = out / STATE
    journal = _read(state / "journal.json")
    if journal is not None:
        files = journal["new"]["files"]
        for name in sorted(journal["old"], key=_rank, reverse=True):
            there = name in files and not (state / "new" / name).exists()
            if not there and _is_as_written(out / name, journal["old"][name]):
                _move(out / name, state / "old" / name)
        _remove_empty(out, journal["old"])
        for name in sorted(files, key=_rank):
            if (state / "new" / name).is_file() and not _move(state / "new" / name, out / name):
                log.warning("warning: %s: %s is a file of the user and was kept; the new one was removed", out, name)
        _write_whole(state / "manifest.json", journal["new"])
        (state / "journal.json").unlink()
    for name in ("new", "old"):
        shutil.rmtree(state / name, ignore_errors=True)


def _rank(name: str) -> tuple[int, str]:
    return len(_LAST) - _LAST.index(name) if name in _LAST else 0, name


def _move(source: Path, target: Path) -> bool:
    """Move a file to a free path; return False if the path is not free."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() or target.is_symlink():
            return False
        source.rename(target)
    except (FileExistsError, NotADirectoryError):
        return False
    return True


def _remove_empty(out: Path, files: Mapping[str, Any]) -> None:
    """Remove the empty folders of a replaced result."""
    _remove_if_empty({folder for name in files for folder in (out / name).parents if out in folder.parents})


def _tidy(out: Path, made: Sequence[Path]) -> None:
    """Remove a state directory with only the lock, and then those of `made` that are empty."""
    state = out / STATE
    if {path.name for path in state.iterdir()} <= {"lock"}:
        shutil.rmtree(state, ignore_errors=True)
        _remove_if_empty(made)


def _remove_if_empty(folders: Collection[Path]) -> None:
    """Remove those folders that are empty, the innermost ones first."""
    for folder in sorted(folders, key=lambda path: -len(path.parts)):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _files_below(path: Path) -> list[Path]:
    """The file itself, or all files below a folder; a symbolic link counts as a file."""
    if path.is_symlink() or path.is_file():
        return [path]
    return sorted(p for p in path.rglob("*") if p.is_symlink() or not p.is_dir())


def _print_of(path: Path) -> list[Any]:
    """Size of a file and, unless it is large, a digest of its content."""
    size = path.stat().st_size
    return [size, hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() if size <= _HASHED_BYTES else None]


def _is_as_written(path: Path, known: list[Any] | None) -> bool:
    return known is not None and path.is_file() and not path.is_symlink() and _print_of(path) == known


def _manifest(out: Path) -> dict[str, Any]:
    return _read(out / STATE / "manifest.json") or {"format": 1, "kind": None, "files": {}}


def _read(path: Path) -> dict[str, Any] | None:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be read ({error}); choose another folder") from None


def _write_whole(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(tree), encoding="utf-8")
    part.replace(path)
