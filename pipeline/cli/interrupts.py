"""Lets no interrupt be lost: one that comes while a module is imported waits until that is done.

trimesh wraps its imports in ``except BaseException``, so that a KeyboardInterrupt there would be taken for a library
that is not installed, and the run would go on.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_LOOK_AGAIN_S = 0.02
_IMPORTS = "<frozen importlib._bootstrap>"


@contextmanager
def after_imports() -> Iterator[None]:
    """Raise KeyboardInterrupt at Ctrl-C, as Python does, but only where no import is under way."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # ignored, say: so it stays
        yield
        return
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGINT, signal.SIGALRM)}
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTS:
            signal.setitimer(signal.ITIMER_REAL, _LOOK_AGAIN_S)  # which comes back here, as SIGALRM
            return
        frame = frame.f_back
    raise KeyboardInterrupt
