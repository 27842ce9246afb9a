"""Result folders under commands that are killed at any moment, and under two commands at once.

Many more moments than the test has time for: python -m tests.study.test_kill_points 200 SEED
"""

from __future__ import annotations

import os
import random
import signal
import sys
import tempfile
import time
from pathlib import Path

import pytest
import torch
import yaml

from tests.study.tiny import TINY
from torchsar.cli import main
from torchsar.study.commands import run, sweep, trade
from torchsar.study.output.folder import STATE, opened

COMMANDS = ("run", "sweep", "trade", "requires")
SMALL = [
    "world.lines=48",
    "world.samples=64",
    "world.scene.field.count=2",
    "radar.pulse.duration_s=3e-7",
    "world.beam.dwell_s=0.05",
]
# what changes the disk; "open" counts when it may write
EVENTS = {"os.rename", "os.mkdir", "os.rmdir", "os.remove", "os.truncate", "shutil.rmtree"}
RESULT = {"run": "metrics.json", "sweep": "summary.json", "trade": "trade.json", "requires": "requires.json"}


def die_at(moment: int) -> None:
    """Kill this process at the n-th call that changes the disk."""
    left = moment

    def hook(event: str, given: tuple) -> None:
        nonlocal left
        if event in EVENTS or (event == "open" and isinstance(given[1], str) and set(given[1]) & set("wax+")):
            left -= 1
            if left < 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def start(home: Path, command: str, out: Path, seed: int, moment: int | None, said: Path) -> int:
    """A command in a process of its own, without pictures, which take longest; its process id."""
    child = os.fork()
    if child:
        return child
    status = 99
    try:
        os.chdir(home)
        sys.stdout = sys.stderr = said.open("w", buffering=1, encoding="utf-8")
        run.draw_all = sweep.draw_sweep = trade.draw_all = lambda *_, **__: []
        if moment is not None:
            die_at(moment)
        more = (
            ["--resume", "sweep.trials=2", "sweep.grid.world.noise.snr_db=[10.0, 20.0]"]
            if command == "sweep"
            else [f"seed={seed}"]
        )
        status = main([command, "tiny.yaml", *SMALL, "trade.repeats=1", "trade.trials=1", *more, "--out", str(out)])
    finally:
        os._exit(status)


def end_of(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


class Home:
    """A folder in which a user has results of all commands, and files of his own beside them."""

    def __init__(self, path: Path) -> None:
        self.path, self.said = path, path / "said.txt"
        (path / "tiny.yaml").write_text(yaml.safe_dump(TINY, sort_keys=False))
        (path / "elsewhere.txt").write_text("a file that a link points to")
        self.mine = {path / "elsewhere.txt"}
        for out in self.outs:
            for name in (
                "notes.txt",
                "out.old",
                f"{STATE}.tmp/new",
                "report.html.bak",
                "project/config.yaml",
                "locked",
            ):
                (out / name).parent.mkdir(parents=True, exist_ok=True)
                (out / name).write_text(f"my own {name}")
                self.mine.add(out / name)
            (out / "locked").chmod(0o444)
            (out / "link").symlink_to(path / "elsewhere.txt")
            self.mine.add(out / "link")
            beside = out.with_name(f"{out.name}.old") / "config.yaml"
            beside.parent.mkdir()
            beside.write_text("my own")
            self.mine.add(beside)
        self.before = self.state()

    @property
    def outs(self) -> list[Path]:
        return [self.path / "out" / name for name in COMMANDS]

    def state(self) -> dict[Path, tuple[bool, str]]:
        return {path: (path.is_symlink(), path.read_text()) for path in self.mine}

    def check(self, out: Path, command: str) -> None:
        """Files of the user are as they were; a result is whole, of one seed, without litter."""
        assert self.state() == self.before
        with opened(out, command):
            pass
        ours = {path.relative_to(out).parts[0] for path in out.rglob("*") if path.is_file() and path not in self.mine}
        if (out / RESULT[command]).exists() and command in ("run", "sweep"):
            config = yaml.safe_load((out / "config.yaml").read_text())
            assert f"seed: {config['seed']}" in (out / "report.html").read_text()
            assert ours >= {"config.yaml", "report.html", "arrays.zarr" if command == "run" else "results.zarr"}
        elif command in ("run", "sweep"):
            assert ours <= {STATE, "results.zarr"}, ours
        assert not (out / STATE / "new").exists()


def attack(home: Home, source: random.Random, seed: int) -> str:
    """One kill, sometimes of two commands at once; then the same command must succeed."""
    command = source.choice(COMMANDS)
    out = home.path / "out" / command
    twice, edited = source.random() < 0.2, source.random() < 0.15 and (out / "report.html").is_file()
    by_time = source.random() < 0.3
    moment = None if by_time else source.randrange(90 if command == "sweep" else 60)
    children = [start(home.path, command, out, seed, moment, home.said) for _ in range(1 + twice)]
    if by_time:
        time.sleep(source.random() * 1.5)
        os.kill(children[0], signal.SIGKILL)
    ends = [end_of(child) for child in children]
    assert all(end in (0, 2, -signal.SIGKILL) for end in ends), (ends, home.said.read_text())
    home.check(out, command)
    other = source.choice([one for one in COMMANDS if one != command])
    if (out / STATE).exists():  # the folder belongs to one kind of command
        refused = end_of(start(home.path, other, out, seed, None, home.said))
        assert refused == 2 and "result of another command" in home.said.read_text(), home.said.read_text()
    if edited and (out / "report.html").is_file():
        kept = (out / "report.html").read_text()
        (out / "report.html").write_text("edited by the user")
        assert end_of(start(home.path, command, out, seed, None, home.said)) == 2
        assert "torchsar did not write report.html" in home.said.read_text()
        assert (out / "report.html").read_text() == "edited by the user"
        (out / "report.html").write_text(kept)
    assert end_of(start(home.path, command, out, seed, None, home.said)) == 0, home.said.read_text()
    home.check(out, command)
    assert (out / RESULT[command]).is_file()
    return f"{command} {'by time' if by_time else f'at {moment}'}{' twice' if twice else ''}: {ends}"


@pytest.mark.slow
def test_files_of_the_user_survive_any_kill(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    home, source = Home(tmp_path), random.Random(0)
    kills = 0
    for index in range(20):
        kills += "-9" in attack(home, source, 2 + index)
        if kills == 4:
            return
    pytest.fail(f"of 20 commands only {kills} were killed before their end")


if __name__ == "__main__":
    count, number = int(sys.argv[1]), int(sys.argv[2])
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        chosen, place = random.Random(number), Home(Path(folder))
        rows = []
        for index in range(count):
            rows.append(attack(place, chosen, 2 + index))
            print(index, rows[-1], flush=True)
        print(f"seed {number}: {count} commands, {sum('-9' in row for row in rows)} killed, nothing lost")
