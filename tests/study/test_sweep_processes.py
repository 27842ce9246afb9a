"""Sweeps that are killed, interrupted, or computed by several processes."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from tests.program import Program, fork_workers
from tests.study import toy
from tests.study.tiny import write_tiny
from torchsar.cli import main
from torchsar.core import Draws
from torchsar.study.montecarlo import Record, engines, read_sweep
from torchsar.study.montecarlo.engines import engine
from torchsar.study.montecarlo.fingerprint import code
from torchsar.study.montecarlo.grid import make_grid
from torchsar.study.montecarlo.work import Chunk, Work
from torchsar.study.output import progress
from torchsar.study.settings.errors import ConfigError

needs_dask = pytest.mark.skipif(
    pytest.importorskip("importlib.util").find_spec("distributed") is None,
    reason="dask.distributed (extra cluster) is not installed",
)


@pytest.fixture(autouse=True, scope="module")
def _workers_start_at_once() -> None:
    fork_workers()


def swept(out: Path, slow_s: float, log: Path | None, workers: int | None) -> None:
    """The program of a toy sweep, slowed down."""
    toy.run(
        out,
        trial=toy.Logged(slow_s, None if log is None else str(log)),
        workers=workers,
        chunk=7,
        resume=True,
        version=1,
    )


def start(out: Path, slow_s: float = 0.0, log: Path | None = None, workers: int | None = None) -> Program:
    return Program(swept, out, slow_s, log, workers, folder=out.parent, said=out.parent / "said.txt")


def command_line(*words: str) -> int:
    """The command line with a progress line every 0.2 s."""
    progress._EVERY_S = 0.2
    return main(words)


def rows(log: Path) -> list[tuple[str, str]]:
    """Rows that the log says were computed: (address, trial)."""
    return (
        [tuple(line.split()[1:]) for line in log.read_text().splitlines() if line.count(" ") == 2]
        if log.exists()
        else []
    )


def marked(out: Path) -> np.ndarray | None:
    try:
        return read_sweep(out).done
    except ConfigError:
        return None


def bitwise(a: Record, b: Record) -> None:
    assert a.done.all() and b.done.all()
    np.testing.assert_array_equal(a.ok, b.ok)
    for name in a.metrics:
        np.testing.assert_array_equal(a.metrics[name], b.metrics[name])
    for metric, named in a.bounds.items():
        for name in named:
            np.testing.assert_array_equal(named[name], b.bounds[metric][name])


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Record:
    """The toy sweep in one process with one thread."""
    out = tmp_path_factory.mktemp("alone") / "s"
    done = start(out)
    assert done.wait() == 0, done.said
    return read_sweep(out)


@pytest.mark.slow
def test_a_program_killed_at_random_moments_loses_nothing_and_repeats_nothing(alone: Record, tmp_path: Path) -> None:
    out, log, moments = tmp_path / "s", tmp_path / "log", random.Random(7)
    kills, computed_before = 0, set()
    while kills < 6:
        before = marked(out)
        known = len(rows(log))
        running = start(out, 0.05, log)
        deadline = time.monotonic() + 60
        while len(rows(log)) == known and running.running and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(moments.uniform(0.0, 0.35))
        assert running.kill() == -signal.SIGKILL, running.said
        after = marked(out)
        if after is None:
            continue
        kills += 1
        if before is not None:
            assert not (before & ~after).any()  # nothing that was marked is lost
            # nothing that was marked is computed again
            assert not set(rows(log)[known:]) & computed_before
        record = read_sweep(out)
        for algorithm in range(len(record.algorithms)):
            # no torn chunk
            assert np.isfinite(record.metrics["level_error_m"][algorithm][after]).all()
        computed_before = addresses(after)
    finished = start(out, log=log)
    assert finished.wait() == 0, finished.said
    assert not set(rows(log)[len(rows(log)) - int((~after).sum()) :]) & computed_before
    bitwise(read_sweep(out), alone)


def addresses(done: np.ndarray) -> set[tuple[str, str]]:
    """Rows that are marked, as the log names them."""
    points = make_grid(toy.GRID, ["snr_db"]).points()
    return {(p.address, str(trial)) for p in points for trial in np.flatnonzero(done[p.index])}


@pytest.mark.slow
@needs_dask
@pytest.mark.slow
def test_two_workers_give_the_same_bits_and_survive_the_death_of_workers(alone: Record, tmp_path: Path) -> None:
    out, log = tmp_path / "s", tmp_path / "log"
    running = start(out, 0.3, log, workers=2)
    killed: set[int] = set()
    deadline = time.monotonic() + 120
    while running.running and len(killed) < 3 and time.monotonic() < deadline:
        fresh = (
            [int(line.split()[0]) for line in log.read_text().splitlines() if line.count(" ") == 2]
            if log.exists()
            else []
        )
        victims = [pid for pid in dict.fromkeys(fresh[-14:]) if pid not in killed]
        if victims and len(fresh) > 30 * (len(killed) + 1):
            os.kill(victims[-1], signal.SIGKILL)
            killed.add(victims[-1])
        time.sleep(0.05)
    assert running.wait() == 0, running.said
    assert len(killed) == 3
    bitwise(read_sweep(out), alone)
    assert (
        len({line.split()[0] for line in log.read_text().splitlines()}) >= 4
    )  # both workers, and those that replaced the dead
    assert max(Counter(rows(log)).values()) <= 1 + len(killed)


@needs_dask
def test_a_scheduler_that_does_not_answer_is_named() -> None:
    with pytest.raises(ConfigError, match="--cluster nowhere://x does not answer"), engine(cluster="nowhere://x"):
        pytest.fail("must not begin")
    with pytest.raises(ConfigError, match="give one of them"), engine(workers=2, cluster="tcp://localhost:1"):
        pytest.fail("must not begin")


@pytest.mark.slow
def test_an_interrupted_sweep_says_how_to_go_on_and_does(tmp_path: Path) -> None:
    config, out = (
        write_tiny(tmp_path, sweep={"world.noise.snr_db": [0.0, 10.0], "trials": 4000, "chunk": 4}),
        tmp_path / "result",
    )
    command = ("sweep", str(config), "--out", str(out), "--resume")
    for stop in (signal.SIGINT, signal.SIGTERM):
        running = Program(command_line, *command, folder=tmp_path, said=tmp_path / "said.txt")
        running.wait_for("trials/s")
        running.send(stop)
        assert running.wait() == 130, running.said
        assert "interrupted" in running.said and "trials are recorded in" in running.said
        assert running.said.strip().endswith("go on with --resume")
        assert "Traceback" not in running.said and not (out / "report.html").exists()
    held = int(read_sweep(out).done.sum())
    assert held >= 8
    assert main([*command, f"sweep.trials={held // 2 + 2}"]) == 0
    assert (out / "report.html").exists()


def deadly(parameters: dict, draws) -> dict:
    """The toy trial, in a process that the system kills where a batch is too large."""
    if len(draws.trials) > 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return toy.trial(parameters, draws)


@pytest.mark.slow
@needs_dask
def test_a_batch_that_kills_its_workers_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "_DEATHS", 0)
    with pytest.raises(ConfigError, match="workers of the sweep died .*smaller chunk"):
        toy.run(trial=deadly, workers=1, trials=6, grid={"snr_db": [0.0], "law": ["flat"]}, chunk=6)


@needs_dask
def test_a_running_scheduler_serves_and_a_failing_trial_is_named(alone: Record) -> None:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=40
    ) as cluster:
        bitwise(toy.run(cluster=cluster.scheduler_address, chunk=7), alone)
        with pytest.raises(ConfigError, match="trials 0 to 1 of law=flat failed: KeyError: nothing"):
            toy.run(trial=failing, cluster=cluster.scheduler_address, chunk=2, trials=2)


def failing(parameters: dict, draws) -> dict:
    return {"m": parameters["nothing"]}


@pytest.mark.slow
@needs_dask
def test_ctrl_c_with_workers_is_one_sentence(tmp_path: Path) -> None:
    config, out = (
        write_tiny(tmp_path, sweep={"world.noise.snr_db": [0.0, 10.0], "trials": 4000, "chunk": 4}),
        tmp_path / "result",
    )
    command = ("sweep", str(config), "--workers", "2", "--out", str(out))
    running = Program(command_line, *command, folder=tmp_path, said=tmp_path / "said.txt")
    running.wait_for("trials/s")
    time.sleep(1)
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does, to all of them
    assert running.wait() == 130 and "Traceback" not in running.said, running.said
    assert running.said.strip().endswith("go on with --resume") and read_sweep(out).done.any()


@needs_dask
def test_a_worker_with_other_programs_gets_no_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of two versions would be mixed; a worker that comes later is asked as well."""
    from distributed import LocalCluster

    now = code()
    other = {**now, "code": {"torchsar": "other"}}
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        monkeypatch.setattr(engines, "code", lambda packages: other)
        with pytest.raises(ConfigError, match=r"worker \S+ has other programs .*code.torchsar was .* and is other"):
            toy.run(cluster=cluster.scheduler_address, chunk=7)
        monkeypatch.setattr(engines, "code", broken)
        with pytest.raises(ConfigError, match=r"worker \S+ cannot compute trials \(ImportError: none\); install"):
            toy.run(cluster=cluster.scheduler_address, chunk=7)


def broken(packages: object) -> dict:
    raise ImportError("none")


@needs_dask
def test_workers_are_awaited_and_the_loss_of_a_scheduler_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, alone: Record
) -> None:
    from distributed import Client, LocalCluster

    def lost(*_: object, **__: object) -> None:
        raise OSError("stream is closed")

    with LocalCluster(
        n_workers=0, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        add = threading.Timer(1.0, cluster.scale, args=(1,))
        add.start()
        bitwise(toy.run(cluster=cluster.scheduler_address, chunk=7), alone)
        add.join()
        assert caplog.text.count("waiting for workers: start them with `dask worker") == 1
        monkeypatch.setattr(Client, "submit", lost)
        with pytest.raises(ConfigError, match=r"scheduler of the sweep does not answer .*closed.* go on with --resume"):
            toy.run(cluster=cluster.scheduler_address, chunk=7)


def answer(port: int) -> bytes:
    """What a port of this machine answers to a web browser."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5) as ours:
            ours.sendall(b"GET / HTTP/1.0\r\n\r\n")
            return ours.recv(100)
    except OSError:
        return b""


class Busy:
    """Numbers of trials that run now, and that ran at once at most, in this process."""

    lock, now, most = threading.Lock(), 0, 0


def counted(parameters: dict, draws) -> dict:
    with Busy.lock:
        Busy.now += 1
        Busy.most = max(Busy.most, Busy.now)
    time.sleep(0.1)
    with Busy.lock:
        Busy.now -= 1
    return toy.trial(parameters, draws)


@needs_dask
def test_workers_that_come_late_get_work() -> None:
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None, silence_logs=50
    ) as cluster:
        add = threading.Timer(0.5, cluster.scale, args=(8,))
        add.start()
        # the queue of the single worker at the start holds 4 chunks
        toy.run(trial=counted, cluster=cluster.scheduler_address, chunk=1, trials=25)
        add.join()
    assert Busy.most > 4


@needs_dask
def test_workers_listen_on_loopback_and_never_to_web_browsers_or_other_users(monkeypatch: pytest.MonkeyPatch) -> None:
    import psutil
    from distributed import Client

    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    found, ended = dict[tuple[str, int], bytes](), threading.Event()

    def look() -> None:
        while not ended.is_set():
            for process in (us := psutil.Process(), *us.children(recursive=True)):
                with suppress(psutil.Error):
                    ports = [one.laddr for one in process.net_connections("tcp") if one.status == psutil.CONN_LISTEN]
                    for ip, port in {(one.ip, one.port) for one in ports} - set(found):
                        found[ip, port] = answer(port)
            time.sleep(0.01)

    looking = threading.Thread(target=look)
    looking.start()
    try:
        with engine(workers=2) as ours:
            address = ours.client.scheduler.address
            assert set(ours.client.run(os.getenv, "OMP_WAIT_POLICY").values()) == {"PASSIVE"}
            work = Work(toy.trial, make_grid(toy.GRID, ["snr_db"]), Draws(5))
            assert len([*ours.results(work, [(Chunk(0, (0,), (0,)), None)])]) == 1
            with pytest.raises((OSError, TypeError)):
                Client(address, timeout=2)
            with pytest.raises(OSError):
                Client(address.replace("tls", "tcp"), timeout=2)
    finally:
        ended.set()
        looking.join()
    assert address.startswith("tls://127.0.0.1") and {ip for ip, _ in found} == {"127.0.0.1"}
    assert not [text for text in found.values() if text.startswith(b"HTTP")]
    assert len(found) == 5  # the scheduler, two workers and their nannies


@pytest.mark.slow
@needs_dask
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_the_script_for_slurm_sweeps_and_takes_work_from_nobody_else(tmp_path: Path) -> None:
    from distributed import Client, Security

    with socket.socket() as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    page = (Path(__file__).parents[2] / "docs" / "how_to" / "sweeps.md").read_text(encoding="utf-8")
    key, script = (block for block in re.findall(r"```text\n(.*?)```", page, re.DOTALL) if "tls" in block.lower())
    config = write_tiny(tmp_path, sweep={"world.noise.snr_db": [0.0], "trials": 400, "chunk": 4})
    for shown, here in (
        ("8786", str(port)),
        ("srun --overlap ", ""),
        ("source ", ". ./"),
        ("torchsar sweep CONFIG", f"{sys.executable} -m torchsar sweep {config} --out result"),
    ):
        script = script.replace(shown, here)
    (tmp_path / "key.sh").write_text(key, encoding="utf-8")
    (tmp_path / "sweep.sh").write_text(script, encoding="utf-8")
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    there = {**os.environ, "HOME": str(tmp_path), "PATH": path, "PYTHONPATH": str(Path(__file__).parents[2])}
    said = tmp_path / "said.txt"
    with said.open("w") as file:
        job = subprocess.Popen(
            ["bash", "sweep.sh"], cwd=tmp_path, env=there, stdout=file, stderr=file, start_new_session=True
        )
    try:
        done, deadline = None, time.monotonic() + 120
        while done is None or not done.any():
            assert job.poll() is None and time.monotonic() < deadline, said.read_text()
            time.sleep(0.2)
            done = marked(tmp_path / "result")
        for address, security in (("tcp", None), ("tls", None), ("tls", Security.temporary())):
            with pytest.raises((OSError, TypeError)):
                Client(f"{address}://localhost:{port}", timeout=5, security=security)
        with pytest.raises(ConfigError, match=r"tls://\S+ does not answer"), engine(cluster=f"tls://localhost:{port}"):
            pytest.fail("must not begin")
    finally:
        os.killpg(job.pid, signal.SIGKILL)
