"""Events for all open pages, as server-sent events: from any thread to each browser."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

_PING_S = 15.0
_END = ""
_MOST_WAITING = 500
"""Events that wait for a browser; a slower one misses the oldest, and fetches the state."""


class Events:
    """Sends events to every browser that listens."""

    def __init__(self) -> None:
        self._queues: dict[asyncio.Queue[str], asyncio.AbstractEventLoop] = {}

    def publish(self, name: str, content: Any) -> None:
        """Send an event; may be called in any thread."""
        text = f"event: {name}\ndata: {json.dumps(content, ensure_ascii=False)}\n\n"
        for queue, loop in list(self._queues.items()):
            if not loop.is_closed():
                loop.call_soon_threadsafe(_put, queue, text)

    def close(self) -> None:
        """End all streams; called in the thread of the server."""
        for queue in self._queues:
            _put(queue, _END)

    async def stream(self, first: dict[str, Any]) -> AsyncIterator[str]:
        """Yield the events for one browser; ``first`` is the content of the first one, a ``state``."""
        queue: asyncio.Queue[str] = asyncio.Queue(_MOST_WAITING)
        self._queues[queue] = asyncio.get_running_loop()
        try:
            yield f"event: state\ndata: {json.dumps(first)}\n\n"
            while True:
                try:
                    text = await asyncio.wait_for(queue.get(), _PING_S)
                except TimeoutError:
                    text = ": ping\n\n"
                if text == _END:
                    return
                yield text
        finally:
            del self._queues[queue]


def _put(queue: asyncio.Queue[str], text: str) -> None:
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(text)
