"""Damages a file's bytes in the ways that files get damaged, and in those that someone who means harm would choose.

A mutant is one to three changes on top of each other, all drawn from one generator: the same seed, the same mutant.
Text gets changes that know of numbers, words, lines, brackets and encodings; gzip, zip and E57 are also opened, changed
inside, and closed again with right checksums, for else no mutant would come further than the checksum. Half of the
changes know the format of the file (:mod:`tests.fuzz.structure`).
"""

from __future__ import annotations

import gzip
import io
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import cache

from tests.formats.e57_pages import with_checksums
from tests.fuzz import structure

Change = Callable[[random.Random, bytes], bytes]

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(r"[A-Za-z_][A-Za-z0-9_.]*")
_HOSTILE_NUMBERS = (
    "nan", "inf", "-inf", "Infinity", "1e308", "-1e308", "1e-300", "1e-320", "1e400", "0", "-0", "-1", "0.0000001",
    "9" * 5000, "2147483647", "2147483648", "4294967296", "9223372036854775808", "1e9", "1e15", "0x10", "1_000", "1,5",
    "٣", "", "--1", "true", "[]",
)  # fmt: skip
_HOSTILE_WORDS = (
    "", "x" * 200_000, "\\ud800", "../../x", "/etc/passwd", "[red]", "[/x]", "\x1b[2J", "\u202e", "é", "名前", "🚗",
    "a\x00b", "%s%n", "$HOME", "<b>", "&amp;", "&x;", "'", '"', "NUL", " ", "null", "__proto__",
)  # fmt: skip
_BYTES = (
    b"\x00", b"\xff", b"\x7f", b"\x80", b"\n", b"\r", b'"', b"<", b"{", b"[", b",", b";", b"\x1f\x8b", b"PAR1",
    b"PK\x03\x04",
)  # fmt: skip
_WORDS_OF_BITS = tuple(
    struct.pack(form, value)
    for form, values in (
        ("<I", (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 10**9)),
        (">I", (1, 2**31 - 1, 2**32 - 1)),
        ("<Q", (0, 2**31, 2**40, 2**63 - 1, 2**64 - 1)),
        ("<H", (0, 1, 2**15, 2**16 - 1)),
        ("<d", (float("nan"), float("inf"), 1e308, 1e-300, -1.0)),
        ("<f", (float("nan"), float("inf"), 3e38, 1e-38)),
    )
    for value in values
)
_MOST_BYTES = 4_000_000
"""A mutant that has grown beyond is cut, except for bombs."""

_SMALL = 1_000_000
"""What is larger when it is packed may be a bomb, and is not opened here."""


def mutant(rng: random.Random, data: bytes) -> bytes:
    """Other bytes than ``data``, by one to three changes."""
    for _ in range(20):
        changed = data
        for _ in range(rng.choice((1, 1, 1, 2, 3))):
            changed = _changed(rng, changed)
        if changed != data:
            return changed
    return data + b"\x00"


def _changed(rng: random.Random, data: bytes) -> bytes:
    """One change, inside of what is packed more often than not."""
    if data.startswith(b"\x1f\x8b") and len(data) < _SMALL and rng.random() < 0.7:
        return _in_gzip(rng, data)
    if data.startswith(b"PK\x03\x04") and rng.random() < 0.7:
        return _in_zip(rng, data)
    if data.startswith(b"ASTM-E57") and rng.random() < 0.7:
        return _in_e57(rng, data)
    if rng.random() < 0.5 and (change := structure_change(data)) is not None:
        try:
            return change(rng, data)[:_MOST_BYTES]
        except Exception:  # noqa: BLE001 - an earlier change has broken the format
            pass
    text = _as_text(data)
    if text is None or rng.random() < 0.25:
        return rng.choice(_ON_BYTES)(rng, data)[:_MOST_BYTES]
    return rng.choice(_ON_TEXT)(rng, text)[:_MOST_BYTES]


def structure_change(data: bytes) -> Change | None:
    """What changes the structure of a file of this format; None where nothing does."""
    head = data[:2000].lstrip(b"\xef\xbb\xbf \r\n\t")
    for signs, change in _BY_SIGNATURE:
        if head.startswith(signs):
            return change
    if head.startswith(b"<"):
        return structure.change_xml
    if head.startswith((b"{", b"[")):
        return structure.change_json
    if b"OSMHeader" in head[:40]:
        return lambda rng, data: structure.change_pbf(rng, data, structure.change_protobuf)
    if head.count(b",") + head.count(b";") > 1 and _as_text(data) is not None:
        return structure.change_table
    return None


def _as_text(data: bytes) -> str | None:
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return None
    return None if "\x00" in text else text


# ---- bytes


def _place(rng: random.Random, data: bytes) -> tuple[int, int]:
    """Where a change begins and ends: near the head of the file as often as anywhere."""
    most = len(data) if rng.random() < 0.5 else min(len(data), 256)
    begin = rng.randrange(most + 1)
    return begin, min(len(data), begin + rng.choice((1, 1, 2, 4, 8, 16, 64, 1024)))


def _flip(rng: random.Random, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        if changed:
            changed[min(_place(rng, data)[0], len(changed) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _drop(rng: random.Random, data: bytes) -> bytes:
    begin, end = _place(rng, data)
    return data[:begin] + data[end:]


def _double(rng: random.Random, data: bytes) -> bytes:
    begin, end = _place(rng, data)
    return data[:end] + data[begin:end] * rng.choice((1, 1, 3, 1000)) + data[end:]


def _insert(rng: random.Random, data: bytes) -> bytes:
    begin, _ = _place(rng, data)
    return data[:begin] + rng.choice((*_BYTES, rng.randbytes(8))) + data[begin:]


def _overwrite(rng: random.Random, data: bytes) -> bytes:
    begin, _ = _place(rng, data)
    value = rng.choice((*_BYTES, *_WORDS_OF_BITS, *_WORDS_OF_BITS))
    return data[:begin] + value + data[begin + len(value) :]


def _cut(rng: random.Random, data: bytes) -> bytes:
    return data[: rng.choice((rng.randrange(len(data) + 1), max(0, len(data) - rng.randrange(1, 16))))]


def _swap(rng: random.Random, data: bytes) -> bytes:
    a, b, c = sorted(rng.randrange(len(data) + 1) for _ in range(3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _blank(rng: random.Random, data: bytes) -> bytes:
    begin, end = _place(rng, data)
    return data[:begin] + rng.choice((b"\x00", b"\xff", b" ")) * (end - begin) + data[end:]


def _around(rng: random.Random, data: bytes) -> bytes:
    """Something before or behind, or nothing left."""
    return rng.choice(
        (b"\xef\xbb\xbf" + data, data + rng.randbytes(5), data + data, b"", b"\n" + data, data + b"\x00" * 512)
    )


def _pack(rng: random.Random, data: bytes) -> bytes:
    """Gzipped although its name does not say so; in a few cases a bomb of 3 GB."""
    if rng.random() < 0.15:
        return gzip.compress(data, mtime=0) + _bomb(rng.choice((b"\x00", b" ", b"\n", b"1")))
    return gzip.compress(data, mtime=0)


# ---- what is packed


def _bomb(byte: bytes) -> bytes:
    """3 GB of one byte as gzip members, in some 3 MB."""
    return _member(byte) * 48


_MOST_INNER_BYTES = 16 << 20
"""What is changed inside of a gzip: patterns take long on blank characters."""


@cache
def _member(byte: bytes) -> bytes:
    return gzip.compress(byte * 2**26, mtime=0)


def _in_gzip(rng: random.Random, data: bytes) -> bytes:
    try:
        inner = gzip.decompress(data)
    except (OSError, EOFError, zlib.error):
        return _flip(rng, data)
    if len(inner) > _MOST_INNER_BYTES:  # a bomb, from an earlier change
        return _flip(rng, data)
    if rng.random() < 0.03:
        return data + _bomb(rng.choice((b"\x00", b" ", b"\n")))
    return gzip.compress(_changed(rng, inner), mtime=0)


def _in_zip(rng: random.Random, data: bytes) -> bytes:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            members = {info.filename: packed.read(info) for info in packed.infolist()}
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError):
        return _flip(rng, data)
    chosen = rng.choice(sorted(members))
    members[chosen] = _changed(rng, members[chosen])
    return zipped(members)


def _in_e57(rng: random.Random, data: bytes) -> bytes:
    """Other bytes of the same length, in its XML more often than not, behind the right checksums."""
    begin = max(0, data.find(b"<?xml")) if rng.random() < 0.7 else 0
    change = rng.choice((_flip, _overwrite, _blank, _digit))
    changed = data[:begin] + change(rng, data[begin:])
    return with_checksums(changed[: len(data)])


def _digit(rng: random.Random, data: bytes) -> bytes:
    """A digit becomes another one, or a sign."""
    places = [match.start() for match in re.finditer(rb"[0-9]", data)]
    if not places:
        return _flip(rng, data)
    at = rng.choice(places)
    return data[:at] + rng.choice((b"0", b"9", b"-", b"e", b".")) + data[at + 1 :]


def zipped(members: dict[str, bytes]) -> bytes:
    """A zip file of these members, the same bytes whenever it is made."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, content in members.items():
            packed.writestr(zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0)), content)
    return file.getvalue()


# ---- text


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _number(rng: random.Random, text: str) -> bytes:
    """A number becomes a hostile one, or a little another."""
    found = list(_NUMBER.finditer(text))
    if not found:
        return _encoded(text + rng.choice(_HOSTILE_NUMBERS))
    at = rng.choice(found)
    if rng.random() < 0.3 and len(at[0]) < 300:
        value = float(at[0])
        new = f"{rng.choice((value + 1, value - 1, value * 1.001, -value, value * 1e6, value * 1e-6)):g}"
    else:
        new = rng.choice(_HOSTILE_NUMBERS)
    return _encoded(text[: at.start()] + new + text[at.end() :])


def _word(rng: random.Random, text: str) -> bytes:
    found = list(_WORD.finditer(text))
    if not found:
        return _encoded(text + rng.choice(_HOSTILE_WORDS))
    at = rng.choice(found)
    new = rng.choice((*_HOSTILE_WORDS, *(rng.choice(found)[0] for _ in range(8))))
    return _encoded(text[: at.start()] + new + text[at.end() :])


def _line(rng: random.Random, text: str) -> bytes:
    """A line goes, comes again, or changes its place."""
    lines = text.splitlines(keepends=True) or [""]
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    how = rng.randrange(4)
    if how == 0:
        del lines[at]
    elif how == 1:
        lines[at] *= rng.choice((2, 2, 3, 5000))
    elif how == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = lines[at][: rng.randrange(len(lines[at]) + 1)]
    return _encoded("".join(lines))


def _sign(rng: random.Random, text: str) -> bytes:
    """A bracket, quote or separator goes, or comes."""
    places = [i for i, sign in enumerate(text) if sign in "{}[]()<>,;:=\"'/\n\t "]
    if not places:
        return _encoded(text + rng.choice("{}[]<>,;\"'"))
    at = rng.choice(places)
    return _encoded(text[:at] + rng.choice(("", text[at] * 2, rng.choice("{}[]<>,;:=\"'/\n"))) + text[at + 1 :])


def _deep(rng: random.Random, text: str) -> bytes:
    """A value becomes 5,000 brackets deep."""
    found = list(_NUMBER.finditer(text))
    at = rng.choice(found).span() if found else (0, 0)
    left, right = rng.choice((("[", "]"), ('{"a":', "}"), ("{a=", "}"), ("<a>", "</a>"), ("(", ")")))
    depth = rng.choice((100, 5000))
    return _encoded(text[: at[0]] + left * depth + "1" + right * depth + text[at[1] :])


def _declared(rng: random.Random, text: str) -> bytes:
    """Another encoding, told or not."""
    name = rng.choice(("utf-16", "utf-32", "shift_jis", "latin-1", "utf-7", "cp037", "euc_jp"))
    said = rng.choice((name, name, "utf-8", "no-such-encoding"))
    if text.lstrip().startswith("<"):
        text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text)
        text = f'<?xml version="1.0" encoding="{said}"?>{text}'
    return text.encode(name, "replace")


def _entities(rng: random.Random, text: str) -> bytes:
    """XML entities that grow, or read a file; for what is no XML, just text."""
    levels = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 9))
    entity = rng.choice(('<!ENTITY x SYSTEM "file:///etc/passwd">', f'<!ENTITY a0 "lol">{levels}'))
    root = re.search(r"<([A-Za-z][\w-]*)", text)
    at = root.start() if root else 0
    return _encoded(f"{text[:at]}<!DOCTYPE r [{entity}]>{text[at:].replace('>', '>&a8;', 1)}")


_ON_BYTES: tuple[Change, ...] = (
    _flip, _flip, _flip, _drop, _double, _insert, _overwrite, _overwrite, _overwrite, _cut, _swap, _blank, _around,
    _pack,
)  # fmt: skip
_ON_TEXT: tuple[Callable[[random.Random, str], bytes], ...] = (
    _number, _number, _number, _number, _number, _word, _word, _word, _line, _line, _line, _sign, _sign, _deep,
    _declared, _entities,
)  # fmt: skip
_BY_SIGNATURE: tuple[tuple[bytes | tuple[bytes, ...], Change], ...] = (
    ((b"PAR1", b"ARROW1"), structure.change_arrow),
    (b"SQLite format 3\x00", structure.change_sqlite),
    ((b"II*\x00", b"MM\x00*"), structure.change_tiff),
    (b"LASF", structure.change_las),
    (b"glTF", structure.change_glb),
    ((b"ply", b"# .PCD", b"VERSION"), lambda rng, data: structure.change_head(rng, data, _changed)),
)
"""Start of a file, and what changes its structure."""
