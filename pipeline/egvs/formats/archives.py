"""Unpack ZIP archives of map files, such as zipped Shapefiles and tiles, and KMZ files.

Another process (:mod:`egvs.formats.reader_process`) unpacks the members; this one writes them to a temporary folder
that is named like the archive. Members whose names lead out of it, links, encrypted members and two members of one
name are errors. ZIP archives inside of archives are unpacked to folders as well, up to :data:`MAX_DEPTH`. Messages name
the archive and the member, never the temporary folder.

Beside the suffix, the first bytes tell an archive: a file named ``.zip`` with other content, such as a map in plain
text, is left to the reader of its content, and a map that is zipped under its own name is unpacked.
"""

from __future__ import annotations

import errno
import os
import stat
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path, PurePosixPath

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.reading import COMPLETE_FILE, name_in_errors
from egvs.formats.reader_process import Block, read_blocks, serve

SUFFIX = ".zip"
"""Files with this ending stand for the files in them, as folders do."""

MAX_MEMBERS = 10_000
"""Largest number of files in an archive."""

MAX_NAME_LENGTH = 1000
"""Largest number of characters of the path of a file in an archive."""

_NAME_ERRNOS = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EILSEQ, errno.EINVAL)

MAX_DEPTH = 3
"""Deepest nesting of archives in archives."""

_SIGNATURES = (b"PK\x03\x04", b"PK\x05\x06")
_OTHER_ZIP_FORMATS = (".kmz", ".xlsx", ".ods", ".npz", ".usdz")
_CHUNK_BYTES = 1 << 20
_CANNOT_READ = "cannot be read as a ZIP archive"
_UNPACK_HINT = "Unpack it, and give the file or the folder."
_IGNORED = ("__MACOSX", "Thumbs.db")


class UnpackedFiles:
    """Files and folders, archives among them unpacked.

    Attributes
    ----------
    paths
        In the order given; a folder for each archive.
    """

    def __init__(self) -> None:
        self.paths: list[Path] = []
        self._originals: dict[str, str] = {}

    def add(self, archive: Path, folder: Path) -> None:
        """Add an archive that was unpacked to a folder."""
        self.paths.append(folder)
        self._originals[os.fspath(folder)] = os.fspath(archive)

    def user_text(self, text: str) -> str:
        """Return a text with the names of the archives instead of the folders."""
        for folder, archive in self._originals.items():
            text = text.replace(folder, archive)
        return text


@contextmanager
def unpack_archives(paths: Sequence[Path], suffixes: Sequence[str] = (SUFFIX,)) -> Iterator[UnpackedFiles]:
    """Yield files with a folder for each archive among them, and let errors in the block name the archive.

    Parameters
    ----------
    paths
        Files and folders.
    suffixes
        Endings of the names of archives.

    Raises
    ------
    InputError
        When an archive is damaged or encrypted, has members that lead out of it or of one name, or too many or too
        large ones.
    """
    unpacked = UnpackedFiles()
    with ExitStack() as stack:
        for path in paths:
            if not _is_archive(path, suffixes):
                unpacked.paths.append(path)
                continue
            folder = stack.enter_context(files.temporary_folder()) / path.name
            folder.mkdir()
            unpacked.add(path, folder)
            with name_in_errors(unpacked.user_text):
                _unpack(path, os.fspath(path), folder)
        with name_in_errors(unpacked.user_text):
            yield unpacked


def _is_archive(path: Path, suffixes: Sequence[str]) -> bool:
    suffix = path.suffix.lower()
    if not path.is_file():
        return False
    if suffix in suffixes and suffix != SUFFIX:
        return True
    try:
        with path.open("rb") as file:
            is_zip = file.read(4) in _SIGNATURES
    except OSError:
        return suffix in suffixes  # the error names the file
    return is_zip and suffix not in _OTHER_ZIP_FORMATS


def _unpack(path: Path, where: str, folder: Path, size: int = 0, depth: int = 1) -> int:
    """Write the members of an archive to a folder; return the bytes unpacked so far, ``size`` among them."""
    limits.checked_size(path, limits.FILE, where)
    inner: dict[Path, None] = {}
    for block in read_blocks(__name__, path, where, _CANNOT_READ):
        name = block.values["name"]
        size += len(block.content)
        limits.UNPACKED.check_bytes(where, size)
        target = folder.joinpath(*_parts(name, where))
        try:
            _append(target, block.content)
        except OSError as error:
            if error.errno not in _NAME_ERRNOS:
                raise
            raise _name_error(where, name, f"cannot be unpacked ({error.strerror})") from None
        if target.suffix.lower() == SUFFIX:
            inner.setdefault(target)
    for archive in filter(zipfile.is_zipfile, inner):
        if depth == MAX_DEPTH:
            raise InputError(archive, f"archives are nested more than {MAX_DEPTH} deep", _UNPACK_HINT)
        packed = archive.rename(archive.with_name(".packed"))  # no member has such a name
        archive.mkdir()
        size = _unpack(packed, os.fspath(archive), archive, size, depth + 1)
        packed.unlink()
    return size


def _append(target: Path, content: bytes | memoryview) -> None:
    """Create a file, for its first block, which is empty, or add another block to it."""
    if content:
        with target.open("ab") as file:
            file.write(content)
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    target.touch(exist_ok=False)  # where case does not count, two members may have one name only here


def _parts(name: str, where: object) -> tuple[str, ...]:
    """Return the parts of a member's path inside its archive; InputError when it leads out of it."""
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or name.startswith("/") or any(mark in name for mark in "\\:\0"):
        problem = f"its member {name[:80]!r} leads out of the archive"
        raise InputError(where, problem, "Make the archive again, with relative paths.")
    if len(name) > MAX_NAME_LENGTH:
        raise _name_error(where, name, f"has a name of {len(name):,} characters; at most {MAX_NAME_LENGTH} are read")
    return parts


def _name_error(where: object, name: str, problem: str) -> InputError:
    return InputError(where, f"its member {name[:80]!r} {problem}", "Make the archive again, with other names.")


def _check_distinct(names: dict[tuple[str, ...], str], path: Path) -> None:
    """Check that no member is a folder of another one; names by their parts."""
    for parts, name in names.items():
        for end in range(1, len(parts)):
            if parts[:end] in names:
                raise _name_error(path, name, f"is in a folder that has the name of the file {names[parts[:end]]!r}")


# --- in the other process ---


def _read_file(path: Path) -> Iterator[Block]:
    """Yield the content of each file in chunks."""
    with zipfile.ZipFile(path) as archive:
        members = [member for member in archive.infolist() if not member.is_dir()]
        if len(members) > MAX_MEMBERS:
            problem = f"has {len(members):,} files; at most {MAX_MEMBERS:,} are read"
            raise InputError(path, problem, "Make an archive of the files around the junction.")
        declared = sum(member.file_size for member in members)
        limits.UNPACKED.check_bytes(path, declared, f"has {declared / limits.MB:,.0f} MB after decompression")
        names: dict[tuple[str, ...], str] = {}
        read = []
        for member in members:
            if member.flag_bits & 1:
                raise InputError(path, f"its member {member.filename[:80]!r} is encrypted", _UNPACK_HINT)
            if stat.S_ISLNK(member.external_attr >> 16):
                raise InputError(path, f"its member {member.filename[:80]!r} is a link", _UNPACK_HINT)
            parts = _parts(member.filename, path)
            if parts[0] in _IGNORED or parts[-1].startswith("."):
                continue
            if parts in names:
                raise _name_error(path, member.filename, "is there twice")
            names[parts] = member.filename
            read.append(member)
        _check_distinct(names, path)
        for member in read:
            yield from _read_member(archive, member)


def _read_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[Block]:
    values = {"name": member.filename}
    yield Block(values)
    try:
        with archive.open(member) as content:
            while chunk := content.read(_CHUNK_BYTES):
                yield Block(values, chunk)
    except NotImplementedError as error:
        problem = f"its member {member.filename[:80]!r} cannot be unpacked ({error})"
        raise InputError(archive.filename, problem, _UNPACK_HINT) from None
    except (zipfile.BadZipFile, EOFError) as error:
        problem = f"its member {member.filename[:80]!r} is damaged ({error})"
        raise InputError(archive.filename, problem, COMPLETE_FILE) from None


if __name__ == "__main__":
    serve(_read_file)
