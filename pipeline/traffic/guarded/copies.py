"""Copies the XML that SUMO is to read, so that SUMO reads nothing that was not read here first.

Steps: read every element with the safe parser, which refuses entities and document types; refuse what makes SUMO read a
further file; where something makes SUMO write one, or the file is in another encoding than UTF-8, write it anew, with
the outputs going nowhere. SUMO reads the copy alone, so that it cannot understand a file in another way than it was
understood here.

By detectors, mean data, probes, calibrators, signal programs and, in any file, ``<param>``, SUMO can be told to write.
None of that is the traffic's, so it is not written; the detectors and devices themselves stay, because signals and
routes may depend on them.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import IO
from xml.etree.ElementTree import Element, tostring
from xml.sax.saxutils import quoteattr

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.formats import safe_xml

NOWHERE = "NUL"
"""SUMO's own name, on any system, of an output that is not written."""

_WRITES = frozenset({"file", "output", "dest"})
_WRITES_BY_PARAM = ("file", "files", "output")
"""How the keys of such a ``<param>`` end: ``file`` of a signal, ``device.ssm.file`` of a vehicle or its type."""

_READS = frozenset({"href", "edgesFile"})
_READERS = frozenset({"rerouter", "variableSpeedSign"})
"""Elements whose ``file`` is read."""


def safe_name(name: str) -> str:
    """A file's name without what SUMO reads as more than a name: lists, variables of the environment."""
    return "".join("_" if sign in ",;$%" else sign for sign in name)


def copy(path: Path, to: Path) -> list[str]:
    """Write a copy of the XML file ``path`` that SUMO may read; what the user should know of it.

    InputError when it is not well-formed, declares entities, or names a further file that SUMO would read.
    """
    unwritten = _outputs_of(path, files.sha256_of(path))
    with files.aside(to) as partial, partial.open("wb") as file:
        if unwritten or safe_xml.encoding_of_file(path) not in ("utf-8", "ascii"):
            _rewrite(path, file)
        else:
            with safe_xml.opened(path) as source:
                shutil.copyfileobj(source, file)
    if not unwritten:
        return []
    told = ", ".join(f"{count} of <{tag}>" for tag, count in unwritten)
    return [f"{path.name}: SUMO's outputs that it asks for are not written: {told}"]


def check(path: Path) -> None:
    """InputError where :func:`copy` would refuse a file."""
    _outputs_of(path, files.sha256_of(path))


@lru_cache(maxsize=32)
def _outputs_of(path: Path, _content: str) -> tuple[tuple[str, int], ...]:
    """The elements of a file that ask for an output, and how many; read once for the check and the copy."""
    found: Counter[str] = Counter()
    for child in _guarded(path):
        found.update(element.tag for element in child.iter() if _output_keys(element))
    return tuple(sorted(found.items()))


def _guarded(path: Path, on_root: Callable[[Element], None] = lambda root: None) -> Iterator[Element]:
    """The children of the root, when nothing in the file has SUMO read a further one."""

    def check_root(root: Element) -> None:
        _refuse(root, path)
        if keys := _output_keys(root):  # SUMO takes any element for the root
            raise InputError(
                path, f"its root <{root.tag} {keys[0]}=...> asks for an output", "a root like <additional>"
            )
        on_root(root)

    for child in safe_xml.children(path, "", on_root=check_root):
        for element in child.iter():
            _refuse(element, path)
        yield child


def _rewrite(path: Path, file: IO[bytes]) -> None:
    """Write a file anew, as UTF-8, with outputs that go nowhere."""
    roots: list[Element] = []

    def open_root(root: Element) -> None:
        roots.append(root)
        named = "".join(f" {key}={quoteattr(value)}" for key, value in root.attrib.items() if "}" not in key)
        file.write(f"<{root.tag}{named}>\n".encode())

    for child in _guarded(path, open_root):
        for element in child.iter():
            for key in _output_keys(element):
                element.set(key, NOWHERE)
        file.write(tostring(child, encoding="utf-8"))
    file.write(f"</{roots[0].tag}>\n".encode())


def _refuse(element: Element, path: Path) -> None:
    if "}" in element.tag:
        raise InputError(path, f"<{element.tag}> is in a namespace", "SUMO's elements, which have none")
    read = _READS | ({"file"} if element.tag in _READERS else set())
    for key in sorted(read & element.attrib.keys()):
        if element.attrib[key] not in ("", NOWHERE):
            what = f"<{element.tag} {key}={element.attrib[key]!r}> has SUMO read a further file"
            raise InputError(path, what, "its content in this file itself")


def _output_keys(element: Element) -> list[str]:
    """The attributes by which an element asks for an output."""
    keys = sorted(_WRITES & element.attrib.keys())
    if element.tag == "param" and element.get("key", "").lower().endswith(_WRITES_BY_PARAM):
        keys.append("value")
    return [key for key in keys if element.get(key, "") not in ("", NOWHERE)]
