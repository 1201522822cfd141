"""Independent pieces of work, here or on the workers of a Dask cluster.

Dask (`dask.distributed`) carries, repeats and counts the tasks. A task is a function of
a module and its arguments; what is large goes through files of a folder that all
workers see, written beside their place and renamed: a task that is done twice, because
its worker died, does no harm.
"""

from __future__ import annotations

import logging
import os
import pickle
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from uwsfm._base.children import SAFE_PATH, import_path
from uwsfm._base.cluster_keys import secrets_of
from uwsfm._base.partial import scratch_folder
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError, UwsfmError

if TYPE_CHECKING:
    from distributed import Client, Future

Result = TypeVar("Result")

logger = logging.getLogger(__name__)

LOCAL = "local"
RETRIES = 2
"""Of a task that fails for another reason than its input: a full disk, say."""
CONNECT_SECONDS = 5
ENDS_WITH_PARENT = """
import os, signal, sys, threading, time

def dask_setup(server):
    sys.path[:] = {path!r}

def watch():
    while os.getppid() == {parent}:
        time.sleep(1.0)
    os.killpg(0, signal.SIGKILL)

os.setpgrp()
threading.Thread(target=watch, daemon=True).start()
"""
"""What the processes of this machine run first, for they import what this one does.

A group of their own: Ctrl-C and `timeout` mean whole groups; this process is to end the
others, in order, before they complain of each other. When it is killed, nobody does,
and a worker in the midst of a task would keep the lock of an output folder.
"""
BYTES_PER_WORKER = 1.5e9
"""That a submap of 200 frames with 4000 features per image needs at its peak, about."""


class Workers:
    """Where tasks run.

    Args:
        scheduler: "local": processes of this machine, which start when there is more
            than one task for them; or the address of a Dask scheduler.
        folder: Through which tasks exchange files; see `require_sight`. Processes of
            this machine keep theirs there, too; None: in the temporary folder.
        max_processes: Of this machine; one is this process itself. None: as many as
            there are cores, and memory for.

    Raises:
        InputError: an address that is none, no scheduler or no worker there, or a
            worker that does not see the folder.
    """

    def __init__(
        self,
        scheduler: str = LOCAL,
        folder: Path | None = None,
        max_processes: int | None = None,
    ) -> None:
        self.scheduler = scheduler
        self.num_processes = local_workers()
        if max_processes is not None:
            self.num_processes = min(self.num_processes, max_processes)
        self._folder = None if folder is None else folder.absolute()
        self._client: Client | None = None
        self._resources = ExitStack()
        require_address(scheduler)
        if self.elsewhere:
            self._connect()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @property
    def elsewhere(self) -> bool:
        """Whether a scheduler was named."""
        return self.scheduler != LOCAL

    def run(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        step: str,
        progress: Progress = silent,
    ) -> list[Result]:
        """``[function(*a) for a in arguments]``, in any order.

        Args:
            function: One that may be called twice with the same arguments.
            arguments: Of each task; picklable, and small.
            step: Name for the progress, in tasks.
            progress: Called with it.

        Raises:
            UwsfmError: what the first task that failed so raised; or a task lost its
                worker again and again.
        """
        if not self.elsewhere and min(len(arguments), self.num_processes) < 2:
            progress(step, 0, len(arguments))
            results = []
            for done, each in enumerate(arguments, start=1):
                results.append(function(*each))
                progress(step, done, len(arguments))
            return results
        found: dict[int, Result] = {}
        with closing(self._finished(function, arguments, step, progress)) as finished:
            for index, outcome in finished:
                if isinstance(outcome, UwsfmError):
                    raise outcome
                found[index] = outcome
        return [found[index] for index in range(len(arguments))]

    def outcomes(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        step: str,
        progress: Progress = silent,
    ) -> list[Result | UwsfmError]:
        """`run`, where what stops a task does not stop the others: it is the task's
        result. Tasks never run in this process, which one could take along."""
        finished = self._finished(function, arguments, step, progress)
        found = dict(finished)
        return [found[index] for index in range(len(arguments))]

    def _finished(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        step: str,
        progress: Progress,
    ) -> Generator[tuple[int, Result | UwsfmError], None, None]:
        """Tasks as they end: which one, and its result or why there is none."""
        import cloudpickle
        from distributed import as_completed

        progress(step, 0, len(arguments))
        with ExitStack() as processes:
            client = self._client or self._start_processes(processes)
            futures = client.map(
                _call,
                [(sys.path, cloudpickle.dumps((function, each))) for each in arguments],
                key=[f"{step}-{os.urandom(8).hex()}" for _ in arguments],
                retries=RETRIES,
                pure=False,
            )
            processes.callback(client.cancel, futures)
            place = {future.key: index for index, future in enumerate(futures)}
            for done, future in enumerate(as_completed(futures), start=1):
                yield place[future.key], _result_of(future, step)
                progress(step, done, len(arguments))

    def _start_processes(self, processes: ExitStack) -> Client:
        """A cluster of processes of one thread each, which end with the stack.

        They are started by command line: a process that is spawned from here would run
        the caller's script again. If this one is killed, they end by themselves. Who
        can reach a scheduler can run code as its user: all of them speak TLS, with keys
        that nobody else has, and none serves a page.
        """
        import dask
        from distributed import Client, LocalCluster, SubprocessCluster
        from distributed.security import Security

        _log_as_all_do()
        logger.info("starting %d worker processes", self.num_processes)
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
        # In a workspace, what a killed run could not remove is gone with the next.
        scratch = str(processes.enter_context(scratch_folder(self._folder)))
        security = Security.temporary()
        common: dict[str, Any] = {
            "security": security,
            "n_workers": self.num_processes,
            "threads_per_worker": 1,
            "dashboard_address": None,
            "silence_logs": logging.ERROR,
        }
        each: dict[str, Any] = {
            "local_directory": scratch,
            "dashboard": False,
            "env": {"NUMBA_NUM_THREADS": "1"},  # whatever is set here
        }
        preload = [ENDS_WITH_PARENT.format(parent=os.getpid(), path=import_path())]
        with (
            _careful_starts(secrets_of(security)),
            dask.config.set({"temporary-directory": scratch}),
        ):
            if sys.platform == "win32":  # where processes can only be spawned
                cluster = LocalCluster(**common, **each, protocol="tls://")
            else:
                cluster = SubprocessCluster(
                    **common,
                    worker_kwargs={**each, "preload_nanny": preload},
                    scheduler_kwargs={
                        "protocol": "tls://",
                        "dashboard": False,
                        "dashboard_address": "127.0.0.1:0",  # an empty page
                        "preload": preload,
                        "local_directory": scratch,
                        # Dask removes it at its end, if it gets there: our folder is.
                        "scheduler_file": os.path.join(scratch, "scheduler.json"),
                    },
                )
        processes.callback(cluster.close)
        client = Client(cluster)
        processes.callback(client.close)
        return client

    def _connect(self) -> None:
        from distributed import Client

        _log_as_all_do()
        with _quiet_dask():
            try:
                client = Client(self.scheduler, timeout=CONNECT_SECONDS)
            except (OSError, ValueError) as error:
                raise InputError(
                    f"no Dask scheduler answers at {self.scheduler}: "
                    f"{str(error).splitlines()[0]}"
                ) from None
        self._resources.callback(client.close)
        try:
            self._check_workers(client)
        except BaseException:
            self._resources.close()
            raise
        self._client = client

    def _check_workers(self, client: Client) -> None:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(f"the Dask scheduler at {self.scheduler} has no worker")
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=self._folder, prefix="seen-") as file:
                self._check_sight(client, Path(file.name), self._folder)

    def require_sight(self, path: Path) -> None:
        """See to it that all workers have a file or folder under the same path.

        Raises:
            InputError: one has not; names it.
        """
        if self.elsewhere and self._client is not None:
            self._check_sight(self._client, path, path)

    def _check_sight(self, client: Client, path: Path, named: Path) -> None:
        try:
            seen = client.run(_sees, str(path.absolute()))
        except ImportError as error:
            raise InputError(
                f"a worker of {self.scheduler} cannot import uwsfm: {error}"
            ) from None
        for worker, there in seen.items():
            if not there:
                raise InputError(
                    f"worker {worker} does not see {named.absolute()}: every worker "
                    "must have it under the same path"
                )


def require_address(scheduler: str) -> None:
    """Refuse what is no scheduler, before any work is done.

    Raises:
        InputError: it is neither "local" nor an address.
    """
    if scheduler != LOCAL and "://" not in scheduler:
        raise InputError(
            f"scheduler must be 'local' or an address as tcp://host:8786, got "
            f"{scheduler!r}"
        )


def require_threads(num_threads: int) -> None:
    """Refuse a number of threads or processes that does no work.

    Raises:
        InputError: it is neither positive nor -1, all cores.
    """
    if num_threads == 0 or num_threads < -1:
        raise InputError(
            "--threads (num_threads) must be positive, or -1 for all cores, got "
            f"{num_threads}"
        )


def local_workers() -> int:
    """How many processes this machine has room for."""
    import psutil

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    free = int(psutil.virtual_memory().available / BYTES_PER_WORKER)
    return max(1, min(cores or os.cpu_count() or 1, free))


def _result_of(future: Future, step: str) -> Any:
    """Of a task; an error that says so if its worker or the scheduler was lost."""
    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    try:
        return future.result()
    except KilledWorker:
        return UwsfmError(
            f"{step}: a task lost its worker again and again, for want of memory "
            "perhaps: give it more, or fewer workers"
        )
    except FutureCancelledError:
        return UwsfmError(f"{step}: the scheduler went away")


def _call(packed: tuple[list[str], bytes]) -> Any:
    """What a worker does. Wrong input comes back as a result: no use to try again.

    Modules that it has not are looked for where this process has them: those of a
    script, on a disk that is shared.
    """
    paths, task = packed
    os.environ.setdefault("NUMBA_NUM_THREADS", "1")  # tasks share the cores
    sys.path.extend(path for path in paths if path and path not in sys.path)
    import numpy  # noqa: F401  before pycolmap, which unpickling may import
    from threadpoolctl import threadpool_limits

    function, arguments = pickle.loads(task)
    with threadpool_limits(1):
        try:
            return function(*arguments)
        except UwsfmError as error:
            return error


def _sees(path: str) -> bool:
    return os.path.exists(path)


@contextmanager
def _careful_starts(secrets: Mapping[str, str]) -> Iterator[None]:
    """Processes that are started tell errors only, from their first line on, import
    nothing from the working folder, and know secrets of this one.

    Args:
        secrets: environment variables, see `secrets_of`.
    """
    wanted = {"DASK_LOGGING__DISTRIBUTED": "error", SAFE_PATH: "1", **secrets}
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


def _log_as_all_do() -> None:
    """Importing `distributed` made it tell the command lines of its processes."""
    logging.getLogger("distributed").setLevel(logging.NOTSET)


def _quiet_dask() -> ExitStack:
    """Failures to connect are told once, by us."""
    stack = ExitStack()
    for name in ("distributed.comm", "distributed.client", "distributed.batched"):
        log = logging.getLogger(name)
        stack.callback(log.setLevel, log.level)
        log.setLevel(logging.CRITICAL)
    return stack
