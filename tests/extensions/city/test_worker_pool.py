"""Which workers get tasks: programs and folders are compared, and rejected workers are named.

Slow tests start a Dask scheduler and workers as processes of their own: one with another version of the program, one
whose file system lacks a folder, and some that join later.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core.errors import InputError, RunError
from egvs.extensions.city import scheduler, worker_check, worker_pool
from egvs.extensions.city.tasks import Job, JobResult
from egvs.extensions.city.worker_check import Requirements
from tests.extensions.city.real_cluster import RealCluster, wait_until

pytestmark = pytest.mark.system


@pytest.fixture
def other_version(tmp_path: Path) -> Path:
    """A folder with the program as version 9.9.9."""
    package = tmp_path / "other" / "egvs"
    shutil.copytree(Path(egvs.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(parquet.schema_folder(), package / "data_schemas")
    (package / "_version.py").write_text('__version__ = "9.9.9"\n')
    return package.parent


@pytest.fixture
def requirements(tmp_path: Path) -> Iterator[Requirements]:
    """What workers of a run in a temporary folder must have."""
    for name in ("city", "out"):
        (tmp_path / name).mkdir()
    folders = (str(tmp_path / "city"), str(tmp_path / "out"))
    required = Requirements("12ab", folders, folders[1], worker_check.library_names())
    with worker_pool._token_files(required):
        yield required


def describe_this_process(required: Requirements) -> worker_check.WorkerAnswer:
    return worker_check.describe_worker(
        required.token_name,
        required.token,
        required.folders,
        required.writable,
        required.libraries,
        required.store_url,
    )


def problem_texts(answer: worker_check.WorkerAnswer, required: Requirements) -> list[str]:
    return [problem.text for problem in worker_check.find_problems(answer, required)]


def test_accepts_same_program_and_folders(requirements: Requirements) -> None:
    assert problem_texts(describe_this_process(requirements), requirements) == []
    assert [path.name for path in Path(requirements.writable).iterdir()] == [requirements.token_name]


def test_token_files_are_removed(tmp_path: Path, requirements: Requirements) -> None:
    other = replace(requirements, token="34cd")
    stale = tmp_path / "city" / f"{worker_check.TOKEN_PREFIX}5678"
    stale.write_text("")
    os.utime(stale, (1e9, 1e9))
    with worker_pool._token_files(other):
        assert {path.name for path in (tmp_path / "city").iterdir()} == {requirements.token_name, other.token_name}
    assert [path.name for path in (tmp_path / "city").iterdir()] == [requirements.token_name]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("egvs", "egvs: expected {}, got other"),
        ("source", "source: expected {}, got other; the version is the same, but the source code is not"),
        ("numpy", "numpy: expected {}, got other"),
        ("laspy", "laspy: expected none, got other"),
    ],
)
def test_names_differences_of_program(requirements: Requirements, name: str, text: str) -> None:
    answer = describe_this_process(requirements)
    answer["program"] = answer["program"] | {name: "other"}
    expected = text.format(worker_check.program_versions(requirements.libraries).get(name))
    assert problem_texts(answer, requirements) == [
        f"the program differs from the one that started the run ({expected})"
    ]


def test_names_folders_that_worker_lacks(tmp_path: Path, requirements: Requirements) -> None:
    (tmp_path / "city" / requirements.token_name).write_text("another city")
    (tmp_path / "out" / requirements.token_name).unlink()
    texts = problem_texts(describe_this_process(requirements), requirements)
    assert texts == [f"{tmp_path / name} is not visible" for name in ("city", "out")]


def test_names_full_disk(requirements: Requirements) -> None:
    answer = describe_this_process(requirements)
    answer["free_bytes"][requirements.writable] = 1_500_000
    (text,) = problem_texts(answer, requirements)
    assert text == f"{requirements.writable}: expected at least 32 MB of free disk space, got 1.5 MB"


@pytest.mark.slow
def test_source_digest_sees_every_file(other_version: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also effects and schemas, which are found by name; a wheel and a checkout of the same source are equal."""
    package = other_version / "egvs"
    shutil.copyfile(Path(egvs.__file__).parent / "_version.py", package / "_version.py")
    digest = worker_check._source_digest.__wrapped__
    expected = digest()
    monkeypatch.setattr(worker_check, "_PACKAGE_FOLDER", package)
    monkeypatch.setattr(worker_check, "data_folder", lambda name: package / name)
    assert digest() == expected
    for name in ("effects/rain.py", "data_schemas/scores.schema.json", "sensors/catalogue.toml"):
        before = digest()
        with (package / name).open("a") as file:
            file.write("\n")
        assert digest() != before


@pytest.mark.slow
def test_worker_answers_before_it_imports_libraries() -> None:
    code = (
        "import sys; from egvs.extensions.city import worker_check; "
        "worker_check.program_versions(()); print('numpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"


@pytest.mark.slow
def test_other_version_gets_no_task(cluster: RealCluster, jobs: list[Job], other_version: Path, capsys: Any) -> None:
    from distributed import get_task_stream

    cluster.start_worker("other", package=other_version)
    cluster.start_worker("same")
    done: list[JobResult] = []
    with get_task_stream(cluster.client) as stream:
        scheduler.run_jobs(cluster.client, jobs, on_done=done.append)
    assert sorted(result.junction for result in done) == ["a", "b", "c"]
    names = cluster.names()
    assert {names[task["worker"]] for task in stream.data} == {"same"}
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("egvs: worker ")]
    (other,) = [address for address, name in names.items() if name == "other"]
    assert line.startswith(f"egvs: worker {other} (")
    assert f"egvs: expected {egvs.__version__}, got 9.9.9" in line
    assert line.endswith("Install the same version on every machine, and restart the worker.")


@pytest.mark.slow
def test_ends_if_no_worker_is_acceptable(cluster: RealCluster, jobs: list[Job], other_version: Path) -> None:
    for name in ("one", "two"):
        cluster.start_worker(name, package=other_version)
    with pytest.raises(InputError) as caught:
        scheduler.run_jobs(cluster.client, jobs)
    assert caught.value.exit_code == 2
    assert "no connected worker can run this city" in str(caught.value)
    assert "get no tasks: the program differs from the one that started the run" in str(caught.value)
    assert all(address in str(caught.value) for address in cluster.names())


@pytest.mark.slow
def test_worker_without_folder_gets_no_task(cluster: RealCluster, jobs: list[Job], tmp_path: Path, capsys: Any) -> None:
    from distributed import get_task_stream

    try:
        words = ["unshare", "--map-root-user", "--mount", "mount", "-t", "tmpfs", "none", str(tmp_path)]
        subprocess.run(words, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this system does not allow mounts without rights")
    cluster.start_worker("without", without=tmp_path)
    cluster.start_worker("with")
    with get_task_stream(cluster.client) as stream:
        scheduler.run_jobs(cluster.client, jobs)
    assert {cluster.names()[task["worker"]] for task in stream.data} == {"with"}
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("egvs: worker ")]
    assert f"gets no tasks: {tmp_path} is not visible" in line
    assert all((job.out / "scores.parquet").is_file() for job in jobs)


@pytest.mark.slow
def test_late_workers_are_checked(cluster: RealCluster, jobs: list[Job], other_version: Path) -> None:
    from distributed import get_task_stream

    first = cluster.start_worker("first")
    messages: list[str] = []
    done: list[JobResult] = []
    folders = scheduler.job_folders(jobs)
    with scheduler.checked_workers(cluster.client, folders, len(jobs), messages.append) as checked:
        assert (checked.workers.thread_count(), messages) == (1, [])
        cluster.start_worker("other", package=other_version)
        wait_until(lambda: bool(messages))
        os.kill(first, signal.SIGKILL)
        wait_until(lambda: "first" not in cluster.names().values())

        future = cluster.client.submit(len, "abc", resources=checked.workers.resources)
        time.sleep(0.5)
        assert future.status == "pending"  # only the worker of another version is connected
        cluster.start_worker("second")
        assert future.result() == 3
        with get_task_stream(cluster.client) as stream:
            scheduler.run_jobs(cluster.client, jobs, on_done=done.append, cluster=checked)
    assert sorted(result.junction for result in done) == ["a", "b", "c"]
    assert {cluster.names()[task["worker"]] for task in stream.data} == {"second"}
    assert len(messages) == 1
    assert "got 9.9.9" in messages[0]


@pytest.mark.slow
def test_failed_check_ends_the_run(cluster: RealCluster, jobs: list[Job], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        raise KeyError("nthreads")

    cluster.start_worker("first")
    monkeypatch.setattr(worker_pool.WorkerPool, "_update", fail)
    with pytest.raises(RunError, match=r"the check of workers failed .KeyError: 'nthreads'"):
        scheduler.run_jobs(cluster.client, jobs)
