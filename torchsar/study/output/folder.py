"""Result folders: one result each, beside whatever else a user keeps in them.

A result folder holds a directory `.torchsar` of this program: a lock, the manifest of the files
that the program wrote, and, while a command runs, what it is writing. Only files of the manifest
that are still as they were written are ever replaced or removed. A result is written beside its
place and moved there at the end; a journal lets the next command finish a move that was cut off.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar.study.settings.errors import ConfigError

try:
    import fcntl
except ImportError:  # absent on some systems, which then do not guard against two writers at once
    fcntl = None

log = logging.getLogger("torchsar")
STATE = ".torchsar"
# larger files are known by their size alone: reading gigabytes again would take as long as a run
_HASHED_BYTES = 1 << 22
# these tell a reader that a result is whole: they leave first and arrive last
_LAST = ("report.html", "metrics.json", "summary.json", "trade.json", "requires.json")


@dataclass(frozen=True)
class ResultFolder:
    """An open result folder, which this process alone writes into; made by `opened`.

    Args:
        path: The folder.
        kind: The command that it belongs to: run, sweep, trade or requires.
    """

    path: Path
    kind: str

    @contextmanager
    def staged(self) -> Iterator[Path]:
        """An empty folder to write a result into.

        Its content replaces the earlier result when the block ends well, and is dropped when it
        does not.

        Raises:
            ConfigError: If a file of the user has come to stand where one of the result belongs;
                the result is then kept in a new folder, which the sentence names.
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
        """Whether the folder is known to hold a result of this kind, finished or not."""
        return _manifest(self.path)["kind"] == self.kind

    def claim(self) -> None:
        """Note what kind of result the folder holds before the result is there."""
        _write_whole(self.path / STATE / "manifest.json", {**_manifest(self.path), "kind": self.kind})

    def refuse_conflicts(self, names: Sequence[str]) -> None:
        """Refuse the folder if files of the user bear the names of a result.

        Args:
            names: Files and folders directly below the result folder.

        Raises:
            ConfigError: With the first such file.
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
        """Decide on the new result by writing the journal, then carry the decision out."""
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
    """The result folder at `out`, made if need be, for this process alone.

    A move that an earlier command could not finish is finished first. Where nothing is written,
    nothing is left.

    Args:
        out: The folder.
        kind: run, sweep, trade or requires: a folder holds results of one kind.
        names: What the result will consist of: files and folders directly below `out`.

    Raises:
        ConfigError: If the folder cannot be written, another command is writing there, it holds
            the result of another command, or files of the user bear one of the names.
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
    """A folder to write a whole result into; see `opened` and `ResultFolder.staged`."""
    with opened(out, kind, names) as folder, folder.staged() as new:
        yield new


def _locked(out: Path) -> Any:
    """The open lock file of a result folder. The lock ends with the process, however that ends."""
    state = out / STATE
    while True:
        try:
            state.mkdir(parents=True, exist_ok=True)
            if any(state.iterdir()) and not (state / "lock").is_file():
                raise ConfigError(f"--out {out}: {state} was not made by torchsar; move it, or choose another folder")
            file = (state / "lock").open("a")
        except FileNotFoundError:  # another command has just removed the empty folder
            continue
        except (OSError, ValueError) as error:
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
    """Carry out what the journal says as far as it is still to be done; drop what was cut off."""
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
                log.warning("warning: %s: %s is not torchsar's and stays; the new one was dropped", out, name)
        _write_whole(state / "manifest.json", journal["new"])
        (state / "journal.json").unlink()
    for name in ("new", "old"):
        shutil.rmtree(state / name, ignore_errors=True)


def _rank(name: str) -> tuple[int, str]:
    return len(_LAST) - _LAST.index(name) if name in _LAST else 0, name


def _move(source: Path, target: Path) -> bool:
    """Move a file to where nothing is; False where something is."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists() or target.is_symlink():
            return False
        source.rename(target)
    except (FileExistsError, NotADirectoryError):
        return False
    return True


def _remove_empty(out: Path, files: Mapping[str, Any]) -> None:
    """Remove the folders of a replaced result in which nothing is left."""
    folders = {folder for name in files for folder in (out / name).parents if out in folder.parents}
    for folder in sorted(folders, key=lambda path: -len(path.parts)):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _tidy(out: Path, made: Sequence[Path]) -> None:
    """Remove a state that holds nothing but the lock, and the folders that were made for it."""
    state = out / STATE
    if {path.name for path in state.iterdir()} <= {"lock"}:
        shutil.rmtree(state, ignore_errors=True)
        for folder in made:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def _files_below(path: Path) -> list[Path]:
    """The file itself, or all files below a folder; links count as files, wherever they point."""
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
    """Write a JSON file that appears whole or not at all."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(tree), encoding="utf-8")
    part.replace(path)
