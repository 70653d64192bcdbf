"""Serve a page during a test."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from egvs.explore.page import Page


@contextmanager
def serving(page: Page) -> Iterator[Page]:
    """Run the page's loop in a thread."""
    loop = threading.Thread(target=page.run)
    loop.start()
    try:
        yield page
    finally:
        page.end()
        loop.join()
        page.stop()
