"""Nobody uses the page who was not given its address: no other user, no page of another origin, no rebound name."""

from __future__ import annotations

import http
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("viser", reason="the page needs viser: pip install 'egvs[explore]'")

from websockets import Headers
from websockets.http11 import Request

from egvs.explore.access import AccessGuard

PORT = 4321
HOST = f"127.0.0.1:{PORT}"


@pytest.fixture
def opened() -> list[dict[str, str]]:
    """The queries that were opened."""
    return []


@pytest.fixture
def guard(opened: list[dict[str, str]]) -> AccessGuard:
    """Sends browsers on to a camera of their own."""

    def open_(query: dict[str, str]) -> dict[str, str]:
        opened.append(query)
        return {"look": "1,2"} if "site" in query else {}

    return AccessGuard(open_)


def asked(guard: AccessGuard, path: str = "/", *more: tuple[str, str], host: str = HOST) -> http.HTTPStatus | None:
    """What becomes of a request: a status, or None where it is let through."""
    found = guard.refusal_or_welcome(PORT, Request(path, Headers([("Host", host), *more])))
    return None if found is None else http.HTTPStatus(found.status_code)


def test_the_key_is_exchanged_for_a_cookie(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    found = guard.refusal_or_welcome(PORT, Request(f"/?key={guard.key}&site=c01", Headers(Host=HOST)))
    assert found is not None
    assert (found.status_code, found.headers["Location"]) == (303, "/?look=1,2")
    assert found.headers["Set-Cookie"] == f"egvs_explore_4321={guard.key}; HttpOnly; SameSite=Strict; Path=/"
    assert opened == [{"site": "c01"}]
    plain = guard.refusal_or_welcome(PORT, Request(f"/?key={guard.key}", Headers(Host=HOST)))
    assert plain is not None
    assert plain.headers["Location"] == "/"


def test_who_shows_the_cookie_is_let_through(guard: AccessGuard) -> None:
    cookie = ("Cookie", f"broken; other=[1; egvs_explore_4321={guard.key}; last=2")
    upgrade = ("Upgrade", "websocket")
    assert asked(guard, "/", cookie) is None
    assert asked(guard, "/", cookie, host=f"localhost:{PORT}") is None
    assert asked(guard, "/", cookie, upgrade, ("Origin", f"http://{HOST}")) is None


FOREIGN = [
    ("Origin", "http://evil.example"),
    ("Origin", "http://127.0.0.1:4322"),
    ("Origin", f"https://{HOST}"),
    ("Origin", "null"),
]


@pytest.mark.parametrize("origin", FOREIGN)
@pytest.mark.parametrize("upgrade", [(), (("Upgrade", "WebSocket"),)])
def test_a_page_of_another_origin_cannot_use_the_cookie(
    guard: AccessGuard, origin: tuple[str, str], upgrade: tuple
) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert asked(guard, "/", cookie, origin, *upgrade) == 403
    assert asked(guard, f"/?key={guard.key}", origin, *upgrade) == 403


def test_a_connection_without_an_origin_is_no_browsers(guard: AccessGuard) -> None:
    assert asked(guard, "/", ("Cookie", f"egvs_explore_4321={guard.key}"), ("Upgrade", "websocket")) == 403


NAMES = ("evil.example", f"evil.example:{PORT}", "127.0.0.1", "127.0.0.1:80", "", f"0.0.0.0:{PORT}")


@pytest.mark.parametrize("host", NAMES)
def test_a_name_that_points_here_is_refused(guard: AccessGuard, host: str) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert asked(guard, "/", cookie, host=host) == 403
    assert asked(guard, f"/?key={guard.key}", host=host) == 403


def test_without_key_and_cookie_nobody_gets_in(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    other = AccessGuard(lambda query: query)
    assert other.key != guard.key
    assert asked(guard) == 403
    assert asked(guard, f"/?key={other.key}") == 403
    assert asked(guard, "/?key=") == 403
    assert asked(guard, "/?key=%FF%00ä") == 403
    assert asked(guard, "/", ("Cookie", f"egvs_explore_4322={guard.key}")) == 403
    assert asked(guard, "/", ("Cookie", f"egvs_explore_4321={other.key}")) == 403
    assert asked(guard, "/", ("Cookie", "egvs_explore_4321=")) == 403
    assert asked(guard, f"/?key={guard.key}", ("Upgrade", "websocket"), ("Origin", f"http://{HOST}")) == 403
    assert opened == []


def test_an_address_without_end_is_refused(guard: AccessGuard, opened: list[dict[str, str]]) -> None:
    assert asked(guard, f"/?key={guard.key}&site={'x' * 5000}") == 403
    assert opened == []


def test_two_hosts_in_one_request_are_refused(guard: AccessGuard) -> None:
    cookie = ("Cookie", f"egvs_explore_4321={guard.key}")
    assert asked(guard, "/", cookie, ("Host", HOST)) == 403


def test_keys_are_long_and_fresh() -> None:
    keys = {AccessGuard(lambda query: query).key for _ in range(20)}
    assert len(keys) == 20
    assert min(map(len, keys)) >= 32
    assert parse_qs(urlsplit(f"/?key={keys.pop()}").query)["key"]
