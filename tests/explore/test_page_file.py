"""The 3D view as one file: what is in it, its size, no reference to the network, and equal bytes for equal runs."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import pytest

from tests.conftest import write_mini

pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

import msgspec
import zstandard

from egvs.core.errors import InputError
from egvs.explore.page_file import PageFile, check_page_file, write_page_file
from egvs.explore.session import Session
from egvs.explore.settings import open_session

HTML_REFERENCE = re.compile(
    r"""(?:src|href|action|srcset|poster)\s*=\s*["']?\s*(?:https?:|//)|url\(\s*["']?https?:""", re.I
)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The small scenario."""
    folder = tmp_path_factory.mktemp("file")
    return open_session(write_mini(folder / "mini"), (), folder / "run")


@pytest.fixture(scope="module")
def written(session: Session, tmp_path_factory: pytest.TempPathFactory) -> PageFile:
    """Its page."""
    return write_page_file(session, tmp_path_factory.mktemp("page") / "new" / "page.html")


def recorded_messages(html: str) -> tuple[float, list[tuple[float, dict]]]:
    """Return duration and messages of the recording in a page."""
    data = re.search(r'__VISER_EMBED_DATA__="([^"]*)"', html)
    assert data is not None
    content = base64.b64decode(data[1])
    inner = zstandard.ZstdDecompressor().decompress(content[8:], int.from_bytes(content[:8], "little"))
    length = int.from_bytes(inner[:8], "little")
    recording = msgspec.msgpack.decode(inner[8 : 8 + length])
    return recording["durationSeconds"], recording["messages"]


def test_says_what_it_wrote(written: PageFile) -> None:
    assert written.path.stat().st_size == written.size_bytes
    assert 800_000 < written.size_bytes < 1_200_000  # the viewer is 0.8 MB
    assert (written.sensors, written.duration_s) == (("pole_b",), 20.0)
    assert written.returns == written.returns_drawn > 0


def test_refers_to_nothing_outside(written: PageFile) -> None:
    html = written.path.read_text(encoding="utf-8")
    assert HTML_REFERENCE.search(html) is None
    addresses = set(re.findall(r"https?://[^\s\"'<>)]+", html))
    assert addresses <= {"http://www.w3.org/2000/svg"}  # the name of a format, which is not loaded


def test_pattern_finds_references() -> None:
    for text in ('<script src="https://a/b.js">', "<link href=//a/b.css>", "url('http://a/b.png')"):
        assert HTML_REFERENCE.search(text) is not None


def test_has_ranking_legends_and_layers(written: PageFile, session: Session) -> None:
    html = written.path.read_text(encoding="utf-8")
    panel = html[html.index('<aside id="egvs">') :]
    for site in session.candidates:
        assert f"<td>{site}</td>" in panel
    assert "Best of 2 candidate sites" in panel
    assert "vehicles missed: pole_b" in panel
    assert "hit: 20 or more points" in panel
    assert "20.0 s of recorded traffic, seen from pole_b" in panel


def test_recording_draws_each_frame(written: PageFile) -> None:
    duration_s, messages = recorded_messages(written.path.read_text(encoding="utf-8"))
    assert duration_s == 20.0
    names = {message["name"] for _, message in messages if "name" in message}
    assert {
        "/sites",
        "/world/building",
        "/layers/blindspots",
        "/layers/seen",
        "/layers/missed",
        "/traffic/returns",
    } <= names
    returns = [time for time, message in messages if message.get("name") == "/traffic/returns" and time > 0.0]
    assert returns[0] == 0.5
    assert len(set(returns)) >= 39


def test_equal_runs_give_equal_bytes(written: PageFile, session: Session, tmp_path: Path) -> None:
    again = write_page_file(session, tmp_path / "page.html")
    assert again.path.read_bytes() == written.path.read_bytes()


def test_rejects_other_names_and_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--to: expected a file name ending in \.html, got .*Use --to page\.html"):
        check_page_file(tmp_path / "page.txt")
    (tmp_path / "folder.html").mkdir()
    with pytest.raises(InputError, match="expected a file, got a folder"):
        check_page_file(tmp_path / "folder.html")
    check_page_file(tmp_path / "page.HTML")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.html"]
