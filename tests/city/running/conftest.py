"""A cluster of threads of this process, and jobs of small junctions: what tests of city runs share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from egvs.city import scheduler
from egvs.city.tasks import Job
from tests.conftest import write_mini


@pytest.fixture(scope="session")
def client() -> Iterator[Any]:
    """Two workers in this process: all that another process would do, but for being killed."""
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


@pytest.fixture
def jobs(tmp_path: Path) -> list[Job]:
    """Three small junctions, each with one pole more than the one before."""
    made = []
    for number, name in enumerate(("a", "b", "c")):
        folder = write_mini(tmp_path / name)
        more = "".join(f"pole_{i},{12 + i}.25,-11,3.5\n" for i in range(number))
        (folder / "sites.csv").write_text((folder / "sites.csv").read_text() + more)
        made.append(Job(name, folder, tmp_path / "out" / name))
    return made


@pytest.fixture
def here(client: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """City runs take the cluster of this process."""

    @contextmanager
    def connected(_where: str) -> Iterator[Any]:
        yield client

    monkeypatch.setattr(scheduler, "connect", connected)
