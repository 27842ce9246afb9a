"""Replacement of the files of a program in a folder by others: all of them, or none.

The files that the program wrote are listed in a manifest with their sizes and digests; only files
of the manifest that were not changed since are replaced or removed. A replacement is first
described in a journal. If it is interrupted or fails, for example because the disk is full, the
same call completes it later, and until then neither the earlier nor the new files are lost.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchsar.io.seal import is_sealed, sealed

# larger files are compared by their size alone: reading gigabytes would take as long as a run
_HASHED_BYTES = 1 << 22


@dataclass(frozen=True)
class OwnFiles:
    """The files of a program in a folder that may also hold files of the user.

    Args:
        path: The folder.
        state: Directory in the folder for the manifest, the journal and, in the directory `new`,
            files that are to replace the present ones.
        last: Names of files whose presence means that the others are complete; they are removed
            first and moved last.
    """

    path: Path
    state: Path
    last: Sequence[str] = ()

    @property
    def new(self) -> Path:
        """Directory of files that are to replace the present ones."""
        return self.state / "new"

    @property
    def pending(self) -> bool:
        """Whether a replacement has begun and is not complete."""
        return (self.state / "journal.json").exists()

    def manifest(self) -> dict[str, Any]:
        """Return the manifest.

        Returns:
            `kind`, as given to `claim` or `replace`, or None, and `files`: size and digest by path.

        Raises:
            ValueError: If the manifest cannot be read or is damaged.
        """
        return _read(self.state / "manifest.json") or {"kind": None, "files": {}}

    def claim(self, kind: str) -> None:
        """Write the kind of the files into the manifest.

        Args:
            kind: The kind.
        """
        _write(self.state / "manifest.json", {**self.manifest(), "kind": kind})

    def foreign(self, names: Collection[str]) -> str:
        """Find a file that the program did not write, or that was changed since.

        Args:
            names: Files and folders directly below the folder.

        Returns:
            Path of the first such file below these names, relative to the folder; empty if there is
            none.
        """
        held = self.manifest()["files"]
        files = {path.relative_to(self.path).as_posix(): path for name in names for path in _files(self.path / name)}
        return next((name for name, path in files.items() if not _is_as_written(path, held.get(name))), "")

    def replace(self, kind: str) -> list[str]:
        """Replace the files of the manifest by those in the directory `new`.

        Args:
            kind: Kind of the new files.

        Returns:
            Files of the user that have the path of a new file; they were kept, and the new ones
            were removed.

        Raises:
            OSError: If the file system fails. If the replacement had begun, `pending` is True, and
                `finish` completes it.
        """
        files = {path.relative_to(self.new).as_posix(): _print_of(path) for path in _files(self.new)}
        journal = {"new": {"kind": kind, "files": files}, "old": self.manifest()["files"]}
        _write(self.state / "journal.json", journal)
        return self.finish()

    def finish(self) -> list[str]:
        """Complete a replacement that was interrupted, and remove files of incomplete results.

        Returns:
            Files of the user that were kept, as from `replace`.

        Raises:
            OSError: If the file system fails; nothing is lost then.
            ValueError: If the journal cannot be read or is damaged.
        """
        journal, kept = _read(self.state / "journal.json"), []
        if journal is not None:
            files, old = journal["new"]["files"], journal["old"]
            for name in sorted(old, key=self._rank, reverse=True):
                moved = name in files and not (self.new / name).exists()
                if not moved and _is_as_written(self.path / name, old[name]):
                    _move(self.path / name, self.state / "old" / name)
            remove_empty(
                {folder for name in old for folder in (self.path / name).parents if self.path in folder.parents}
            )
            for name in sorted(files, key=self._rank):
                if (self.new / name).is_file() and not _move(self.new / name, self.path / name):
                    kept.append(name)
            _write(self.state / "manifest.json", journal["new"])
            (self.state / "journal.json").unlink()
        for folder in (self.new, self.state / "old"):
            shutil.rmtree(folder, ignore_errors=True)
        return kept

    def _rank(self, name: str) -> tuple[int, str]:
        return len(self.last) - self.last.index(name) if name in self.last else 0, name


def remove_empty(folders: Collection[Path]) -> None:
    """Remove those folders that are empty, the innermost ones first.

    Args:
        folders: Paths of folders; those that do not exist are ignored.
    """
    for folder in sorted(folders, key=lambda path: -len(path.parts)):
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


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


def _files(path: Path) -> list[Path]:
    """The file itself, or all files below a folder; a symbolic link or a pipe counts as a file."""
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        return [path]
    return sorted(p for p in path.rglob("*") if p.is_symlink() or not p.is_dir())


def _print_of(path: Path) -> list[Any]:
    """Size of a file and, unless it is large, a digest of its content."""
    size = path.stat().st_size
    return [size, hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest() if size <= _HASHED_BYTES else None]


def _is_as_written(path: Path, known: list[Any] | None) -> bool:
    return known is not None and path.is_file() and not path.is_symlink() and _print_of(path) == known


def _read(path: Path) -> dict[str, Any] | None:
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no file; choose another folder, or remove it")
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read ({error}); choose another folder, or remove it") from None
    if isinstance(tree, dict) and tree.get("format") == 1 and isinstance(tree.get("files"), dict):
        return tree  # of an earlier version, without a checksum
    if not isinstance(tree, dict) or not is_sealed(tree):
        raise ValueError(f"{path} is damaged, since it differs from its checksum; choose another folder, or remove it")
    return tree


def _write(path: Path, tree: Mapping[str, Any]) -> None:
    """Write a JSON file atomically, with its checksum."""
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(sealed(tree)), encoding="utf-8")
    part.replace(path)
