"""Where tasks run: processes of this machine, or a cluster whose scheduler is named; all of it is Dask's."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pipeline.core import parallel, plugins
from pipeline.core.errors import InputError, RunError

if TYPE_CHECKING:
    from distributed import Client

LOCAL = "local"
ADDRESSES = ("tcp://", "tls://")

# malloc's thresholds: by Dask's own, every larger array goes back to the system at once, and its pages are asked for
# anew at each site, which takes a third of a worker's time and no less memory.
_SETTINGS = {
    "distributed.scheduler.allowed-failures": 5,
    "distributed.worker.daemon": True,
    "distributed.worker.profile.enabled": False,
    "distributed.nanny.pre-spawn-environ.DASK_LOGGING__DISTRIBUTED": "critical",
    "distributed.nanny.pre-spawn-environ.MALLOC_MMAP_THRESHOLD_": 2**25,
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": 2**27,
    "distributed.comm.timeouts.connect": "20s",
}

_TALKERS = ("distributed", "distributed.client", "tornado.application")
"""Loggers that have levels of their own."""

_MOST = 1000
"""Processes on one machine."""

LOOK_S = 5.0
"""So often a run that hears nothing looks after the processes of this machine."""

_GONE_S, _MOST_TIMES = 60.0, 3
"""A process that is away for so long is replaced; so often, while nothing is done."""


@contextmanager
def connected(where: str, *, memory_limit: str = "auto") -> Iterator[Client]:
    """A client of the cluster that ``--cluster`` names.

    Parameters
    ----------
    where
        ``local``: a process a core of this machine; ``processes=N``; or the address of a scheduler, ``tcp://host:8786``.
    memory_limit
        Of a process on this machine, as Dask writes it; a process that takes more is ended. Its share of the machine's
        memory by default.

    Raises
    ------
    InputError
        For a word that is none of these, or where no scheduler answers.
    MissingExtraError
        Where Dask is not installed.
    """
    check(where)
    count = _processes(where)
    import dask
    from distributed import Client, LocalCluster  # before the settings: what it adds to them is to stay

    with dask.config.set(_SETTINGS):
        for name in _TALKERS:  # what goes wrong is told by the run
            logging.getLogger(name).setLevel(logging.CRITICAL)
        if count is None:
            try:
                client = Client(where, timeout="20s", set_as_default=False)
            except (OSError, ValueError) as error:
                right = "the address of a running dask scheduler"
                raise InputError(f"--cluster {where}", f"no scheduler answers there ({error})", right) from None
            with client:
                yield client
            return
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", memory_limit=memory_limit,
                dashboard_address="127.0.0.1:0",
            ) as cluster,
            Client(cluster, set_as_default=False) as client,
        ):  # fmt: skip
            yield client


class Crew:
    """The processes of a cluster on this machine: Dask starts one again that was ended, but not when it is ended while
    it starts; then nobody would do its work, and the run would wait for ever. Of another cluster nothing is asked.

    Parameters
    ----------
    client
        Of the cluster.
    """

    def __init__(self, client: Client) -> None:
        self._client, self._times = client, 0
        self._looked = self._all_there = time.monotonic()

    def works(self) -> None:
        """Something was done."""
        self._times = 0

    def look(self) -> None:
        """Replace processes that are away for long, if it is time to look; RunError where that was of no use."""
        cluster, now = self._client.cluster, time.monotonic()
        if cluster is None or now - self._looked < LOOK_S:
            return
        self._looked = now
        there = {its["name"] for its in self._client.scheduler_info(n_workers=-1)["workers"].values()}
        gone = [name for name in cluster.worker_spec if name not in there]
        if not gone:
            self._all_there = now
        elif now - self._all_there > _GONE_S:
            if self._times == _MOST_TIMES:
                found = f"{len(gone)} processes of this machine ended as soon as they were started"
                raise RunError(f"{found}; mostly memory is wanting: fewer processes; what is done is kept")
            self._all_there, self._times = now, self._times + 1
            count = len(cluster.worker_spec)
            for name in gone:
                del cluster.worker_spec[name]
            cluster.scale(count)


def check(where: str) -> None:
    """InputError for a word that names no cluster; MissingExtraError where Dask is not installed."""
    _processes(where)
    plugins.require("a city run", "cluster", "dask", "distributed", "fsspec")


def _processes(where: str) -> int | None:
    """How many processes on this machine; None for the address of a scheduler."""
    if where == LOCAL:
        return parallel.threads(None)
    if where.startswith(ADDRESSES) and len(where) > len(ADDRESSES[0]):
        return None
    match = re.fullmatch(r"processes=([0-9]{1,4})", where)
    if match is None or not 1 <= int(match[1]) <= _MOST:
        right = f"local, processes=N (1 to {_MOST}), or the address of a scheduler, for example tcp://host:8786"
        raise InputError("--cluster", repr(where)[:80], right)
    return int(match[1])
