"""Pages of E57 files: each of 1024 bytes ends with the checksum of the others (ASTM E2807, 8.2.2)."""

from __future__ import annotations

import struct
from functools import cache

PAGE_BYTES = 1024


def with_checksums(data: bytes) -> bytes:
    """The same content, with the checksum that each page must have."""
    pages = [data[start : start + PAGE_BYTES] for start in range(0, len(data), PAGE_BYTES)]
    return b"".join(
        page[:-4] + struct.pack(">I", crc32c(page[:-4])) if len(page) == PAGE_BYTES else page for page in pages
    )


def crc32c(data: bytes) -> int:
    """Castagnoli's checksum (RFC 3720, appendix B.4)."""
    table, value = _table(), 0xFFFFFFFF
    for byte in data:
        value = table[(value ^ byte) & 255] ^ (value >> 8)
    return value ^ 0xFFFFFFFF


@cache
def _table() -> tuple[int, ...]:
    rows = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
        rows.append(value)
    return tuple(rows)
