"""The size of the store: adding an entry lists no others, wrong sizes are corrected, entries in use stay.

Entries here are single files of known size, and their times are set.
"""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path

import pytest

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.resource_usage import ResourceUsage
from egvs.runs import store as store_module
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store, entries_in_use
from tests.processes import CONTEXT

SIZE = 1000
"""Bytes of an entry."""


def put(store: Store, number: int, folder: Path) -> str:
    """Save an entry; return its key."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "part.npz").write_bytes(number.to_bytes(8) + bytes(SIZE - 8))
    key = files.hash_json({"number": number})
    digests = {"part.npz": files.hash_file(folder / "part.npz")}
    with store.maker("part", key):
        store.put("part", key, folder, StageResult(digests, {}, {}, ResourceUsage()))
    return key


def set_age(store: Path, key: str, seconds: float) -> None:
    used = time.time() - seconds
    os.utime(store / f"part-{key[:32]}" / "entry.json", (used, used))


def has(store: Path, key: str) -> bool:
    return (store / f"part-{key[:32]}").is_dir()


def recorded_bytes(store: Path) -> int:
    size: int = json.loads((store / ".usage").read_text())["bytes"]
    return size


@pytest.fixture
def lists(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one number whenever all entries are listed."""
    calls: list[int] = []
    entries = Store.entries

    def listed(self: Store) -> list[store_module.StoreEntry]:
        calls.append(1)
        return entries(self)

    monkeypatch.setattr(Store, "entries", listed)
    return calls


@pytest.mark.slow
def test_adding_entries_rarely_lists_them(tmp_path: Path, store: Path, lists: list[int]) -> None:
    for number in range(250):
        put(Store(store), number, tmp_path / "out")
    assert len(lists) == 3  # at the entries 1, 102 and 205
    assert recorded_bytes(store) == 250 * SIZE == Store(store).usage_bytes()


@pytest.mark.parametrize(
    "content", ["", "{", "[]", '{"bytes": -1, "entries": 0}', '{"bytes": "1", "entries": 1}', "null"]
)
def test_damaged_size_is_corrected(tmp_path: Path, store: Path, content: str) -> None:
    keys = [put(Store(store), number, tmp_path / "out") for number in range(3)]
    (store / ".usage").write_text(content)
    assert Store(store).usage_bytes() == 3 * SIZE
    put(Store(store, 10 * SIZE), 3, tmp_path / "out")
    assert recorded_bytes(store) == 4 * SIZE
    assert all(has(store, key) for key in keys)


def test_too_large_size_removes_nothing(tmp_path: Path, store: Path) -> None:
    keys = [put(Store(store), number, tmp_path / "out") for number in range(3)]
    content = json.loads((store / ".usage").read_text())
    (store / ".usage").write_text(json.dumps(content | {"bytes": 10**15}))
    keys.append(put(Store(store, 10 * SIZE), 3, tmp_path / "out"))
    assert all(has(store, key) for key in keys)
    assert recorded_bytes(store) == 4 * SIZE


def test_too_small_size_is_corrected(tmp_path: Path, store: Path) -> None:
    """As after many kills between adding an entry and counting it, or entries of an older version of the program."""
    for number in range(20):
        put(Store(store), number, tmp_path / "out")
    content = json.loads((store / ".usage").read_text())
    (store / ".usage").write_text(json.dumps(content | {"bytes": 0, "entries": 0, "puts": 0}))
    for number in range(20, 121):
        put(Store(store), number, tmp_path / "out")
    assert recorded_bytes(store) == 121 * SIZE
    (store / ".usage").write_text(json.dumps(content | {"bytes": 0, "counted_at": time.time() - 1e6}))
    put(Store(store), 121, tmp_path / "out")
    assert recorded_bytes(store) == 122 * SIZE


def test_full_store_is_reduced_once(tmp_path: Path, store: Path, lists: list[int]) -> None:
    bounded = Store(store, 20 * SIZE)
    keys = []
    for number in range(21):
        keys.append(put(bounded, number, tmp_path / "out"))
        set_age(store, keys[-1], 1000 - number)
    assert [has(store, key) for key in keys] == [False] * 3 + [True] * 18  # 90 % of 20
    n_lists = len(lists)
    for number in range(21, 23):
        put(bounded, number, tmp_path / "out")
    assert len(lists) == n_lists


def _put_many(store: Path, bound_bytes: float, out: Path, numbers: range) -> None:
    for number in numbers:
        bounded = Store(store, bound_bytes)
        key = put(bounded, number, out)
        bounded.take("part", key, out)  # another process may have removed it
        if bound_bytes < math.inf:
            bounded.prune(bound_bytes / 2)


@pytest.mark.slow
@pytest.mark.parametrize("most_entries", [math.inf, 20])
def test_several_processes_add_and_remove_entries(
    tmp_path: Path, store: Path, most_entries: float, capfd: pytest.CaptureFixture[str]
) -> None:
    ranges = [range(start, start + 40) for start in range(0, 160, 40)]
    bound_bytes = most_entries * SIZE
    running = [CONTEXT.Process(target=_put_many, args=(store, bound_bytes, tmp_path / str(r.start), r)) for r in ranges]
    for process in running:
        process.start()
    for process in running:
        process.join()
        assert process.exitcode == 0
    assert capfd.readouterr().err == ""  # no entry was damaged, and the store could be written
    entries = Store(store).entries()
    assert recorded_bytes(store) == len(entries) * SIZE
    assert len(entries) == 160 if most_entries == math.inf else 1 <= len(entries) <= most_entries
    assert len([path for path in store.iterdir() if path.is_dir()]) == len(entries) + len({".work", ".locks"})
    assert not list((store / ".work").iterdir())


def test_entries_in_use_stay(tmp_path: Path, store: Path, lists: list[int]) -> None:
    bounded = Store(store, 10 * SIZE)
    old = [put(bounded, number, tmp_path / "out") for number in range(10)]
    for key in old:
        set_age(store, key, 1e5)
    with entries_in_use(store, "0123abcd"):
        bounded.take("part", old[0], tmp_path / "taken")
        new = [put(bounded, number, tmp_path / "out") for number in range(10, 25)]
        assert all(has(store, key) for key in (old[0], *new))
        assert not any(has(store, key) for key in old[1:])
        assert bounded.usage_bytes() == 16 * SIZE  # above the limit
        assert len(lists) < 10  # not for every entry
        assert bounded.prune(5 * SIZE) == []
    assert not list((store / ".in_use").iterdir())
    assert len(bounded.prune(5 * SIZE)) == 11


def test_killed_run_uses_no_entries(tmp_path: Path, store: Path) -> None:
    bounded = Store(store, 10 * SIZE)
    keys = [put(bounded, number, tmp_path / "out") for number in range(10)]
    (store / ".in_use").mkdir()
    (left := store / ".in_use" / "0123abcd").write_text("0.0")
    assert bounded.prune(5 * SIZE) == []
    os.utime(left, (time.time() - 1e5, time.time() - 1e5))
    assert len(bounded.prune(5 * SIZE)) == 5
    assert sum(has(store, key) for key in keys) == 5
    with entries_in_use(store, "4567abcd"):
        assert not left.exists()


def test_removing_all_entries_ignores_use(tmp_path: Path, store: Path) -> None:
    put(Store(store), 0, tmp_path / "out")
    with entries_in_use(store, "0123abcd"):
        assert len(Store(store).prune(-1)) == 1


def test_rejects_link(tmp_path: Path, store: Path) -> None:
    (tmp_path / "mine").mkdir()
    (store / ".in_use").symlink_to(tmp_path / "mine")
    with pytest.raises(InputError, match="is a symbolic link"), entries_in_use(store, "0123abcd"):
        pass
    assert not list((tmp_path / "mine").iterdir())
