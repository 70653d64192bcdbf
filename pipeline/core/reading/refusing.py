"""The one place that turns what a reader raises into the message of the file that it read.

What readers of foreign files raise (the standard library's, Arrow's, trimesh's, laspy's, our own) has no common base
and is nowhere listed, so that any Exception counts here, and here alone. Its name and words go into the message, and
the exception stays the message's cause, for those who look for a mistake in a reader.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from pipeline.core.errors import EgvsError, InputError

A_WHOLE_FILE = "a whole file; fetch or make it again"
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)


@contextmanager
def reading(place: object, right: str = A_WHOLE_FILE, doing: str = "cannot be read") -> Iterator[None]:
    """What goes wrong within is an InputError of ``place``: what was ``doing``, why, and what would be ``right``.

    Messages of this program pass as they are, and so does a disk without room for what is written aside.
    """
    try:
        yield
    except EgvsError:
        raise
    except OSError as error:
        if error.errno in _NO_ROOM:
            raise
        raise InputError(place, f"{doing} ({why(error)})", right) from error
    except Exception as error:
        raise InputError(place, f"{doing} ({why(error)})", right) from error


def why(error: BaseException) -> str:
    """What an exception says, in words for a user."""
    match error:
        case MemoryError():
            return "it asks for more memory than there is"
        case RecursionError():
            return "it is nested too deeply"
        case UnicodeDecodeError():
            return f"it is no text in {error.encoding}: byte {error.start} is {error.object[error.start]:#x}"
        case OSError() if error.strerror:
            return error.strerror
        case UnicodeError():
            return f"it is no sound text: {error}"
    return _first_line(error)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines and not isinstance(error, KeyError) else f"{type(error).__name__} {error}".strip()
