"""A Dask scheduler and workers as processes of their own, which tests can kill."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from egvs.extensions.city import worker_pool

START_TIMEOUT_S = 120.0
SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"
WORKER = "from distributed.cli.dask_worker import main; main()"
ENVIRONMENT = {"DASK_LOGGING__DISTRIBUTED": "critical", "PYTHONWARNINGS": "ignore"}


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.05)


class RealCluster:
    """A scheduler and workers, each a process of its own without a nanny."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        file = folder / "scheduler.json"
        options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", file]
        self.scheduler = self._start([sys.executable, "-c", SCHEDULER, *options])
        wait_until(file.exists)
        from distributed import Client

        self.client = Client(scheduler_file=str(file), set_as_default=False)

    def start_worker(self, name: str, *, package: Path | None = None, without: Path | None = None) -> int:
        """Start a worker, and return its process when it has connected.

        Parameters
        ----------
        name
            Name of the worker.
        package
            Folder that contains another version of the program.
        without
            Folder that the worker shall not see.
        """
        words = [
            sys.executable, "-c", WORKER, self.client.scheduler.address, "--nthreads", "1", "--no-nanny",
            "--no-dashboard", "--name", name, "--local-directory", str(self._folder / name),
        ]  # fmt: skip
        if without is not None:
            hide = 'mount -t tmpfs none "$0" && exec "$@"'
            words = ["unshare", "--map-root-user", "--mount", "sh", "-c", hide, str(without), *words]
        process = self._start(words, {} if package is None else {"PYTHONPATH": str(package)})
        wait_until(lambda: name in self.names().values())
        return process.pid

    def names(self) -> dict[str, str]:
        """Return the names of the connected workers by address."""
        return {address: worker["name"] for address, worker in worker_pool.connected_workers(self.client).items()}

    def kill_scheduler(self) -> None:
        """Kill the scheduler, and wait until the workers that it leaves have ended."""
        self.scheduler.kill()
        for process in self._processes:
            process.wait(START_TIMEOUT_S)

    def close(self) -> None:
        self.client.close()
        for process in self._processes:
            process.kill()
            process.wait()

    def _start(self, words: list[Any], environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        variables = {**os.environ, **ENVIRONMENT, **(environment or {})}
        with (self._folder / "log.txt").open("ab") as log:
            process = subprocess.Popen(list(map(str, words)), env=variables, stdout=log, stderr=log)
        self._processes.append(process)
        return process
