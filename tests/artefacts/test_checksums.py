"""A file that is not the one that was written is told by its checksum."""

import shutil
import subprocess
from pathlib import Path

import pytest

from egvs.artefacts import checksums
from egvs.core.errors import InputError


@pytest.fixture
def sums(tmp_path: Path) -> Path:
    for name in ("a.parquet", "b.png"):
        (tmp_path / name).write_bytes(name.encode())
    checksums.write_checksums(tmp_path / "study.sha256", [tmp_path / "a.parquet", tmp_path / "b.png"])
    return tmp_path / "study.sha256"


def test_unchanged_and_missing_files_pass(sums: Path) -> None:
    checksums.verify_checksums(sums, "Run again.")
    sums.with_name("b.png").unlink()
    checksums.verify_checksums(sums, "Run again.")
    checksums.verify_checksums(sums.with_name("none.sha256"), "Run again.")


def test_a_flipped_bit_is_reported(sums: Path) -> None:
    sums.with_name("b.png").write_bytes(b"b.pnf")
    with pytest.raises(InputError, match=r"b\.png: does not match its checksum in study\.sha256. Run again."):
        checksums.verify_checksums(sums, "Run again.")
    assert checksums.changed_files(sums, "Run again.") == ["b.png"]


@pytest.mark.parametrize("text", [b"x", b"\xff\n", b"0" * 64 + b"  ../a\n", b"0" * 64 + b" a\n", b"\n"])
def test_a_damaged_list_is_reported(sums: Path, text: bytes) -> None:
    sums.write_bytes(text)
    with pytest.raises(InputError, match=r"study\.sha256: is not a list of checksums. Run again."):
        checksums.verify_checksums(sums, "Run again.")


@pytest.mark.system
@pytest.mark.skipif(shutil.which("sha256sum") is None, reason="sha256sum is not installed")
def test_sha256sum_reads_the_list(sums: Path) -> None:
    assert subprocess.run(["sha256sum", "--check", "--status", sums.name], cwd=sums.parent).returncode == 0
