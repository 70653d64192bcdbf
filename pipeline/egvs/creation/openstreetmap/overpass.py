"""Download an OpenStreetMap extract around a point through the Overpass API.

Steps of :func:`download_extract`: find the square around the point; look in the user's cache folder; send the query;
write the answer to a temporary file within a time and a size limit; check that it is a complete extract; move it into
the cache. Nothing is cached unless it was checked.

Query and answer: https://wiki.openstreetmap.org/wiki/Overpass_API/Overpass_QL. Map data are (c) OpenStreetMap
contributors, under the Open Database License (ODbL).
"""

from __future__ import annotations

import hashlib
import http.client
import math
import os
import re
import shutil
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from urllib.parse import urlencode, urlsplit

from egvs._version import __version__
from egvs.core.cache_folder import user_cache_folder
from egvs.core.errors import InputError
from egvs.core.files import atomic_write, temporary_folder
from egvs.core.limits import DOWNLOAD, DOWNLOAD_TIME
from egvs.creation import junctions
from egvs.creation.openstreetmap import ATTRIBUTION, EARTH_M
from egvs.creation.openstreetmap import reader as openstreetmap
from egvs.creation.scenario_files import SENSOR
from egvs.formats import osm, xml
from egvs.formats.osm import Bounds
from egvs.sensors.sensor import CATALOGUE

DEFAULT_URL = "https://overpass-api.de/api/interpreter"
"""The server of the OpenStreetMap community; https://dev.overpass-api.de/overpass-doc/en/preface/commons.html."""

URL_VARIABLE = "EGVS_OVERPASS_URL"

USER_AGENT = f"egvs/{__version__} (sites for roadside LiDARs)"

MAX_LATITUDE_DEG = 85.0
MAX_RADIUS_M = 5000.0
"""A square of 10 km is the most that a public server should be asked for."""

_MARGIN_M = 50.0
_SERVER_TIME_S, _SERVER_MEMORY_BYTES = 60, 268_435_456
_CHUNK_BYTES = 1 << 16
_HEAD_BYTES = 4096
_OTHER_SERVER = "Try again in a few minutes, or use another server with --overpass URL."


@dataclass(frozen=True)
class DownloadedExtract:
    """A checked extract in the cache.

    Attributes
    ----------
    path
        The file, OpenStreetMap XML.
    server
        Host of the server.
    is_cached
        Whether it was downloaded before.
    timestamp
        Time of the map data as the server states it; empty if it does not.
    """

    path: Path
    server: str
    is_cached: bool
    timestamp: str

    @property
    def note(self) -> str:
        """Where the map comes from, as a sentence."""
        state = f", as of {self.timestamp}" if self.timestamp else ""
        origin = f"The map was downloaded from {self.server}{state}, and is cached in {self.path}"
        if self.is_cached:
            origin = (
                f"The map was downloaded from {self.server} earlier{state}: {self.path}; delete it to get a new one"
            )
        return f"{origin}. Map data {ATTRIBUTION} (openstreetmap.org/copyright)."


def download_extract(
    at: tuple[float, float], surroundings_m: float | None = None, url: str | None = None
) -> DownloadedExtract:
    """Download the roads and static objects around a point, or take them from the cache.

    Parameters
    ----------
    at
        Latitude, longitude in degrees (WGS 84).
    surroundings_m
        Distance from the junction within which streets will be simulated, in metres;
        :data:`~egvs.creation.openstreetmap.reader.SURROUNDINGS_M` when None.
    url
        Address of an Overpass server; ``EGVS_OVERPASS_URL`` or :data:`DEFAULT_URL` when None.

    Returns
    -------
    DownloadedExtract

    Raises
    ------
    InputError
        When the point or the address is not valid, or the server does not answer with a complete extract within the
        limits of time and size. No file remains then.
    """
    url, option = _check_url(url)
    query = make_query(square_around(at, surroundings_m))
    folder = user_cache_folder()
    if folder is None:
        raise InputError("--download", "no cache folder can be written", "Set XDG_CACHE_HOME to a folder of yours.")
    digest = hashlib.sha256(f"{url}\n{query}".encode()).hexdigest()
    cached = folder / "overpass" / f"{digest[:16]}.osm"
    server = urlsplit(url).netloc.rpartition("@")[2]
    if cached.is_file():
        return DownloadedExtract(cached, server, is_cached=True, timestamp=_check_answer(cached, cached))
    with temporary_folder() as temp_folder:
        answer = temp_folder / "answer.osm"
        with _translate_failures(f"{option} {url}"):
            _fetch(f"{url}?{urlencode({'data': query})}", answer, f"{option} {url}")
        timestamp = _check_answer(answer, f"{option} {url}")
        _move_into_cache(answer, cached)
    return DownloadedExtract(cached, server, is_cached=False, timestamp=timestamp)


def square_around(at: tuple[float, float], surroundings_m: float | None = None) -> Bounds:
    """Return the square that contains all that a new scenario needs, wherever near the point its junction is.

    Half its side is the distance of the farthest junction from the point, plus the larger of the surroundings and the
    range of the sensor beyond the region of interest.

    >>> square = square_around((52.0, 10.0))
    >>> round((square.north_deg - square.south_deg) / 2 * 111195)
    450
    """
    latitude_deg, longitude_deg = at
    if not (abs(latitude_deg) <= MAX_LATITUDE_DEG and abs(longitude_deg) <= 180):
        problem = (
            f"expected LAT,LON within {MAX_LATITUDE_DEG:g} and 180 degrees, got {latitude_deg!r},{longitude_deg!r}"
        )
        hint = "Use coordinates such as 50.8704,9.7080."
        if abs(longitude_deg) <= MAX_LATITUDE_DEG and abs(latitude_deg) <= 180:
            hint = f"Latitude comes first: did you mean --at {longitude_deg!r},{latitude_deg!r}?"
        raise InputError("--at", problem, hint)
    streets_m = openstreetmap.SURROUNDINGS_M if surroundings_m is None else surroundings_m
    if not streets_m <= MAX_RADIUS_M:
        amount = "all" if math.isinf(streets_m) else f"{streets_m:g} m"
        problem = f"expected at most {MAX_RADIUS_M:g} m with --download, got {amount}"
        raise InputError("--surroundings", problem, "Download a larger extract yourself and give it with --from.")
    solids_m = junctions.ROI_MAX_M / math.sqrt(2) + junctions.BEYOND_ROI_M + CATALOGUE[SENSOR].range_m
    half_m = junctions.MAX_FROM_POINT_M + max(streets_m, solids_m) + _MARGIN_M
    north_deg = math.degrees(half_m / EARTH_M)
    east_deg = north_deg / math.cos(math.radians(latitude_deg))
    if abs(longitude_deg) + east_deg > 180:
        hint = "Download an extract yourself and give it with --from."
        raise InputError("--at", "the square around the point crosses the 180th meridian", hint)
    return Bounds(
        latitude_deg - north_deg, longitude_deg - east_deg, latitude_deg + north_deg, longitude_deg + east_deg
    )


def make_query(square: Bounds) -> str:
    """Return the query, in Overpass QL, for all nodes and ways of a square, turn restrictions, and building relations.

    Ways that cross the edge of the square come with all their nodes, and relations with all their members. Relations of
    other kinds (boundaries, forests, bus routes) are left out: their members may be anywhere.
    """
    box = f"({square.south_deg:.6f},{square.west_deg:.6f},{square.north_deg:.6f},{square.east_deg:.6f})"
    return (
        f"[out:xml][timeout:{_SERVER_TIME_S}][maxsize:{_SERVER_MEMORY_BYTES}];"
        f"(node{box};way{box};"
        f'relation["type"="restriction"]{box};'
        f'relation["type"="multipolygon"]["building"]{box};'
        f'relation["type"="multipolygon"]["building:part"]{box};'
        ");(._;>;);out;"
    )


def _check_url(url: str | None) -> tuple[str, str]:
    """Return the address of the server, and what sets it, for messages."""
    option = "--overpass"
    if url is None:
        url = os.environ.get(URL_VARIABLE)
        option = URL_VARIABLE
    if not url:
        return DEFAULT_URL, "--download"
    try:
        parts = urlsplit(url)
        is_valid = parts.scheme in ("http", "https") and bool(parts.hostname) and not (parts.query or parts.fragment)
        _ = parts.port
    except ValueError:
        is_valid = False
    if not is_valid or not url.isascii() or re.search(r"[\s\x00-\x1f]", url):
        raise InputError(option, f"expected an address that begins with https://, got {url!r}", f"Use {DEFAULT_URL}.")
    return url, option


class _RedirectHandler(urllib.request.HTTPRedirectHandler):
    """Follows redirects to http and https only; urllib itself follows those to ftp too."""

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        if urlsplit(newurl).scheme not in ("http", "https"):
            raise urllib.error.URLError(f"it redirects to {newurl[:200]}")
        if urlsplit(req.full_url).scheme == "https" and urlsplit(newurl).scheme == "http":
            raise urllib.error.URLError("it redirects from https to http")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _open_connection(address: str, timeout_s: float) -> http.client.HTTPResponse:
    """Send a request; unlike :func:`urllib.request.urlopen`, without handlers for files, data and ftp."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.UnknownHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        _RedirectHandler(),
    ):
        opener.add_handler(handler)
    opener.addheaders = []
    headers = {"User-Agent": USER_AGENT, "Accept-Encoding": "identity"}
    request = urllib.request.Request(address, headers=headers)
    response: http.client.HTTPResponse = opener.open(request, timeout=timeout_s)
    return response


def _fetch(address: str, path: Path, where: str) -> None:
    """Write the answer to a file; TimeoutError or InputError beyond the limits."""
    end_s = time.monotonic() + DOWNLOAD_TIME.maximum
    size = 0
    with _open_connection(address, DOWNLOAD_TIME.maximum) as response, path.open("wb") as file:
        while chunk := response.read1(_CHUNK_BYTES):
            size += len(chunk)
            DOWNLOAD.check_bytes(where, size, f"the answer is larger than {DOWNLOAD.maximum:,} MB")
            if time.monotonic() > end_s:
                raise TimeoutError
            file.write(chunk)
        if response.length:  # announced, but not sent
            raise http.client.IncompleteRead(b"", response.length)


@contextmanager
def _translate_failures(where: str) -> Iterator[None]:
    """Translate whatever can go wrong on the way to a server to an InputError."""
    try:
        yield
    except urllib.error.HTTPError as error:
        with error:
            raise InputError(where, *_describe_status(error.code, error.reason)) from None
    except urllib.error.URLError as error:
        if isinstance(error.reason, TimeoutError):
            raise _timeout_error(where) from None
        reason = getattr(error.reason, "strerror", None) or str(error.reason)
        hint = "Check the network and the address, or download the extract yourself and give it with --from."
        raise InputError(where, f"the server cannot be reached ({reason})", hint) from None
    except TimeoutError:
        raise _timeout_error(where) from None
    except (http.client.HTTPException, ConnectionError, ssl.SSLError) as error:
        problem = f"the connection broke before the answer was complete ({type(error).__name__})"
        raise InputError(where, problem, _OTHER_SERVER) from None


def _timeout_error(where: str) -> InputError:
    problem = f"there was no complete answer within {DOWNLOAD_TIME.maximum:,} s"
    return InputError(where, problem, f"{_OTHER_SERVER} {DOWNLOAD_TIME.hint}")


def _describe_status(code: int, reason: str) -> tuple[str, str]:
    """Return problem and hint for an HTTP status."""
    if code == http.HTTPStatus.TOO_MANY_REQUESTS:
        return "the server refuses more requests for now (HTTP 429)", _OTHER_SERVER
    if code in (http.HTTPStatus.GATEWAY_TIMEOUT, http.HTTPStatus.SERVICE_UNAVAILABLE, http.HTTPStatus.BAD_GATEWAY):
        return f"the server is busy (HTTP {code})", _OTHER_SERVER
    if 300 <= code < 400:
        return f"the server redirects without end or to nowhere (HTTP {code})", "Check the address."
    hint = f"Check the address; it ends in /api/interpreter, as {DEFAULT_URL}."
    return f"the server answered HTTP {code} ({reason})", hint


def _check_answer(path: Path, where: object) -> str:
    """Return the time of the map data; InputError unless a file is a complete extract."""
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if re.search(rb"<osm[\s>]", head) is None:
        text = " ".join(re.sub(rb"<[^>]*>", b" ", head).decode("utf-8", "replace").split())
        quoted = f": {text[:200]!r}" if text else ""
        raise InputError(where, f"expected OpenStreetMap data, got another answer{quoted}", _OTHER_SERVER)
    timestamp = ""
    try:
        for element in xml.iter_elements(path, "osm"):
            if element.tag == "meta":
                timestamp = element.get("osm_base", "")
            elif element.tag == "remark" and "error" in (element.text or ""):
                remark = " ".join((element.text or "").split())
                raise InputError(where, f"the server could not complete the query: {remark}", _OTHER_SERVER)
        osm.read_osm(path)
    except InputError as error:
        if error.where == str(where):
            raise
        if error.problem == "has no nodes":
            raise InputError(where, "there is no map data around this point", "Check --at LAT,LON.") from None
        raise InputError(where, f"the answer is not a complete extract: {error.problem}", _OTHER_SERVER) from None
    return timestamp


def _move_into_cache(answer: Path, cached: Path) -> None:
    try:
        with atomic_write(cached) as partial:
            shutil.copyfile(answer, partial)
    except OSError as error:
        problem = f"the map cannot be cached ({error.strerror})"
        raise InputError(cached, problem, "Set XDG_CACHE_HOME to a folder that you can write to.") from None
