"""Add to the documentation site what comes from the program: the diagram of the packages, tables of public names
and of data, a reference page for each package, the notebooks, and formulas as MathML."""

from __future__ import annotations

import ast
import html as htmllib
import re
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from mkdocs.utils import get_relative_url

sys.path.insert(0, str(Path(__file__).parent))
import notebooks
import package_diagram
import tables
from formulas import mathml

ROOT = Path(__file__).resolve().parents[2]
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_VIEW = ROOT / "build" / "view.html"
"""The 3D view of a run, which `make docs` writes. Without it, the first page links to docs/explore.md."""
_LINK_WITHOUT_VIEW = "](explore.md#one-file-to-share)"
_ELSEWHERE = "https://unpkg.com/iframe-worker/shim"
_INSERT = re.compile(r"<!-- (names of|picture of|data table) ([\w-]+) -->")


def on_config(config: MkDocsConfig) -> None:
    """The entry ``API`` of the navigation: the public API, then the packages from low to high."""
    pages = ["api/index.md", *(f"api/{name}.md" for name in package_diagram.packages())]
    for entry in config.nav or []:
        if "API" in entry:
            entry["API"] = pages


def on_files(files: Files, config: MkDocsConfig) -> None:
    """One page a package, with every module that says something; one a notebook, with its figures."""
    for name in package_diagram.packages():
        folder = ROOT / "pipeline" / "egvs" / name
        modules = [
            ".".join(p.relative_to(ROOT / "pipeline").with_suffix("").parts) for p in sorted(folder.rglob("*.py"))
        ]
        text = f"# {name}\n\n{_first_line(folder / '__init__.py')}\n"
        text += "".join(f"\n::: {module}\n" for module in modules if not module.endswith("__init__"))
        files.append(File.generated(config, f"api/{name}.md", content=text))
    for page in notebooks.pages().values():
        files.append(File.generated(config, f"notebooks/{page.name}.md", content=page.markdown))
        for name, content in page.figures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    if _VIEW.is_file():
        files.append(File.generated(config, _VIEW.name, abs_src_path=str(_VIEW)))


_EXAMPLE = re.compile(r"^\[`([^`]+)`\]\((examples/[^)]+)\)$", re.MULTILINE)
"""A link to a file of an example, alone in its line: the site shows the file itself."""

_PICTURE = re.compile(r"<!-- picture of packages -->.*?<!-- end of picture -->", re.DOTALL)
"""The picture as text, for readers of the file; the site has a drawing of the imports in its place."""


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put tables and pictures in place of ``<!-- names of egvs -->`` and the like."""
    del config
    if page.file.src_uri == "index.md" and files.get_file_from_path(_VIEW.name):
        if _LINK_WITHOUT_VIEW not in markdown:
            raise ValueError(f"docs/index.md has no picture with the link {_LINK_WITHOUT_VIEW}")
        markdown = markdown.replace(_LINK_WITHOUT_VIEW, f"]({_VIEW.name})")
    markdown = _PICTURE.sub("<!-- picture of packages -->", markdown)
    markdown = _EXAMPLE.sub(_show_file, markdown)
    if page.file.src_uri == "notebooks/index.md":
        markdown = notebooks.gallery(markdown)
    return notebooks.link_pages(_INSERT.sub(lambda m: _MAKE[m[1]](m[2]), markdown))


def _show_file(link: re.Match[str]) -> str:
    """Return a block of code with the content of a linked file."""
    name, path = link.groups()
    language = {"py": "python", "j2": "html"}.get(suffix := name.rpartition(".")[2], suffix)
    return f'```{language} title="{name}"\n{(ROOT / "docs" / path).read_text(encoding="utf-8")}```'


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas of the pages; those of docstrings are MathML already."""
    del page, config, files
    return _FORMULA.sub(lambda m: mathml(_plain(m[3]), "block" if m[2] == "[" else "inline"), html)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """No script from elsewhere: what lets the search work from disk is our own."""
    del config
    return output.replace(_ELSEWHERE, get_relative_url("mkdocs/search_from_disk.js", page.url))


def on_post_template(output_content: str, template_name: str, config: MkDocsConfig) -> str:
    """The same for the page of what is not found."""
    del template_name, config
    return output_content.replace(_ELSEWHERE, "mkdocs/search_from_disk.js")


def _plain(text: str) -> str:
    return htmllib.unescape(text)


def _first_line(path: Path) -> str:
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")[0]


_MAKE = {
    "names of": tables.names,
    "picture of": lambda _: package_diagram.picture(),
    "data table": tables.data_table,
}
