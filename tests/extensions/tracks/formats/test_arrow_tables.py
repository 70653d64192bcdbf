"""A small Feather file that asks for much memory is rejected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.extensions.tracks.formats.arrow_tables import ArrowTable
from egvs.formats import arrow_files

pytestmark = pytest.mark.system


def test_feather_has_a_limit_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "annotations.feather"
    table = pa.table({"a": pa.array(np.zeros(120_000_000, np.int8))})
    with pa.ipc.new_file(path, table.schema, options=pa.ipc.IpcWriteOptions(compression="zstd")) as file:
        file.write_table(table)
    assert path.stat().st_size < 1_000_000
    with pytest.raises(InputError, match=r"annotations\.feather: has 120,000,000 rows"):
        ArrowTable(path, (), ("a",))
    monkeypatch.setenv(limits.READER_MEMORY.name, "400")
    with pytest.raises(InputError, match=r"annotations\.feather: .*(memory|malloc|alloc)"):
        list(arrow_files.read_batches(path, "cannot be read", ["a"]))
