"""Result folders, each with one result and possibly other files of the user.

A result folder has a directory `.torchsar` with a lock, the manifest of the files that the program
wrote, and, while a command runs, its incomplete result in the directory `new`. The program replaces
and removes only files of the manifest that were not changed since. A complete result is entered in
the manifest beside the earlier one, and its files are then moved; if that is interrupted or fails,
the next command completes it.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar.io.seal import is_sealed, read_json, sealed
from torchsar.study.settings.errors import ConfigError

try:
    import fcntl
# the module does not exist on every operating system, and without it there is no lock
except ImportError:
    fcntl = None

log = logging.getLogger("torchsar")
STATE = ".torchsar"
# files whose presence means that a result is complete; they are removed first and moved last
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
        raises an error. A complete result is never removed: if it cannot replace the earlier one,
        it is kept in a new folder or, if the replacement had begun, completed by the next command.

        Raises:
            ConfigError: If the result cannot replace the earlier one, for example because a file of
                the user has the path of one of its files; the message says where it is.
        """
        new = self.path / STATE / "new"
        new.mkdir()
        try:
            yield new
        except BaseException:
            shutil.rmtree(new, ignore_errors=True)
            raise
        try:
            self.refuse_conflicts(sorted(path.name for path in new.iterdir()))
            files = {path.relative_to(new).as_posix(): _print_of(path) for path in _files(new)}
            self._note(kind=self.kind, files=files, old=self._manifest()["files"])
            self.finish()
        except (ConfigError, OSError) as error:
            why = getattr(error, "strerror", None)
            text = f"--out {self.path}: the result could not be moved to its place ({why})" if why else str(error)
            if self._manifest()["old"] is not None:
                raise ConfigError(f"{text}; the next command with this folder completes the move") from error
            places = (self.path / f"kept-{i}" for i in itertools.count(1))
            kept = new.rename(next(path for path in places if not os.path.lexists(path)))
            raise ConfigError(f"{text}; this result was kept in {kept}") from error

    @property
    def claimed(self) -> bool:
        """True if the folder is reserved for, or holds, a result of this kind."""
        return self._manifest()["kind"] == self.kind

    def claim(self) -> None:
        """Reserve the folder for a result of this kind."""
        self._note(kind=self.kind)

    def store(self, name: str) -> Path:
        """Return the path of a store of this folder.

        Raises:
            ConfigError: If it is a link, since writing would change files outside of the folder.
        """
        _refuse_links(self.path, self.path / name)
        return self.path / name

    def refuse_conflicts(self, names: Sequence[str]) -> None:
        """Check that no file of the user has the name of a file of the result.

        Args:
            names: Files and folders of the result, directly below the result folder.

        Raises:
            ConfigError: If there is such a file, or the result of another command.
        """
        held = self._manifest()
        if held["kind"] not in (None, self.kind):
            raise ConfigError(
                f"--out {self.path} holds the result of another command, {held['kind']}; choose another folder"
            )
        for path in (path for name in names for path in _files(self.path / name)):
            name = path.relative_to(self.path).as_posix()
            if _print_of(path) != held["files"].get(name, ()):
                raise ConfigError(
                    f"--out {self.path}: torchsar did not write {name}, or it was changed since; move it, or choose "
                    "another folder"
                )

    def finish(self) -> None:
        """Complete a replacement that was interrupted, and remove files of incomplete results."""
        held, new = self._manifest(), self.path / STATE / "new"
        if held["old"] is not None:
            files, old = held["files"], held["old"]
            for name in {*files, *old}:
                above = [place / folder for place in (self.path, new) for folder in Path(name).parents]
                if any(folder.is_symlink() for folder in above if folder != self.path):
                    self._refuse_outside(name)
            for name in sorted(old, key=_rank, reverse=True):
                moved = name in files and not (new / name).exists()
                if not moved and _print_of(self.path / name) == old[name]:
                    (self.path / name).unlink()
            above = [folder for name in old for folder in (self.path / name).parents]
            _remove_empty([folder for folder in above if self.path in folder.parents])
            for name in sorted(files, key=_rank):
                if (new / name).is_file() and not _moved(new / name, self.path / name):
                    text = "warning: %s: %s is a file of the user and was kept; the new one was removed"
                    log.warning(text, self.path, name)
            self._note(old=None)
        shutil.rmtree(new, ignore_errors=True)

    def _manifest(self) -> dict[str, Any]:
        """Content of the manifest: `kind` of the result; `files`, the print of each file by path;
        and `old`.

        `old` contains the prints of an earlier result while it is replaced, and is None otherwise.
        """
        path = self.path / STATE / "manifest.json"
        if path.exists() and not path.is_file():
            raise ConfigError(f"{path} is no file; choose another folder, or remove it")
        try:
            tree = read_json(path)
        except FileNotFoundError:
            return {"kind": None, "files": {}, "old": None}
        except (OSError, ValueError, RecursionError) as error:
            raise ConfigError(f"{path} cannot be read ({error}); choose another folder, or remove it") from None
        if not isinstance(tree, dict) or not is_sealed(tree):
            raise ConfigError(
                f"{path} is damaged, since it differs from its checksum; choose another folder, or remove it"
            )
        tree = {"kind": None, "files": {}, "old": None, **tree}
        if not isinstance(tree["files"], dict) or not isinstance(tree["old"], dict | None):
            raise ConfigError(f"{path} lists no files; choose another folder, or remove it")
        for name in (*tree["files"], *(tree["old"] or {})):
            parts = Path(name).parts
            if not parts or Path(name).is_absolute() or ".." in parts or parts[0] == STATE:
                self._refuse_outside(name)
        return tree

    def _refuse_outside(self, name: str) -> None:
        raise ConfigError(
            f"--out {self.path}: {STATE}/manifest.json names {name!r}, which is no file of a result in this folder; "
            "the folder was not made by torchsar alone, choose another one"
        )

    def _note(self, **changes: Any) -> None:
        """Replace entries of the manifest. The file is replaced as a whole."""
        path = self.path / STATE / "manifest.json"
        part = path.with_name("manifest.json.part")
        part.unlink(missing_ok=True)  # it may be a link or a pipe
        part.write_text(json.dumps(sealed({**self._manifest(), **changes})), encoding="utf-8")
        part.replace(path)


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
            folder.finish()
            folder.refuse_conflicts(names)
            yield folder
        finally:
            state = out / STATE
            if {path.name for path in state.iterdir()} <= {"lock"}:
                shutil.rmtree(state, ignore_errors=True)
                _remove_empty(made)


@contextmanager
def fresh_result(out: Path, kind: str, names: Sequence[str]) -> Iterator[Path]:
    """Provide an empty folder, whose content becomes the result in `out` at the end of the block.

    See `opened` and `ResultFolder.staged`.
    """
    try:
        with opened(out, kind, names) as folder, folder.staged() as new:
            yield new
    except BrokenPipeError:  # the pipe of stdout was closed; the folder is intact
        raise
    except OSError as error:
        raise ConfigError(
            f"--out {out}: the result cannot be written ({error.strerror or error}); make room, or choose another "
            "folder"
        ) from error


def _locked(out: Path) -> Any:
    """Lock a result folder and return the locked file. The operating system releases the lock when
    the process ends.
    """
    state = out / STATE
    _refuse_links(out, state, *(state / name for name in ("lock", "new", "manifest.json")))
    for attempts_left in reversed(range(10_000)):
        try:
            state.mkdir(parents=True, exist_ok=True)
            if any(state.iterdir()) and not (state / "lock").is_file():
                raise ConfigError(f"--out {out}: {state} was not made by torchsar; move it, or choose another folder")
            file = (state / "lock").open("a")
        except (OSError, ValueError) as error:
            if isinstance(error, FileNotFoundError) and attempts_left:
                continue  # another command may have just removed the empty folder
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


def _refuse_links(out: Path, *paths: Path) -> None:
    for path in paths:
        if os.path.islink(path):
            raise ConfigError(f"--out {out}: {path} is a link, not made by torchsar; choose another folder")


def _rank(name: str) -> tuple[int, str]:
    return len(_LAST) - _LAST.index(name) if name in _LAST else 0, name


def _files(path: Path) -> list[Path]:
    """Return the path itself if it is a file, or all files below a folder. A symbolic link or a
    pipe counts as a file.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        return [path]
    return sorted(p for p in path.rglob("*") if p.is_symlink() or not p.is_dir())


def _print_of(path: Path) -> list[Any] | None:
    """Size of a file and digest of its content; None if the path is no file.

    The digest is left out above 4 MiB, because reading would take as long as a run.
    """
    if path.is_symlink() or not path.is_file():
        return None
    size = path.stat().st_size
    return [size, hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() if size <= 1 << 22 else None]


def _moved(source: Path, target: Path) -> bool:
    """Move a file to a free path; return False if the path is not free."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(target):
            return False
        source.rename(target)
    except (FileExistsError, NotADirectoryError):
        return False
    return True


def _remove_empty(folders: Sequence[Path]) -> None:
    """Remove those folders that are empty, the innermost ones first."""
    for folder in sorted(set(folders), key=lambda path: -len(path.parts)):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
