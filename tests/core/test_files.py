"""Room for a file that is written after long work."""

import errno
from pathlib import Path

import pytest

from pipeline.core import files
from pipeline.core.errors import InputError


def test_room_is_made_and_nothing_else(tmp_path: Path) -> None:
    files.make_room(tmp_path / "a" / "b" / "model.onnx")
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*"))] == ["a", "a/b"]
    (tmp_path / "mine").write_text("kept")
    files.make_room(tmp_path / "mine")
    assert (tmp_path / "mine").read_text() == "kept"


def test_where_there_is_no_room_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file/m\.onnx: cannot be written \(.+\); a file in a folder of yours"):
        files.make_room(tmp_path / "file" / "m.onnx")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"folder: is a folder; a file"):
        files.make_room(tmp_path / "folder")

    def refused(**_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(files.tempfile, "TemporaryFile", refused)  # whoever runs this may write everywhere
    with pytest.raises(InputError, match=r"m\.onnx: cannot be written \(Permission denied\)"):
        files.make_room(tmp_path / "m.onnx")
