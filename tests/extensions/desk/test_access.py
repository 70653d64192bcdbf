"""Who may use the page, what it may load, and how much it may send."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from egvs.extensions.desk import server
from egvs.extensions.desk.access import POLICY
from tests.extensions.desk.serving import Client


def refusal(status: int, headers: dict[str, str], body: bytes) -> None:
    assert status == 403
    assert b"contains the key" in body
    assert headers["content-type"].startswith("text/plain")


@pytest.mark.slow
def test_address_with_key_sets_a_cookie_and_hides_the_key(desk: Client) -> None:
    status, headers, _ = desk.raw("GET", "/?" + desk.address.partition("?")[2], headers={"Cookie": ""})
    assert (status, headers["location"]) == (303, "/")
    assert headers["set-cookie"].endswith("; HttpOnly; SameSite=Strict; Path=/")
    assert headers["set-cookie"].startswith(f"egvs_desk_{desk.host.partition(':')[2]}=")


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", ["/", "/api/state", "/api/events", "/static/main.js", "/api/files/scenario", "/api/aerial", "/?key=x"]
)
def test_refuses_without_key(desk: Client, path: str) -> None:
    refusal(*desk.raw("GET", path, headers={"Cookie": ""}))
    refusal(*desk.raw("GET", path, headers={"Cookie": desk.cookie[:-1]}))


@pytest.mark.slow
@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "https://{host}"},
    ],
)
def test_refuses_other_hosts_and_origins(desk: Client, headers: dict[str, str]) -> None:
    sent = {key: value.format(host=desk.host) for key, value in headers.items()}
    refusal(*desk.raw("GET", "/api/state", headers=sent))
    refusal(*desk.raw("POST", "/api/undo", b"{}", headers=sent))


@pytest.mark.slow
def test_changes_need_an_origin(desk: Client) -> None:
    refusal(*desk.raw("POST", "/api/open", b'{"scenario": "mini"}', headers={"Origin": ""}))
    assert desk.ok("GET", "/api/state")["project"] is None


@pytest.mark.slow
def test_has_no_websocket(desk: Client) -> None:
    headers = {
        "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
    }  # fmt: skip
    assert desk.raw("GET", "/api/state", headers=headers)[0] != 101


@pytest.mark.slow
@pytest.mark.parametrize("path", ["/", "/api/state", "/nothing", "/?key=x"])
def test_every_answer_has_the_policy(desk: Client, path: str) -> None:
    _, headers, _ = desk.raw("GET", path)
    assert headers["content-security-policy"] == POLICY
    assert headers["x-content-type-options"] == "nosniff"
    assert "unsafe" not in POLICY


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "../server.py",
        "%2e%2e/server.py",
        "..%2fserver.py",
        "%2e%2e%2f%2e%2e%2fcity%2fpage.py",
        "/etc/passwd",
        "//etc/passwd",
    ],
)
def test_serves_no_file_outside(desk: Client, name: str) -> None:
    assert desk.raw("GET", f"/static/{name}")[0] == 404


@pytest.mark.slow
def test_serves_files_with_their_types(desk: Client) -> None:
    for path, kind in (
        ("/", "text/html"),
        ("/static/main.js", "text/javascript"),
        ("/static/icon.svg", "image/svg+xml"),
    ):
        status, headers, body = desk.raw("GET", path)
        assert (status, headers["content-type"].partition(";")[0]) == (200, kind)
        assert headers["cache-control"] == "no-cache"
        assert body
        assert desk.raw("GET", path, headers={"If-None-Match": headers["etag"]})[0] in (200, 304)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["..", "../mini", "a/../mini", "/etc", "mini/..", ".hidden", "no", "runs", ""])
def test_opens_no_folder_outside(desk: Client, name: str, tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text((tmp_path / "work" / "mini" / "scenario.toml").read_text())
    assert desk("POST", "/api/open", {"scenario": name})[0] in (404, 422)


@pytest.mark.slow
def test_follows_no_link_out_of_the_folder(desk: Client, tmp_path: Path) -> None:
    (tmp_path / "work" / "mini").rename(tmp_path / "elsewhere")
    (tmp_path / "work" / "link").symlink_to(tmp_path / "elsewhere")
    assert desk.refused("POST", "/api/open", {"scenario": "link"})[0] == 404


@pytest.mark.slow
@pytest.mark.parametrize("name", ["../up", "a/b", "a\\b", ".x", "x" * 81, "~root", "runs", "a\nb", "mini"])
def test_makes_no_folder_outside(desk: Client, name: str) -> None:
    status, _, field = desk.refused("POST", "/api/copy", {"shipped": "demo", "name": name})
    assert (status, field) == (409 if name == "mini" else 422, "name")


# ---- limits


@pytest.fixture
def small_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_UPLOAD_BYTES", 100_000)
    monkeypatch.setattr(server, "MAX_BODY_BYTES", 10_000)


def blocks(count: int, sent: list[int]) -> Iterator[bytes]:
    for number in range(count):
        sent.append(number)
        yield b"x" * 10_000


@pytest.mark.slow
@pytest.mark.usefixtures("small_limits")
@pytest.mark.parametrize(
    "path", ["/api/maps?name=a.osm", "/api/import?name=a.zip", "/api/aerial?name=a.tif", "/api/sites"]
)
def test_large_requests_are_refused_while_they_arrive(desk: Client, tmp_path: Path, path: str) -> None:
    status, _, body = desk.raw("POST", path, b"x" * 200_000)
    assert (status, "larger than" in json.loads(body)["message"]) == (413, True)
    sent: list[int] = []
    chunked = {"Transfer-Encoding": "chunked"}
    try:
        status, _, body = desk.raw("POST", path, blocks(5_000, sent), chunked, chunked=True)
        assert status == 413
    except ConnectionError:  # the server has closed the connection: the answer may be lost
        pass
    assert len(sent) < 5_000
    assert not list((tmp_path / "scratch").iterdir())
    assert desk.ok("GET", "/api/start")["maps"] == []


@pytest.mark.slow
def test_unknown_kinds_of_files_are_refused(desk: Client) -> None:
    for name in ("map.exe", "", "osm", "map.osm.html"):
        assert desk.refused("POST", f"/api/maps?name={name}", b"x")[0] == 415


@pytest.mark.slow
def test_requests_are_json_objects(desk: Client) -> None:
    for body in (b"{", b"[]", b"\xff", b"[" * 9_000):
        assert desk.raw("POST", "/api/open", body)[0] == 400


@pytest.mark.slow
def test_a_connection_that_sends_nothing_does_not_block_others(desk: Client) -> None:
    host, _, port = desk.host.partition(":")
    with socket.create_connection((host, int(port))) as silent:
        silent.sendall(b"POST /api/maps?name=a.osm HTTP/1.1\r\n")
        assert desk.ok("GET", "/api/state")["project"] is None


@pytest.mark.slow
def test_events_begin_with_the_state(desk: Client) -> None:
    connection = http.client.HTTPConnection(desk.host, timeout=30)
    connection.request("GET", "/api/events", headers={"Cookie": desk.cookie})
    response = connection.getresponse()
    assert response.headers["Content-Type"].startswith("text/event-stream")
    assert response.readline() == b"event: state\n"
    assert json.loads(response.readline().removeprefix(b"data: ")) == {"revision": 0}
    desk.ok("POST", "/api/open", {"scenario": "mini"})
    assert [response.readline() for _ in range(3)][1:] == [b"event: state\n", b'data: {"revision": 1}\n']
    connection.close()
