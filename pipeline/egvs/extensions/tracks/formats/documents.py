"""Read JSON documents of recorded tracks: each value is checked where it is used, and its key is in the message."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.formats import xml

_HINT = "Use the file as it was published."


def read_document(path: Path) -> Node:
    """Read a JSON file, plain or gzipped; InputError when it is damaged or larger than ``EGVS_MAX_DOCUMENT_MB``."""
    limit = limits.DOCUMENT
    limits.checked_size(path, limit)
    with reading.translate_errors(path, _HINT, "is not valid JSON"), xml.open_bounded(path) as file:
        data = file.read(limit.maximum * limits.MB + 1)
        limit.check_bytes(path, len(data), f"holds more than {limit.maximum:,} MB after decompression")
        return Node(reading.parse_json(data), f"{path}: ")


@dataclass(frozen=True)
class Node:
    """A value of a JSON document.

    Attributes
    ----------
    value
        An object, a list, a number, a text, true, false or null.
    where
        File and key, for messages.
    """

    value: Any
    where: str

    def get(self, key: str) -> Node:
        """Return a member of an object; InputError when it is missing."""
        member = self.find(key)
        if member is None:
            raise self._child(key, None).error("is missing")
        return member

    def find(self, key: str) -> Node | None:
        """Return a member of an object, None when it is missing or null; InputError when this is not an object."""
        if not isinstance(self.value, dict):
            raise self.error(f"expected an object, got {self._short()}")
        value = self.value.get(key)
        return None if value is None else self._child(key, value)

    def members(self) -> Iterator[tuple[str, Node]]:
        """Yield the members of an object."""
        if not isinstance(self.value, dict):
            raise self.error(f"expected an object, got {self._short()}")
        for key, value in self.value.items():
            yield key, self._child(key, value)

    def elements(self) -> list[Node]:
        """Return the elements of a list."""
        if not isinstance(self.value, list):
            raise self.error(f"expected a list, got {self._short()}")
        return [self._child(str(index), value) for index, value in enumerate(self.value)]

    def text(self) -> str:
        """Return a text."""
        if not isinstance(self.value, str):
            raise self.error(f"expected a text, got {self._short()}")
        return self.value

    def number(self) -> float:
        """Return a finite number, which may be written as a text."""
        value = self.value
        if isinstance(value, str):
            with contextlib.suppress(ValueError):
                value = float(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self.error(f"expected a number, got {self._short()}")
        return float(value)

    def numbers(self, *counts: int) -> list[float]:
        """Return a list of finite numbers; InputError when their count is not among ``counts``."""
        elements = self.elements()
        if len(elements) not in counts:
            raise self.error(f"expected {' or '.join(map(str, counts))} numbers, got {len(elements)}")
        return [element.number() for element in elements]

    def error(self, problem: str, hint: str = _HINT) -> InputError:
        """Return an error about this value."""
        return InputError(self.where.removesuffix(": "), problem, hint)

    def _child(self, key: str, value: Any) -> Node:
        separator = "" if self.where.endswith(": ") else "."
        return Node(value, f"{self.where}{separator}{key[:80]}")

    def _short(self) -> str:
        return repr(self.value)[:80]
