"""A small .npz file that asks for much memory is rejected."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.formats.sweep_files import read_sweeps


def test_npz_has_a_limit_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as file:
        shape = {"descr": "<f8", "fortran_order": False, "shape": (1_000_000, 3)}
        np.lib.format.write_array_header_1_0(file, shape)
        file.write(bytes(24_000_000))
    assert path.stat().st_size < 50_000
    monkeypatch.setenv(limits.UNPACKED.name, "20")
    with pytest.raises(InputError, match=r"bomb\.npz: has 24 MB after decompression\. The limit is 20 MB"):
        read_sweeps([path])
