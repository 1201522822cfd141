"""Tasks in processes of this machine and on a scheduler's workers; some are killed."""

import os
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil
import pytest
from distributed import LocalCluster

import uwsfm
from uwsfm._base.signals import STOPPING
from uwsfm._base.tasks import RETRIES, Workers
from uwsfm.errors import InputError, UwsfmError
from uwsfm.jobs.demo import sample_dir
from uwsfm.rig.file import load_rig
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.start import match_images
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.workspace import Workspace


def square(number: int) -> int:
    return number**2


def refuse(number: int) -> int:
    raise InputError(f"number {number} is refused")


def misbehave(number: int, folder: Path) -> tuple[int, int]:
    """Number 3 takes its process along, once; 4 fails as often as is forgiven; 5 is
    refused."""
    trial = len(list(folder.glob(f"{number}-*")))
    (folder / f"{number}-{trial}").touch()
    if number == 3 and trial == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if number == 4 and trial < RETRIES:
        raise OSError("disk full")
    if number == 5:
        refuse(number)
    return number, os.getpid()


def test_one_process_does_all_in_order(tmp_path):
    seen = []
    with Workers(max_processes=1) as workers:
        found = workers.run(
            square, [(k,) for k in range(5)], "squares", lambda *s: seen.append(s)
        )
        with pytest.raises(InputError, match="number 2 is refused"):
            workers.run(refuse, [(2,), (3,)], "refusing")
    assert found == [0, 1, 4, 9, 16]
    assert seen == [("squares", k, 5) for k in range(6)]


def test_processes_die_and_stumble_and_the_results_are_all_there(tmp_path):
    with Workers(max_processes=2) as workers:
        tasks = [(number, tmp_path) for number in range(8)]
        found = workers.outcomes(misbehave, tasks, "misbehaving")
    refused = found.pop(5)
    assert isinstance(refused, InputError) and str(refused) == "number 5 is refused"
    assert [number for number, _ in found] == [0, 1, 2, 3, 4, 6, 7]
    assert os.getpid() not in [process for _, process in found]
    # What was fatal was done twice, and what is wrong is not tried again for that. A
    # result that the dead process still held is made once more.
    counts = [len(list(tmp_path.glob(f"{number}-*"))) for number in (3, 4, 5)]
    assert counts[0] == 2
    assert counts[1] in (RETRIES + 1, RETRIES + 2)
    assert counts[2] in (1, 2)


class Strangers:
    """Another user of the machine, who tries all ports of some processes."""

    def __init__(self) -> None:
        self.ports: dict[int, list[str]] = {}
        """What could be done at each port that somebody listens on."""
        self.command_lines = ""

    def __call__(self, step: str, done: int, total: int | None) -> None:
        if done != 1 or self.ports:
            return
        for process in psutil.Process().children(recursive=True):
            self.command_lines += " ".join(process.cmdline())
            for each in process.net_connections(kind="tcp"):
                if each.status == psutil.CONN_LISTEN:
                    assert each.laddr.ip in ("127.0.0.1", "::1")
                    self.ports[each.laddr.port] = list(self._tried(each.laddr.port))

    def _tried(self, port: int) -> Iterator[str]:
        """What a port answers. A scheduler of Dask greets whom it accepts."""
        ask = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        ask.check_hostname, ask.verify_mode = False, ssl.CERT_NONE
        for how, words in (
            ("plain", b""),
            ("TLS", b""),
            ("page", b"GET /status HTTP/1.0\r\n\r\n"),
            ("page", b"GET /health HTTP/1.0\r\n\r\n"),
        ):
            address = ("127.0.0.1", port)
            with (
                suppress(OSError),  # SSLError and timeouts are
                socket.create_connection(address, timeout=0.5) as raw,
            ):
                line = ask.wrap_socket(raw) if how == "TLS" else raw
                line.sendall(words)
                answer = line.recv(64)
                if answer and b" 404 " not in answer:
                    yield f"{how}: {answer!r}"


def test_a_stranger_does_reach_an_open_scheduler():
    """What the next test would see without keys."""
    with LocalCluster(
        n_workers=0, processes=False, protocol="tcp://", dashboard_address=None
    ) as cluster:
        port = int(cluster.scheduler_address.rpartition(":")[2])
        assert any(each.startswith("plain") for each in Strangers()._tried(port))


@pytest.mark.slow
def test_no_stranger_reaches_the_processes_of_this_machine(tmp_path):
    strangers = Strangers()
    with Workers(folder=tmp_path, max_processes=2) as workers:
        assert workers.run(square, [(2,), (3,)], "squares", strangers) == [4, 9]
    assert len(strangers.ports) >= 3  # a scheduler and two workers
    assert {p: done for p, done in strangers.ports.items() if done} == {}
    assert "PRIVATE KEY" not in strangers.command_lines
    assert not any("DASK_DISTRIBUTED__COMM" in name for name in os.environ)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("scheduler", "refusal"),
    [
        ("nonsense", "scheduler must be .* got 'nonsense'"),
        ("tcp://127.0.0.1:1", "no Dask scheduler answers at tcp://127.0.0.1:1"),
    ],
)
def test_where_no_scheduler_is_nothing_is_written(
    scheduler, refusal, tmp_path, monkeypatch
):
    monkeypatch.setattr("uwsfm._base.tasks.CONNECT_SECONDS", 1)  # a refusal takes none
    with pytest.raises(InputError, match=refusal):
        uwsfm.reconstruct(
            sample_dir() / "rig.yaml",
            sample_dir() / "images",
            tmp_path / "out",
            scheduler=scheduler,
            report=False,
        )
    assert not (tmp_path / "out").exists()


STOPPED = """
import psutil, time
from uwsfm.cli import app as cli

@cli.app.command()
def wait():
    import pycolmap
    from uwsfm.cli.console import ProgressBars
    from uwsfm._base.tasks import Workers

    def start(step, done, total):
        children = psutil.Process().children(recursive=True)
        print(*[child.pid for child in children], flush=True)

    with ProgressBars(), Workers(max_processes=2) as workers:
        workers.run(nap, [(0,), (60,), (60,)], "naps", start)

def nap(seconds):
    import numpy, pycolmap
    time.sleep(seconds)

import sys
sys.argv = ["uwsfm", "wait"]
cli.main()
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="it has no SIGTERM")
def test_a_signal_to_the_whole_group_ends_all_processes_without_a_word():
    """As from `timeout` or a terminal: none of them complains that others are gone."""
    process = subprocess.Popen(
        [sys.executable, "-c", STOPPED],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    process.stdout.readline()  # none has started
    children = [int(word) for word in process.stdout.readline().split()]
    assert len(children) >= 3  # a scheduler and two workers, with who watches them
    os.killpg(process.pid, signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 143
    told = errors.removeprefix(f"{STOPPING}\n")  # on a busy machine
    assert told == "interrupted; the same command resumes the run\n"
    deadline = time.monotonic() + 10.0  # they were killed; somebody has to notice
    while any(psutil.pid_exists(child) for child in children):
        assert time.monotonic() < deadline
        time.sleep(0.1)


ORPHANS = """
import os, psutil, signal, sys, time
from pathlib import Path
from uwsfm._base.tasks import Workers

def kill(step, done, total):
    if done == 1:
        children = psutil.Process().children(recursive=True)
        print(*[child.pid for child in children], flush=True)
        os.kill(os.getpid(), signal.SIGKILL)

with Workers(folder=Path(sys.argv[1]), max_processes=2) as workers:
    workers.run(time.sleep, [(1.0,), (60.0,), (60.0,)], "sleeping", kill)
"""


@pytest.mark.slow
def test_processes_end_when_who_started_them_is_killed(tmp_path):
    """In the midst of their tasks. No script guards its main part, and none has to; the
    next run clears up."""
    command = [sys.executable, "-c", ORPHANS, str(tmp_path / "work")]
    found = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    assert found.returncode == -signal.SIGKILL
    assert len(list((tmp_path / "work").iterdir())) == 1
    Steps(tmp_path / "work")
    orphans = [int(word) for word in found.stdout.split()]
    assert len(orphans) >= 3  # a scheduler and two workers, with who watches them
    deadline = time.monotonic() + 10.0  # they look every second
    while any(psutil.pid_exists(orphan) for orphan in orphans):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert not list((tmp_path / "work").iterdir())


@contextmanager
def dask_cluster(folder: Path) -> Iterator[str]:
    """A scheduler and two workers, as on other machines: another current folder, and
    nothing of this process."""
    place = folder / "scheduler.json"
    common = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker"]
    (folder / "elsewhere").mkdir()
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
    }
    processes = [
        subprocess.Popen(
            [*dask, "--host=127.0.0.1", "--port=0", "--no-dashboard"]
            + [f"--scheduler-file={place}"],
            **common,
        )
    ]
    try:
        import distributed

        processes += [
            subprocess.Popen(
                [
                    *worker,
                    f"--scheduler-file={place}",
                    "--nthreads=1",
                    "--no-dashboard",
                ],
                cwd=folder / "elsewhere",
                env=environment,
                **common,
            )
            for _ in range(2)
        ]
        with distributed.Client(scheduler_file=str(place), timeout=30) as client:
            client.wait_for_workers(2, timeout=30)
            address = client.scheduler.address
        yield address
    finally:
        for process in reversed(processes):
            process.terminate()
        for process in processes:
            process.wait(timeout=20)


def test_an_address_without_a_scheduler_is_told():
    with pytest.raises(InputError, match="must be 'local' or an address"):
        Workers("cluster")


@pytest.mark.slow
def test_workers_elsewhere_find_the_same_features_and_matches(tmp_path):
    """Six images: the databases' rows are those of this process, bit by bit."""
    images = tmp_path / "images"
    for folder in ("left", "right"):
        (images / folder).mkdir(parents=True)
        for source in sorted((sample_dir() / "images" / folder).iterdir())[:3]:
            (images / folder / source.name).symlink_to(source)
    rig = load_rig(sample_dir() / "rig.yaml")
    frames = find_frames(images, rig)
    options = StartOptions(num_threads=1)
    found = {}
    with dask_cluster(tmp_path) as address:
        for name, scheduler in (("here", "local"), ("there", address)):
            space = Workspace(work_dir=tmp_path / name)
            steps = Steps(space.work_dir)
            with Workers(scheduler, space.work_dir) as workers:
                match_images(
                    rig, frames, steps, space, options, lambda *_: None, workers
                )
            found[name] = rows_of(space.features)
            assert not list(space.work_dir.glob("features*"))
        with (
            Workers(address) as workers,
            pytest.raises(InputError, match=r"worker tcp://.* does not see .*/missing"),
        ):
            workers.require_sight(tmp_path / "missing")
    for name in ("keypoints", "descriptors", "matches"):
        here, there = (found[place][name] for place in ("here", "there"))
        assert here.keys() == there.keys()
        for key, rows in here.items():
            np.testing.assert_array_equal(rows, there[key])
    with pytest.raises(UwsfmError, match="no Dask scheduler answers at tcp://"):
        Workers(address)


def rows_of(path: Path) -> dict[str, dict]:
    """Everything in a database of features, by the names of the images."""
    with opened(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        names = sorted(ids)
        pairs = [(a, b) for a in names for b in names if a < b]
        return {
            "keypoints": {n: database.read_keypoints(ids[n]) for n in names},
            "descriptors": {n: database.read_descriptors(ids[n]).data for n in names},
            "matches": {
                (a, b): database.read_matches(ids[a], ids[b]) for a, b in pairs
            },
        }
