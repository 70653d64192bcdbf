"""Serve a folder on a free port during a test, and ask it as a browser would."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from egvs.extensions.desk.serving import make_server

JOB_S = 900.0


class Client:
    """A browser that has opened the address with the key."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.host = urlsplit(address).netloc
        self.cookie = ""
        status, headers, _ = self.raw("GET", f"/?{urlsplit(address).query}")
        assert status == 303
        self.cookie = headers["set-cookie"].partition(";")[0]

    def raw(
        self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None, *, chunked: bool = False
    ) -> tuple[int, dict[str, str], bytes]:
        """Send a request; return status, headers and body."""
        connection = http.client.HTTPConnection(self.host, timeout=600)
        sent = {"Origin": f"http://{self.host}", "Cookie": self.cookie, **(headers or {})}
        try:
            sent = {key: value for key, value in sent.items() if value}
            connection.request(method, path, body, sent, encode_chunked=chunked)
            response = connection.getresponse()
            return response.status, {key.lower(): value for key, value in response.getheaders()}, response.read()
        finally:
            connection.close()

    def __call__(self, method: str, path: str, body: Any = None) -> tuple[int, Any]:
        """Send JSON; return the status and the JSON of the answer."""
        data = body if body is None or isinstance(body, bytes) else json.dumps(body).encode()
        status, _, content = self.raw(method, quote(path, safe="/?=&%"), data)
        return status, json.loads(content)

    def ok(self, method: str, path: str, body: Any = None) -> Any:
        """Send a request that is met; return the answer."""
        status, content = self(method, path, body)
        assert status < 300, content
        return content

    def refused(self, method: str, path: str, body: Any = None) -> tuple[int, str, str]:
        """Send a request that is refused; return status, message and field."""
        status, content = self(method, path, body)
        assert 400 <= status < 500, content
        return status, content["message"], content["field"]

    @property
    def project(self) -> dict[str, Any]:
        """The open scenario."""
        project: dict[str, Any] = self.ok("GET", "/api/state")["project"]
        return project

    def wait(self, state: str = "done") -> dict[str, Any]:
        """Wait for the end of the job; return it."""
        end_s = time.monotonic() + JOB_S
        while time.monotonic() < end_s:
            job: dict[str, Any] = self.ok("GET", "/api/state")["job"]
            if job["state"] != "runs":
                assert job["state"] == state, job
                return job
            time.sleep(0.1)
        raise AssertionError("the job does not end")


@contextmanager
def serving(folder: Path, scratch: Path) -> Iterator[Client]:
    """Serve a folder."""
    scratch.mkdir(exist_ok=True)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        server, address, _ = make_server(folder, scratch, listening.getsockname()[1])
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            yield Client(address)
        finally:
            server.should_exit = True
            thread.join()
