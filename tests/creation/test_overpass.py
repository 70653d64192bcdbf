"""Maps from an Overpass server: the query, the cache, and answers that are no map. The server is a local one."""

from __future__ import annotations

import math
import re
import socket
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from egvs._version import __version__
from egvs.core.errors import InputError
from egvs.creation import assumed_traffic, junctions
from egvs.creation.openstreetmap import overpass
from egvs.creation.openstreetmap import reader as openstreetmap
from egvs.traffic.capacity import Capacity, TrialRun
from tests.creation.overpass_server import Respond, overpass_server, recorded_answer, send

AT = (52.0, 10.0)
ANSWER = recorded_answer()
HTML = b"<!DOCTYPE html><html><body><p>Error: <b>runtime error</b>: open64: 0 Success</p></body></html>"
REMARK = b'<remark> runtime error: Query timed out in "query" at line 1 after 61 seconds. </remark>\n</osm>'


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own, no proxy, and no server but that of the test."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY", "EGVS_OVERPASS_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(overpass, "DEFAULT_URL", "http://127.0.0.1:9/api/interpreter")
    capacity = Capacity(1.0, (TrialRun(1.0, 100, 100, 20.0, 0),))
    monkeypatch.setattr(assumed_traffic, "find_capacity", lambda *_: capacity)
    return tmp_path / "cache" / "egvs" / "overpass"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# --- a complete answer -----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_downloaded_map_gives_the_scenario_of_the_same_file(tmp_path: Path, run_egvs: Any) -> None:
    (tmp_path / "same.osm").write_bytes(ANSWER)
    with overpass_server(send(ANSWER)) as server:
        words = ["--at", "52.0,10.0", "--download", "--overpass", server.url]
        code, printed, error = run_egvs("new", tmp_path / "a" / "cross", *words)
    assert (code, error) == (0, "")
    assert run_egvs("new", tmp_path / "b" / "cross", "--osm", tmp_path / "same.osm", "--at", "52.0,10.0")[0] == 0
    assert contents(tmp_path / "a" / "cross") == contents(tmp_path / "b" / "cross")

    printed = " ".join(printed.split())
    assert "note: The map was downloaded from 127.0.0.1" in printed
    assert "as of 2026-11-01T10:20:30Z" in printed
    assert "(c) OpenStreetMap contributors, ODbL" in printed
    assert "(c) OpenStreetMap contributors, ODbL" in (tmp_path / "a" / "cross" / "scenario.toml").read_text()


def test_request_names_the_program_and_asks_for_a_complete_extract() -> None:
    with overpass_server(send(ANSWER)) as server:
        overpass.download_extract(AT, url=server.url)
    assert server.headers[0]["User-Agent"].startswith(f"egvs/{__version__} ")
    (query,) = server.queries
    assert query.startswith("[out:xml][timeout:60]")
    assert query.endswith("(._;>;);out;")  # the nodes of ways, and the members of relations
    assert query.count("(51.995953,9.993427,52.004047,10.006573)") == 5


def test_square_reaches_what_a_new_scenario_needs() -> None:
    square = overpass.square_around(AT)
    half_m = math.radians(square.north_deg - AT[0]) * 6_371_008.8
    assert half_m >= junctions.MAX_FROM_POINT_M + openstreetmap.SURROUNDINGS_M
    assert math.radians(square.east_deg - AT[1]) * 6_371_008.8 * math.cos(math.radians(52)) == pytest.approx(half_m)
    larger = overpass.square_around(AT, 1000.0)
    assert math.radians(larger.north_deg - AT[0]) * 6_371_008.8 == pytest.approx(half_m + 700)


def test_second_download_is_taken_from_the_cache(cache: Path) -> None:
    with overpass_server(send(ANSWER)) as server:
        first = overpass.download_extract(AT, url=server.url)
        second = overpass.download_extract(AT, url=server.url)
        overpass.download_extract((52.0001, 10.0), url=server.url)
    assert (first.path, first.is_cached, second.is_cached) == (second.path, False, True)
    assert first.path.parent == cache
    assert len(server.queries) == 2
    assert f"delete it to get a new one. Map data {overpass.ATTRIBUTION}" in second.note


def test_server_of_the_environment_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with overpass_server(send(ANSWER)) as server:
        monkeypatch.setenv("EGVS_OVERPASS_URL", server.url)
        assert overpass.download_extract(AT).path.is_file()
    assert len(server.queries) == 1


def test_redirect_to_another_address_is_followed() -> None:
    with overpass_server(send(ANSWER)) as target:

        def respond(handler: BaseHTTPRequestHandler) -> None:
            send(b"", 302, Location=target.url + "?" + handler.path.partition("?")[2])(handler)

        with overpass_server(respond) as server:
            overpass.download_extract(AT, url=server.url)
    assert target.queries == server.queries


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--at", "52.0,10.0"), ("--osm", "{file}")])
def test_nothing_is_requested_without_the_option(
    words: tuple[str, ...], tmp_path: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "same.osm").write_bytes(ANSWER)
    monkeypatch.setattr(socket.socket, "connect", lambda *_: pytest.fail("a connection is opened"))
    code, _, error = run_egvs("new", tmp_path / "new", *(word.format(file=tmp_path / "same.osm") for word in words))
    assert (code, error) == (0, "") if "--osm" in words else code == 2


# --- answers that are no map -----------------------------------------------------------------------------------------
def stall(release: threading.Event) -> Respond:
    def respond(handler: BaseHTTPRequestHandler) -> None:
        release.wait(20)

    return respond


def drip(handler: BaseHTTPRequestHandler) -> None:
    """Send a byte at a time, without end."""
    handler.send_response(200)
    handler.end_headers()
    while True:
        handler.wfile.write(b"<osm ")
        handler.wfile.flush()
        threading.Event().wait(0.05)


def endless(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.end_headers()
    handler.wfile.write(b'<osm version="0.6">')
    while True:
        handler.wfile.write(b'<node id="1" lat="52" lon="10"/>' * 1000)


def close(handler: BaseHTTPRequestHandler) -> None:
    handler.connection.shutdown(socket.SHUT_RDWR)


BROKEN: dict[str, tuple[Respond, str]] = {
    "truncated": (send(ANSWER[:-400]), r"the answer is not a complete extract: is not well-formed XML"),
    "shorter than announced": (
        send(ANSWER[:-400], Content_Length=str(len(ANSWER))),
        r"the connection broke before the answer was complete",
    ),
    "closed": (close, r"the connection broke before the answer was complete|cannot be reached"),
    "empty": (send(b""), r"expected OpenStreetMap data, got another answer"),
    "HTML page": (
        send(HTML, content_type="text/html"),
        r"expected OpenStreetMap data, got another answer: 'Error: runtime error : open64: 0 Success'",
    ),
    "remark": (
        send(ANSWER.replace(b"</osm>", REMARK)),
        r"could not complete the query: runtime error: Query timed out",
    ),
    "no data": (send(b'<osm version="0.6"></osm>'), r"there is no map data around this point. Check --at"),
    "entities": (send(b'<!DOCTYPE osm [<!ENTITY a "b">]><osm version="0.6">&a;</osm>'), r"declares XML entities"),
    "HTTP 429": (send(HTML, 429), r"the server refuses more requests for now \(HTTP 429\). Try again in a few minutes"),
    "HTTP 504": (send(HTML, 504), r"the server is busy \(HTTP 504\). Try again in a few minutes"),
    "HTTP 400": (send(HTML, 400), r"the server answered HTTP 400 \(Bad Request\). Check the address"),
    "HTTP 404": (send(HTML, 404), r"the server answered HTTP 404 \(Not Found\). Check the address"),
    "redirect to a file": (
        send(b"", 302, Location="file:///etc/hostname"),
        r"redirects without end or to nowhere \(HTTP 302\)",
    ),
    "redirect to ftp": (send(b"", 302, Location="ftp://127.0.0.1/a.osm"), r"it redirects to ftp://127.0.0.1/a.osm"),
    "redirect to itself": (send(b"", 302, Location="interpreter"), r"redirects without end or to nowhere"),
    "endless": (endless, r"the answer is larger than 1 MB. The limit is 1 MB; set EGVS_MAX_DOWNLOAD_MB to raise it"),
    "slow": (drip, r"there was no complete answer within 1 s. .* set EGVS_MAX_DOWNLOAD_S to raise it"),
    "not HTTP": (lambda handler: handler.wfile.write(b"SSH-2.0-x\r\n"), r"the connection broke"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_answer_gives_one_message_and_nothing_is_written(
    name: str, tmp_path: Path, cache: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    respond, expected = BROKEN[name]
    monkeypatch.setenv("EGVS_MAX_DOWNLOAD_MB", "1")
    monkeypatch.setenv("EGVS_MAX_DOWNLOAD_S", "1" if name == "slow" else "20")
    with overpass_server(respond) as server:
        words = ["--at", "52.0,10.0", "--download", "--overpass", server.url]
        check_rejected(run_egvs("new", tmp_path / "new", *words), f"--overpass {server.url}: ", expected)
    assert not (tmp_path / "new").exists()
    assert contents(cache) == {}


def check_rejected(outcome: tuple[int, str, str], start: str, expected: str) -> None:
    code, printed, error = outcome
    assert (code, printed) == (2, "")
    message = " ".join(error.split())
    assert message.removeprefix("egvs: ").startswith(start), message
    assert re.search(expected, message), message
    assert "Traceback" not in error


@pytest.mark.slow
def test_server_that_does_not_answer_gives_one_message(
    tmp_path: Path, run_egvs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EGVS_MAX_DOWNLOAD_S", "1")
    release = threading.Event()
    with overpass_server(stall(release)) as server:
        words = ["--at", "52.0,10.0", "--download", "--overpass", server.url]
        outcome = run_egvs("new", tmp_path / "new", *words)
        release.set()
    check_rejected(outcome, "--overpass", r"there was no complete answer within 1 s")


def test_refused_connection_gives_one_message(tmp_path: Path, run_egvs: Any) -> None:
    outcome = run_egvs("new", tmp_path / "new", "--at", "52.0,10.0", "--download")
    check_rejected(outcome, "--download http://127.0.0.1:9", r"the server cannot be reached \(Connection refused\)")


def test_damaged_cache_is_reported_with_its_path(cache: Path) -> None:
    with overpass_server(send(ANSWER)) as server:
        path = overpass.download_extract(AT, url=server.url).path
        path.write_bytes(ANSWER[:-400])
        with pytest.raises(InputError, match=r"\.osm: is not well-formed XML.*Download or make the file again"):
            overpass.download_extract(AT, url=server.url)


def test_folder_and_options_are_checked_before_the_download(tmp_path: Path, run_egvs: Any) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with overpass_server(send(ANSWER)) as server:
        words = ["--at", "52.0,10.0", "--download", "--overpass", server.url]
        check_rejected(run_egvs("new", tmp_path / "full", *words), str(tmp_path / "full"), "one that is not empty")
        check_rejected(run_egvs("new", tmp_path / "a", *words, "--surroundings", "20"), "--surroundings", "at least")
    assert server.queries == []


OPTIONS: dict[str, tuple[list[str], str]] = {
    "no point": (["--download"], r"^--download: needs a point. Add --at LAT,LON"),
    "no download": (
        ["--osm", "a.osm", "--overpass", "https://x.org"],
        r"^--overpass: has no effect without --download",
    ),
    "swapped": (["--download", "--at", "139.7,35.7"], r"did you mean --at 35.7,139.7\?"),
    "not a number": (
        ["--download", "--at", "nan,10"],
        r"^--at: expected LAT,LON within 85 and 180 degrees, got nan,10",
    ),
    "at the date line": (["--download", "--at", "0,180"], r"^--at: the square around the point crosses the 180th"),
    "all streets": (
        ["--download", "--at", "52,10", "--surroundings", "all"],
        r"^--surroundings: expected at most 5000 m with --download, got all",
    ),
    "file as server": (
        ["--download", "--at", "52,10", "--overpass", "file:///etc/passwd"],
        r"^--overpass: expected an address that begins with https://, got 'file:///etc/passwd'",
    ),
    "no host": (["--download", "--at", "52,10", "--overpass", "https://"], r"^--overpass: expected an address"),
    "a query": (["--download", "--at", "52,10", "--overpass", "http://h/?a=b"], r"^--overpass: expected an address"),
    "a fragment": (["--download", "--at", "52,10", "--overpass", "http://h/#a"], r"^--overpass: expected an address"),
    "a port": (["--download", "--at", "52,10", "--overpass", "http://h:port/"], r"^--overpass: expected an address"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_wrong_options_give_one_message(
    name: str, tmp_path: Path, run_egvs: Callable[..., tuple[int, str, str]]
) -> None:
    words, expected = OPTIONS[name]
    check_rejected(run_egvs("new", tmp_path / "new", *words), "", expected.replace("^", "^egvs: "))
    assert not (tmp_path / "new").exists()
