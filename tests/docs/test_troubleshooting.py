"""docs/troubleshooting.md quotes only messages that the program has, and commands really print them."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import DOCS, ROOT

PAGE = DOCS / "troubleshooting.md"
_BLOCK = re.compile(r"^```text\n(.*?)^```$", re.DOTALL | re.MULTILINE)
VARIABLE = "…"
MIN_LETTERS = 8


def quoted_messages() -> list[str]:
    return [line for block in _BLOCK.findall(PAGE.read_text(encoding="utf-8")) for line in block.splitlines()]


def text_of(node: ast.AST) -> str | None:
    """Return the text of a string or an f-string, with an ellipsis for each value; None for other nodes.

    ``number_of(x, "frame")`` becomes "… frames".
    """
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(text_of(part) or VARIABLE for part in node.values)
    match node:
        case ast.FormattedValue(value=ast.Call(func=ast.Name(id="number_of"), args=[_, ast.Constant(str(noun)), *_])):
            return f"{VARIABLE} {noun}s"
    return None


def beginning_of_longest_part(message: str) -> str:
    """Return some characters of a message by which the module that prints it is found quickly."""
    return max(message.split(VARIABLE), key=len).strip()[:12]


def program_texts() -> Iterator[str]:
    """Yield every text in modules that may print a quoted message, in templates of pages and in the Makefile."""
    package = ROOT / "pipeline" / "egvs"
    beginnings = [beginning_of_longest_part(message) for message in quoted_messages()]
    for path in package.rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        if not any(beginning in source for beginning in beginnings):
            continue
        nodes = list(ast.walk(ast.parse(source)))
        docstrings = {node.value for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            text = text_of(node)
            if text is not None and node not in docstrings:
                yield text
    for path in [*package.rglob("*.j2"), ROOT / "Makefile"]:
        yield path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def all_texts() -> str:
    return "\0".join(program_texts())


@pytest.mark.slow
def test_every_quoted_message_is_in_the_program(all_texts: str) -> None:
    messages = quoted_messages()
    assert len(messages) > 50
    assert [message for message in messages if message not in all_texts] == []


def test_quoted_messages_can_be_recognised() -> None:
    for message in quoted_messages():
        assert len(re.findall(r"[a-zA-Z]", message)) >= MIN_LETTERS, message


def test_reads_variable_parts_of_messages() -> None:
    (statement,) = ast.parse('f"{a} of {b:,} vehicles" f" ({c!r}) wait"').body
    assert isinstance(statement, ast.Expr)
    assert text_of(statement.value) == "… of … vehicles (…) wait"
    (statement,) = ast.parse("""f"in {number_of(n, 'frame')} of it\"""").body
    assert isinstance(statement, ast.Expr)
    assert text_of(statement.value) == "in … frames of it"


def quoted(beginning: str) -> re.Pattern[str]:
    """Return a pattern of the message on the page that begins with some words."""
    (message,) = [message for message in quoted_messages() if message.startswith(beginning)]
    return re.compile(".*?".join(re.escape(part) for part in message.split(VARIABLE)), re.DOTALL)


BAD_SITE = "site,x_m,y_m,z_m\nbad,{},3\n"


@pytest.mark.parametrize(
    ("beginning", "command", "sites"),
    [
        ("no map is given", ["new", "{tmp}/fresh"], ""),
        ("expected a new folder, got one", ["new", "{mini}", "--from", "{mini}/town.osm"], ""),
        ("no such folder", ["run", "{tmp}/nowhere"], ""),
        ("expected a …, got none", ["run", "{tmp}"], ""),
        ("this is a scenario; expected", ["verify", "{mini}"], ""),
        ("unknown key", ["check", "{mini}", "--set", "roi.size=[1,1,1]"], ""),
        ("… m along", ["check", "{mini}", "--set", "roi.voxel_m=0.3"], ""),
        ("unknown sensor", ["check", "{mini}", "--set", "sites.sensor=none"], ""),
        ("(…, …, …) is inside", ["check", "{mini}"], BAD_SITE.format("16,6")),
        ("the site is", ["check", "{mini}"], BAD_SITE.format("5000,0")),
        ("Longitude and latitude belong", ["check", "{mini}"], BAD_SITE.format("-170,80")),
        ("z_m = ", ["check", "{mini}"], "site,x_m,y_m,z_m\nbad,10,12,-1\n"),
        ("unknown column", ["check", "{mini}"], "site,x_m,y_m,z_m,yaw_dge\nbad,10,12,3,0\n"),
        ("… can mean … or …", ["check", "{mini}"], "site;x_m;y_m;z_m\nbad;10,250;12;3\n"),
    ],
)
def test_command_prints_the_quoted_message(
    beginning: str, command: list[str], sites: str, mini: Path, tmp_path: Path, run_egvs: Any
) -> None:
    if sites:
        (mini / "sites.csv").write_text(sites, encoding="utf-8")
    code, out, error = run_egvs(*(argument.format(mini=mini, tmp=tmp_path) for argument in command))
    assert code == 2
    assert quoted(beginning).search(out + error), out + error


@pytest.mark.slow
def test_run_prints_the_quoted_messages(mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    folder = tmp_path / "run"
    code, out, error = run_egvs("run", mini, "--verbose", "--out", folder, "--set", "roi.center_m=[20,60,2.5]")
    assert code == 0, error
    assert quoted("… ever enters the region").search(out + error)

    record = folder / "run.json"
    record.write_text(record.read_text(encoding="utf-8").replace("gamma", "gamme"), encoding="utf-8")
    code, _, error = run_egvs("verify", folder)
    assert code == 2
    assert quoted("was changed after the run").search(error)

    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "scores.parquet").write_text("mine", encoding="utf-8")
    code, _, error = run_egvs("run", mini, "--out", tmp_path / "notes")
    assert code == 2
    assert quoted("a run would overwrite").search(error)
