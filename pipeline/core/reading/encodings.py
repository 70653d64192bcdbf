"""Says in which encoding an XML file is written, and hands its bytes out as UTF-8.

An XML parser knows UTF-8, UTF-16, Latin-1 and ASCII. Files declare others: Shift_JIS and EUC-JP are everyday in Japan.
Those of :data:`KNOWN` are decoded here, by Python's own tables; any other one is refused, UTF-7 above all, in which
plain letters may stand for markup.
"""

from __future__ import annotations

import codecs
import re
from typing import IO

OF_THE_PARSER = frozenset({"utf-8", "utf-16", "iso8859-1", "ascii"})
"""Python's names of what an XML parser reads itself."""

KNOWN = frozenset(
    {"cp932", "euc_jp", "iso2022_jp", "gb18030", "gbk", "gb2312", "big5", "euc_kr", "koi8-r"}
    | {f"cp125{n}" for n in range(9)}
    | {f"iso8859-{n}" for n in range(2, 17)}
)
"""Python's names of what is decoded here."""

IN_WORDS = "UTF-8, UTF-16, Shift_JIS, EUC-JP, ISO-8859-x, windows-125x, GB18030, Big5 or EUC-KR"
_AS_ON_THE_WEB = {"shift_jis": "cp932", "gb2312": "gb18030", "gbk": "gb18030"}
"""What is declared as one of these is in practice, and by the WHATWG's Encoding Standard, its superset."""
_ALIASES = {"windows-31j": "cp932", "x-sjis": "cp932"}

_DECLARED = re.compile(rb"""(?:\xef\xbb\xbf)?<\?xml[^>]*?\bencoding\s*=\s*["']([^"']{0,80})["']""")
_DECLARATION_BYTES = 512
_UTF_16 = (b"\xff\xfe", b"\xfe\xff", b"<\x00", b"\x00<")


def encoding_of(start: bytes) -> str | None:
    """Python's name of the encoding that the ``start`` of an XML file shows; None for one that nobody knows."""
    if start.startswith(_UTF_16):
        return "utf-16"
    declared = _DECLARED.match(start[:_DECLARATION_BYTES])
    if declared is None:
        return "utf-8"
    try:
        name = declared[1].decode("ascii").lower()
        name = codecs.lookup(_ALIASES.get(name, name)).name
    except (LookupError, UnicodeDecodeError, ValueError):
        return None
    name = _AS_ON_THE_WEB.get(name, name)
    return name if name in OF_THE_PARSER | KNOWN else None


class AsUtf8:
    """A file in another encoding, to be read as UTF-8; UnicodeDecodeError where its bytes are no text."""

    def __init__(self, file: IO[bytes], encoding: str) -> None:
        self._file, self._decoder = file, codecs.getincrementaldecoder(encoding)()

    def read(self, size: int) -> bytes:
        """At least one byte, of about ``size`` of the file's own; none at its end."""
        while chunk := self._file.read(size):
            if text := self._decoder.decode(chunk):
                return text.encode("utf-8")
        return self._decoder.decode(b"", final=True).encode("utf-8")
