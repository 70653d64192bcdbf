"""A local Overpass server with recorded answers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

SMALL = Path(__file__).parent / "data" / "small.osm"

Respond = Callable[[BaseHTTPRequestHandler], None]


@dataclass
class OverpassServer:
    """Address of a server, and the requests that it has received: query and headers."""

    url: str
    queries: list[str] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)


@contextmanager
def overpass_server(respond: Respond) -> Iterator[OverpassServer]:
    """Run a server on a free port of this machine that answers each request with ``respond``."""
    requests = OverpassServer("")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requests.queries += parse_qs(urlsplit(self.path).query).get("data", [])
            requests.headers.append(dict(self.headers.items()))
            with suppress(BrokenPipeError, ConnectionResetError):  # the client has seen enough
                respond(self)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        requests.url = f"http://127.0.0.1:{server.server_port}/api/interpreter"
        try:
            yield requests
        finally:
            server.shutdown()
            thread.join()


def recorded_answer(extract: Path = SMALL) -> bytes:
    """Return an extract as an Overpass server writes it: no bounds, but a note and the time of the data."""
    lines = extract.read_text(encoding="utf-8").splitlines()
    content = [line for line in lines[2:] if "<bounds" not in line and "<!--" not in line]
    head = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        '<osm version="0.6" generator="Overpass API 0.7.62.7">',
        "<note>The data included in this document is from www.openstreetmap.org. The data is made available under"
        " ODbL.</note>",
        '<meta osm_base="2026-11-01T10:20:30Z"/>',
    ]
    return "\n".join([*head, *content, ""]).encode("utf-8")


def send(body: bytes, status: int = 200, content_type: str = "application/osm3s+xml", **headers: str) -> Respond:
    """Return a handler that sends one answer."""

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        handler.send_header("Content-Type", content_type)
        for name, value in ({"Content_Length": str(len(body))} | headers).items():
            if value:
                handler.send_header(name.replace("_", "-"), value)
        handler.end_headers()
        handler.wfile.write(body)

    return respond
