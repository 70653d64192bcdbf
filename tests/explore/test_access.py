"""Only browsers with the address may use the page: no other user, no page of another origin, no rebound host name."""

from __future__ import annotations

import http
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from websockets import Headers
from websockets.http11 import Request
from websockets.streams import StreamReader

from egvs.explore.access import AccessGuard

PORT = 4321
HOST = f"127.0.0.1:{PORT}"


@pytest.fixture
def opened() -> list[dict[str, str]]:
    """Queries that were opened."""
    return []


@pytest.fixture
def guard(opened: list[dict[str, str]]) -> AccessGuard:
    """A guard that redirects browsers to a camera."""

    def open_(query: dict[str, str]) -> dict[str, str]:
        opened.append(query)
        return {"look": "1,2"} if "site" in query else {}

    return AccessGuard(open_)


def status(guard: AccessGuard, path: str = "/", *more: tuple[str, str], host: str = HOST) -> http.HTTPStatus | None:
    """Return the status of a request, or None if it passes."""
    response = guard.check_request(PORT, Request(path, Headers([("Host", host), *more])))
    return None if response is None else http.HTTPStatus(response.status_code)


def test_key_is_exchanged_for_cookie(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    response = guard.check_request(PORT, Request(f"/?key={guard.key}&site=c01", Headers(Host=HOST)))
    assert response is not None
    assert (response.status_code, response.headers["Location"]) == (303, "/?look=1,2")
    assert response.headers["Set-Cookie"] == f"egvs_explore_4321={guard.key}; HttpOnly; SameSite=Strict; Path=/"
    assert opened == [{"site": "c01"}]
    plain = guard.check_request(PORT, Request(f"/?key={guard.key}", Headers(Host=HOST)))
    assert plain is not None
    assert plain.headers["Location"] == "/"


def test_requests_with_cookie_pass(guard: AccessGuard) -> None:
    cookie = ("Cookie", f"broken; other=[1; egvs_explore_4321={guard.key}; last=2")
    upgrade = ("Upgrade", "websocket")
    assert status(guard, "/", cookie) is None
    assert status(guard, "/", cookie, host=f"localhost:{PORT}") is None
    assert status(guard, "/", cookie, upgrade, ("Origin", f"http://{HOST}")) is None


FOREIGN = [
    ("Origin", "http://evil.example"),
    ("Origin", "http://127.0.0.1:4322"),
    ("Origin", f"https://{HOST}"),
    ("Origin", "null"),
]


@pytest.mark.parametrize("origin", FOREIGN)
@pytest.mark.parametrize("upgrade", [(), (("Upgrade", "WebSocket"),)])
def test_cookie_is_refused_from_other_origin(guard: AccessGuard, origin: tuple[str, str], upgrade: tuple) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert status(guard, "/", cookie, origin, *upgrade) == 403
    assert status(guard, f"/?key={guard.key}", origin, *upgrade) == 403


def test_connection_without_origin_is_refused(guard: AccessGuard) -> None:
    assert status(guard, "/", ("Cookie", f"egvs_explore_4321={guard.key}"), ("Upgrade", "websocket")) == 403


NAMES = ("evil.example", f"evil.example:{PORT}", "127.0.0.1", "127.0.0.1:80", "", f"0.0.0.0:{PORT}")


@pytest.mark.parametrize("host", NAMES)
def test_other_host_names_are_refused(guard: AccessGuard, host: str) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert status(guard, "/", cookie, host=host) == 403
    assert status(guard, f"/?key={guard.key}", host=host) == 403


def test_requests_without_key_and_cookie_are_refused(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    other = AccessGuard(lambda query: query)
    assert other.key != guard.key
    assert status(guard) == 403
    assert status(guard, f"/?key={other.key}") == 403
    assert status(guard, "/?key=") == 403
    assert status(guard, "/?key=%FF%00ä") == 403
    assert status(guard, "/", ("Cookie", f"egvs_explore_4322={guard.key}")) == 403
    assert status(guard, "/", ("Cookie", f"egvs_explore_4321={other.key}")) == 403
    assert status(guard, "/", ("Cookie", "egvs_explore_4321=")) == 403
    assert status(guard, f"/?key={guard.key}", ("Upgrade", "websocket"), ("Origin", f"http://{HOST}")) == 403
    assert opened == []


def test_long_address_is_refused(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    assert status(guard, f"/?key={guard.key}&site={'x' * 5000}") == 403
    assert opened == []


@pytest.mark.parametrize("path", ["//[", "//[x]/?key=1", "http://[", "/?look=\udcff"])
def test_address_that_no_browser_sends_is_refused(guard: AccessGuard, path: str) -> None:
    assert status(guard, path) == 403
    assert status(guard, path, ("Cookie", f"egvs_explore_4321={guard.key}")) == 403
    assert status(guard, f"{path}&key={guard.key}") == 403


def parse_request(content: bytes) -> Request:
    """Parse the bytes of a request as the server does."""
    stream = StreamReader()
    stream.feed_data(content)
    with pytest.raises(StopIteration) as end:
        next(Request.parse(stream.read_line))
    request: Request = end.value.value
    return request


@pytest.mark.parametrize("value", [b"\xff", "ä".encode(), "柱".encode()])
def test_cookie_that_is_not_ascii_is_refused(guard: AccessGuard, value: bytes) -> None:
    lines = [b"GET / HTTP/1.1", b"Host: " + HOST.encode(), b"Cookie: egvs_explore_4321=" + value, b"", b""]
    response = guard.check_request(PORT, parse_request(b"\r\n".join(lines)))
    assert response is not None
    assert response.status_code == 403


def test_request_with_two_hosts_is_refused(guard: AccessGuard) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert status(guard, "/", cookie, ("Host", HOST)) == 403


def test_keys_are_long_and_random() -> None:
    keys = {AccessGuard(lambda query: query).key for _ in range(20)}
    assert len(keys) == 20
    assert min(map(len, keys)) >= 32
    assert parse_qs(urlsplit(f"/?key={keys.pop()}").query)["key"]
