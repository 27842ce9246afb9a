"""Result folders: what the program did not write survives whatever happens."""

from __future__ import annotations

import errno
import io
import json
import os
import random
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zarr

from torchsar.io.arrays import refuse_changed_files, seal_files
from torchsar.io.seal import sealed
from torchsar.study.output.folder import STATE, _print_of, fresh_result, opened
from torchsar.study.settings.errors import ConfigError
from torchsar.study.settings.text import read_tree

NAMES = ("metrics.json", "figures", "report.html")
MINE = {"notes.txt": "mine", "figures.bak/old.png": "mine too", "OUT.old": "a name close to the result's"}


def write(folder: Path, text: str, pictures: int = 2) -> None:
    (folder / "figures").mkdir()
    for i in range(pictures):
        (folder / "figures" / f"{i}.png").write_text(text)
    for name in ("metrics.json", "report.html"):
        (folder / name).write_text(text)


def result(out: Path) -> dict[str, str]:
    """The files of the result, without those of the user and of the state."""
    files = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file()}
    return {name: path.read_text() for name, path in files.items() if name not in MINE and not name.startswith(STATE)}


def whole(text: str, pictures: int = 2) -> dict[str, str]:
    return dict.fromkeys(("metrics.json", "report.html", *(f"figures/{i}.png" for i in range(pictures))), text)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A folder in which a user keeps files, with a first result in it."""
    out = tmp_path / "out"
    for name, text in MINE.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    with fresh_result(out, "run", NAMES) as folder:
        write(folder, "first", 3)
    return out


def assert_mine(out: Path) -> None:
    for name, text in MINE.items():
        assert (out / name).read_text() == text, name


def test_a_result_replaces_the_earlier_one_and_nothing_else(out: Path) -> None:
    assert result(out) == whole("first", 3)
    with fresh_result(out, "run", NAMES) as folder:
        write(folder, "second")
    assert result(out) == whole("second")
    assert_mine(out)


def test_a_failure_leaves_the_earlier_result(out: Path) -> None:
    with pytest.raises(ZeroDivisionError), fresh_result(out, "run", NAMES) as folder:
        write(folder, "second")
        raise ZeroDivisionError
    assert result(out) == whole("first", 3)


def test_where_nothing_is_written_nothing_is_left(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), fresh_result(tmp_path / "a" / "b", "run", NAMES):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def linked(to: Path, link: Path) -> None:
    link.symlink_to(to)


CONFLICTS: dict[str, Callable[[Path], object]] = {
    "a file of the user under a name of the result": lambda out: (out / "report.html").write_text("mine"),
    "a result that the user changed": lambda out: (out / "metrics.json").write_text("my own figures"),
    "a file of the user among the pictures": lambda out: (out / "figures" / "my.png").write_text("mine"),
    "a pipe under a name of the result": lambda out: ((out / "report.html").unlink(), os.mkfifo(out / "report.html")),
    "pictures behind a link": lambda out: linked((out / "figures").rename(out / "kept"), out / "figures"),
}


@pytest.mark.parametrize("change", CONFLICTS.values(), ids=CONFLICTS)
def test_files_of_the_user_are_refused_before_any_work(change: Callable[[Path], object], out: Path) -> None:
    change(out)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != "lock"}
    with pytest.raises(ConfigError, match="torchsar did not write"), fresh_result(out, "run", NAMES):
        pytest.fail("must not begin")
    assert before == {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != "lock"}


def test_files_that_come_while_a_command_works_are_kept_and_so_is_the_result(out: Path) -> None:
    with pytest.raises(ConfigError, match="was kept in") as error, fresh_result(out, "run", NAMES) as folder:
        write(folder, "second")
        (out / "figures" / "my.png").write_text("mine")
    kept = Path(str(error.value).split("was kept in ")[1])
    assert result(kept) == whole("second")
    assert (out / "figures" / "my.png").read_text() == "mine"


def test_a_full_disk_is_one_sentence_and_the_earlier_result_stays(out: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot be written \(No space left"), fresh_result(out, "run", NAMES):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert result(out) == whole("first", 3)


def test_a_folder_belongs_to_one_kind_of_command(out: Path) -> None:
    with pytest.raises(ConfigError, match="result of another command, run"), opened(out, "trade"):
        pytest.fail("must not begin")
    assert result(out) == whole("first", 3)


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "a file": (lambda tmp: touched(tmp / "file"), "cannot be written"),
    "below a file": (lambda tmp: touched(tmp / "file") / "below", "cannot be written"),
    "a state of somebody else": (lambda tmp: touched(tmp / "mine" / STATE / "x").parents[1], "was not made by"),
    "where no folder can be made": (lambda tmp: Path("/proc/torchsar"), "cannot be written"),
    "no name": (lambda tmp: tmp / "a\0b", "cannot be written"),
    "a long name": (lambda tmp: tmp / ("x" * 400), "cannot be written"),
}


def touched(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")
    return path


@pytest.mark.parametrize("make, said", REFUSED.values(), ids=REFUSED)
def test_what_is_no_result_folder_is_refused(make: Callable[[Path], Path], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=said), fresh_result(make(tmp_path), "run", NAMES):
        pytest.fail("must not begin")


def test_one_writer_at_a_time(out: Path) -> None:
    program = f"""
from pathlib import Path
from torchsar.study.output.folder import opened
with opened(Path({str(out)!r}), "run"):
    print("in", flush=True); input()
"""
    with subprocess.Popen([sys.executable, "-c", program], stdin=-1, stdout=-1, text=True) as other:
        assert other.stdout is not None and other.stdin is not None and other.stdout.readline() == "in\n"
        with pytest.raises(ConfigError, match="another torchsar command is writing there"), opened(out, "run"):
            pytest.fail("must not begin")
        other.kill()
    with fresh_result(out, "run", NAMES) as folder:
        write(folder, "second")
    assert result(out) == whole("second")


CALLS = [(os, name) for name in ("rename", "replace", "mkdir", "rmdir", "unlink")] + [(io, "open")]


def dying_at(moment: int, out: Path, text: str) -> bool:
    """Write a result in a process that dies at the n-th call that changes the disk."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
    left = moment

    def counting(call: Callable) -> Callable:
        def counted(*given, **named):
            nonlocal left
            left -= 1
            if left < 0:
                os._exit(9)
            return call(*given, **named)

        return counted

    for module, name in CALLS:
        setattr(module, name, counting(getattr(module, name)))
    try:
        with fresh_result(out, "run", NAMES) as folder:
            write(folder, text)
    except BaseException:
        os._exit(7)
    os._exit(0)


@pytest.mark.slow
def test_dying_at_any_moment_loses_nothing(out: Path) -> None:
    """At every call that changes the disk, some of them twice in a row; the next command finishes
    what was decided, or finds the earlier result.
    """
    source, moment, died = random.Random(0), 0, True
    earlier = {"first": 3}
    while died:
        text = f"result {moment}"
        died = dying_at(moment, out, text)
        if died and source.random() < 0.5:
            dying_at(source.randrange(30), out, text)
        assert_mine(out)
        with opened(out, "run", NAMES):
            pass
        accepted = [whole(text), *(whole(*known) for known in earlier.items())]
        assert result(out) in accepted, f"died at {moment}"
        if result(out) == whole(text):
            earlier = {text: 2}
        moment += 1
    assert moment > 50, moment
    assert result(out) == whole(text)


def failing_at(moment: int, out: Path, text: str, full: bool) -> str:
    """Write a result where the n-th call that changes the disk fails; the sentence, if it does.

    full: nothing more is created from then on; files can be moved and read.
    """
    left = moment

    def counting(call: Callable) -> Callable:
        creates = call.__name__ in ("open", "mkdir")

        def counted(*given, **named):
            nonlocal left
            left -= 1
            reads = call.__name__ == "open" and "r" in (*given, "r")[1]
            if (creates and not reads and left < 0) if full else left == -1:
                raise OSError(errno.ENOSPC, "No space left on device")
            return call(*given, **named)

        return counted

    with pytest.MonkeyPatch.context() as patch:
        try:
            with fresh_result(out, "run", NAMES) as folder:
                write(folder, text)
                for module, name in CALLS:  # the result is complete now
                    patch.setattr(module, name, counting(getattr(module, name)))
        except ConfigError as error:
            return str(error)
    return ""


@pytest.mark.parametrize("full", [True, False])
def test_a_disk_that_fails_while_a_result_is_moved_loses_neither(full: bool, out: Path) -> None:
    """The earlier result stays, or the new one is kept or moved by the next command."""
    earlier, moment, said = whole("first", 3), 0, "?"
    while said:
        said = failing_at(moment, out, f"result {moment}", full)
        assert_mine(out)
        with opened(out, "run", NAMES):
            pass
        there = result(out)
        kept = {name: there.pop(name) for name in list(there) if name.startswith("kept-")}
        new = whole(f"result {moment}")
        if there != new:
            assert there == earlier and f"kept in {out / 'kept-'}" in said, (moment, said)
            assert {name.partition("/")[2]: text for name, text in kept.items()} == new
        elif said:
            assert "No space left on device" in said and "; the next command with this folder completes" in said
        for name in kept:
            (out / name).unlink()
        for name in {name.partition("/")[0] for name in kept}:
            (out / name / "figures").rmdir()
            (out / name).rmdir()
        earlier, moment = there, moment + 1
    assert moment > 15


@pytest.mark.parametrize("content", ["", "[", "[]", '{"kind": "run"}', '{"format": 1, "files": 3}', "[" * 10**5])
def test_a_damaged_manifest_is_a_sentence(content: str, out: Path) -> None:
    (out / STATE / "manifest.json").write_text(content)
    with (
        pytest.raises(ConfigError, match=r"manifest.json (cannot be read|is damaged)"),
        fresh_result(out, "run", NAMES),
    ):
        pytest.fail("must not begin")
    assert result(out) == whole("first", 3)


def test_a_file_that_has_grown_is_not_read_into_memory(out: Path, tmp_path: Path) -> None:
    """Sizes are checked first: 20 GB of a file with holes would fill the memory."""
    os.truncate(out / STATE / "manifest.json", 20 << 30)
    with pytest.raises(ConfigError, match="it has 21474836480 bytes, and may have"), opened(out, "run", NAMES):
        pytest.fail("must not begin")
    store = zarr.create_group(tmp_path / "store.zarr")
    store["x"] = np.ones(3)
    seal_files(store, tmp_path / "store.zarr")
    os.truncate(tmp_path / "store.zarr" / "x" / "c" / "0", 20 << 30)
    with pytest.raises(ValueError, match="differ from their checksum"):
        refuse_changed_files(tmp_path / "store.zarr")
    config = tmp_path / "recording.yaml"
    config.touch()
    os.truncate(config, 20 << 30)
    with pytest.raises(ConfigError, match="21474836480 bytes are no config; name recorded data by data.file="):
        read_tree(config)


def test_a_manifest_that_is_a_pipe_is_not_waited_for(out: Path) -> None:
    (out / STATE / "manifest.json").unlink()
    os.mkfifo(out / STATE / "manifest.json")
    with pytest.raises(ConfigError, match="manifest.json is no file"), opened(out, "run", NAMES):
        pytest.fail("must not begin")


def test_any_flipped_bit_of_a_manifest_is_found(out: Path) -> None:
    path, source = out / STATE / "manifest.json", random.Random(0)
    data = path.read_bytes()
    for _ in range(50):
        flipped = bytearray(data)
        flipped[source.randrange(len(data))] ^= 1 << source.randrange(8)
        path.write_bytes(flipped)
        with pytest.raises(ConfigError, match="manifest.json"), opened(out, "run", NAMES):
            pytest.fail("must not begin")
    path.write_bytes(data)
    with opened(out, "run", NAMES):
        pass


@pytest.mark.parametrize(
    "name", ["../notes.txt", "link/notes.txt", ".torchsar/lock", "/etc/hostname", "a/../../notes.txt"]
)
@pytest.mark.parametrize("entry", ["files", "old"])
def test_a_manifest_that_names_files_outside_touches_nothing(name: str, entry: str, out: Path) -> None:
    """As in a folder from somebody else: files are compared by prints that anybody can compute."""
    outside = out.parent / "notes.txt"
    outside.write_text("of another project")
    (out / "link").symlink_to("..")
    (out / STATE / "new").mkdir()
    planted = out / STATE / "new" / "report.html"
    planted.write_text("new")
    prints = {name: _print_of(outside), "report.html": _print_of(planted)}
    tree = {"kind": "run", entry: prints, **({"old": {}} if entry == "files" else {})}
    (out / STATE / "manifest.json").write_text(json.dumps(sealed(tree)))
    before = {path: path.read_bytes() for path in out.parent.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError, match="no file of a result in this folder"), fresh_result(out, "run", NAMES):
        pass
    assert before == {path: path.read_bytes() for path in out.parent.rglob("*") if path.is_file()}


@pytest.mark.parametrize("which", [STATE, f"{STATE}/new"])
def test_a_state_behind_a_link_is_refused(which: str, out: Path) -> None:
    other = out.parent / "other"
    (out / STATE).rename(other) if which == STATE else other.mkdir()
    (other / "mine.txt").write_text("mine")
    (out / which).symlink_to(other)
    with pytest.raises(ConfigError, match="is a link"), fresh_result(out, "run", NAMES):
        pass
    assert (other / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["lock", "manifest.json", "manifest.json.part"])
@pytest.mark.parametrize("kind", ["link", "link to nothing", "pipe"])
def test_no_file_of_the_state_leads_outside(name: str, kind: str, out: Path) -> None:
    outside = out.parent / "notes.txt"
    outside.write_text("of another project")
    path = out / STATE / name
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to(outside if kind == "link" else out.parent / "planted")
    with suppress(ConfigError), fresh_result(out, "run", NAMES) as folder:
        (folder / "report.html").write_text("new")
    assert outside.read_text() == "of another project" and not (out.parent / "planted").exists()


def test_a_store_behind_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "results.zarr").symlink_to(tmp_path / "other")
    with opened(tmp_path / "s", "sweep") as folder, pytest.raises(ConfigError, match="results.zarr is a link"):
        folder.store("results.zarr")
