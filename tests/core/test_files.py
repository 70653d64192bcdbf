"""Room for a file that is written after long work; folders for work."""

import errno
import signal
import tempfile
from pathlib import Path

import pytest

from egvs.core import files
from egvs.core.errors import InputError


def test_ensure_writable_folder_makes_only_the_folder(tmp_path: Path) -> None:
    files.ensure_writable_folder(tmp_path / "a" / "b" / "model.onnx")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["a", "a/b"]
    (tmp_path / "mine").write_text("kept")
    files.ensure_writable_folder(tmp_path / "mine")
    assert (tmp_path / "mine").read_text() == "kept"


def test_check_writable_makes_nothing(tmp_path: Path) -> None:
    files.check_writable(tmp_path / "a" / "b" / "map.gpkg")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/b/m\.gpkg: cannot be written \(.+\)\. Choose a folder"):
        files.check_writable(tmp_path / "file" / "b" / "m.gpkg")
    with pytest.raises(InputError, match=r"expected a file, got a folder"):
        files.check_writable(tmp_path)


def test_rejects_locations_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/m\.onnx: cannot be written \(.+\)\. Choose a folder"):
        files.ensure_writable_folder(tmp_path / "file" / "m.onnx")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"folder: expected a file, got a folder"):
        files.ensure_writable_folder(tmp_path / "folder")

    def raise_permission_error(**_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(
        files.tempfile, "TemporaryFile", raise_permission_error
    )  # whoever runs this may write everywhere
    with pytest.raises(InputError, match=r"m\.onnx: cannot be written \(Permission denied\)"):
        files.ensure_writable_folder(tmp_path / "m.onnx")


def test_error_of_full_disk_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="left on device") as caught, files.atomic_write(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a")
    with pytest.raises(OSError, match="left on device") as caught, files.atomic_write(tmp_path / "a") as partial:
        raise OSError(errno.ENOSPC, "No space left on device", "/elsewhere/source", None, str(partial))  # as of a copy
    assert (caught.value.filename, caught.value.filename2) == (str(tmp_path / "a"), None)
    with pytest.raises(OSError, match="other") as caught, files.atomic_write(tmp_path / "a"):
        raise OSError(errno.EIO, "another error")  # may be of what is read
    assert caught.value.filename is None
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.system
def test_removes_temporary_folders_of_killed_programs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.processes import python

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    killed = """
import os, signal
from egvs.core import files
with files.temporary_folder() as folder:
    (folder / "sub").mkdir()
    os.kill(os.getpid(), signal.SIGKILL)
"""
    assert python(killed).returncode == -signal.SIGKILL
    (left,) = tmp_path.glob("egvs-work-*")
    (tmp_path / "egvs-work-link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    files._remove_stale_folders.cache_clear()
    with files.temporary_folder() as mine:
        assert mine.is_dir() and not left.exists()
        files._remove_stale_folders.cache_clear()
        with files.temporary_folder() as other:
            assert mine.is_dir() and other.is_dir(), "one that is held stays"
    assert {path.name for path in tmp_path.iterdir()} == {"egvs-work-link", "elsewhere"}
    files._remove_stale_folders.cache_clear()


def test_temporary_folders_work_without_file_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    def raise_not_supported(*_: object, **_options: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(files.platform, "try_lock", raise_not_supported)
    with files.temporary_folder() as folder:
        assert folder.is_dir()
    assert not folder.exists()


def test_nothing_is_written_through_linked_folders_of_a_run(tmp_path: Path) -> None:
    run, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    (elsewhere / "csv").mkdir(parents=True)
    (run / "maps").mkdir(parents=True)
    (run / files.RUN_RECORD).write_text("")
    (run / "export").symlink_to(elsewhere)
    (run / "maps" / "csv").symlink_to(elsewhere / "csv")
    for path in (run / "export" / "a.csv", run / "export" / "csv" / "a.csv", run / "maps" / "csv" / "new" / "a.csv"):
        for write in (lambda path: files.write_text(path, "x"), files.check_writable, files.ensure_writable_folder):
            with pytest.raises(
                InputError, match=r"run/(export|maps/csv): expected a folder of the run, got a symbolic"
            ):
                write(path)
    assert [path.name for path in elsewhere.rglob("*")] == ["csv"]


def test_run_folders_may_be_links(tmp_path: Path) -> None:
    (tmp_path / "disk" / "run").mkdir(parents=True)
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    (tmp_path / "last").symlink_to(tmp_path / "disk" / "run")
    (tmp_path / files.RUN_RECORD).write_text("")  # of a run in the folder of the scenario
    (tmp_path / "disk" / "run" / files.RUN_RECORD).write_text("")
    for run in (tmp_path / "runs" / "run", tmp_path / "last"):
        files.write_text(run / "export" / "a.csv", "x")
    (tmp_path / files.RUN_RECORD).unlink()
    files.write_text(tmp_path / "runs" / "maps" / "a.csv", "x")


def test_removing_a_link_keeps_what_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_text("x")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    files.remove_folder(tmp_path / "link")
    assert not (tmp_path / "link").exists()
    assert (tmp_path / "a" / "b").exists()
    files.remove_folder(tmp_path / "a")
    files.remove_folder(tmp_path / "a")
    assert not (tmp_path / "a").exists()
