"""A store that machines share: what one made another one fetches, and what is damaged there is made again.

Evidence: two folders stand for two machines, fsspec's file system in memory for what they share."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.runs import run, store
from egvs.runs.store import RemoteStore, Store
from tests.runs.test_store import digests, states

URL = "memory://shared/store"


@pytest.fixture
def shared(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The file system of the shared store, empty."""
    fs = fsspec.filesystem("memory")
    monkeypatch.setenv("EGVS_STORE", URL)
    yield fs
    fs.store.clear()
    fs.pseudo_dirs[:] = [""]


def machine(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Another machine: a folder to work in, and a cache with nothing in it."""
    folder.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.slow
def test_machine_fetches_entry_of_another_machine(
    mini: Path, tmp_path: Path, shared: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = egvs.load(mini)
    one = machine(tmp_path / "one", monkeypatch)
    assert set(states(scenario, one / "out").values()) == {"done"}
    other = machine(tmp_path / "other", monkeypatch)
    assert set(states(scenario, other / "out").values()) == {"fetched"}
    assert digests(other / "out") == digests(one / "out")
    names = {path.rpartition("/")[2] for path in shared.ls("/shared/store", detail=False)}
    assert names == {entry.folder.name for entry in Store(other / "cache" / "egvs" / "store").entries()}
    assert set(states(scenario, other / "again").values()) == {"fetched"}  # from this machine's folder


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["bytes", "missing", "record", "climbs"])
def test_damaged_remote_entry_is_made_again(
    damage: str, mini: Path, tmp_path: Path, shared: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = egvs.load(mini)
    one = machine(tmp_path / "one", monkeypatch)
    states(scenario, one / "out")
    (tpog,) = shared.glob("/shared/store/tpog-*")
    match damage:
        case "bytes":
            shared.pipe_file(f"{tpog}/tpog.parquet", b"other")
        case "missing":
            shared.rm_file(f"{tpog}/tpog.parquet")
        case "record":
            shared.pipe_file(f"{tpog}/entry.json", b"{")
        case "climbs":
            record = json.loads(shared.cat_file(f"{tpog}/entry.json"))
            record["artefacts"] = {"../../../tpog.parquet": "0" * 64}
            shared.pipe_file(f"{tpog}/entry.json", json.dumps(record).encode())
    other = machine(tmp_path / "other", monkeypatch)
    seen = states(scenario, other / "out")
    del seen["report"]  # made again where what it shows of the stages' cost differs
    assert seen.pop("tpog") == "done"
    assert set(seen.values()) == {"fetched"}
    third = machine(tmp_path / "third", monkeypatch)
    assert states(scenario, third / "out")["tpog"] == "fetched"
    assert digests(third / "out") == digests(one / "out")
    assert not (tmp_path / "tpog.parquet").exists()


def test_entry_without_record_is_ignored(shared: Any, tmp_path: Path) -> None:
    shared.pipe_file("/shared/store/tpog-x/tpog.parquet", b"half")
    assert not RemoteStore(URL).fetch("tpog-x", tmp_path)


def test_unreachable_store_is_reported_once(
    mini: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    machine(tmp_path / "one", monkeypatch)
    (tmp_path / "file").write_text("no folder")
    url = f"file://{tmp_path / 'file'}/store"
    monkeypatch.setenv("EGVS_STORE", url)
    run.run(egvs.load(mini), tmp_path / "out")
    told = [line for line in capsys.readouterr().err.splitlines() if url in line]
    assert told and all("The run continues without it" in line for line in told)
    with pytest.raises(InputError, match="cannot be written"):
        RemoteStore(url).check()


def test_rejects_unknown_url_scheme() -> None:
    with pytest.raises(InputError, match=r"nowhere://x: cannot be reached .*\. Check that this machine may read and"):
        RemoteStore("nowhere://x")


def test_environment_variables_select_store(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EGVS_STORE", "s3://bucket/store")
    assert store.read_store_settings()[0] == store.default_folder()
    assert store.remote_url() == "s3://bucket/store"
    with store.use_store("/a/folder", 5.0):
        assert store.read_store_settings() == (Path("/a/folder"), 5.0)
        assert store.remote_url() is None
    monkeypatch.setenv("EGVS_STORE", "")
    assert store.read_store_settings()[0] is None
    assert store.remote_url() is None


def test_check_leaves_remote_store_unchanged(shared: Any) -> None:
    RemoteStore(URL).check()
    assert not shared.find("/shared")
