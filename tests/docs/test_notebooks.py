"""The notebooks of docs/notebooks: executed, clean, on the site; and the tools that execute and show them."""

from __future__ import annotations

import ast
import base64
import copy
import importlib.util
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import nbformat
import pytest

import egvs

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
MAX_FIGURE_BYTES, MAX_NOTEBOOK_BYTES = 125_000, 900_000


def load_tool(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"notebook_{name}", ROOT / "docs" / "mkdocs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


execution, conversion = load_tool("execute_notebooks"), load_tool("notebooks")


def read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)


# ---- the notebooks


def test_there_are_notebooks() -> None:
    assert "map-to-decision" in NAMES


@pytest.mark.slow
def test_paper_counts_every_beam() -> None:
    """The paper's score has no losses of returns, which act here by default."""
    source = next(cell.source for cell in read("paper").cells if "settings = [" in cell.source)
    settings = ast.literal_eval(source.split("settings = ", 1)[1].splitlines()[0])
    path = egvs.shipped_scenario("nishishinjuku")
    assert [effect.NAME for effect in egvs.build_scene(egvs.load(path)).effects] == ["range_limit"]
    assert egvs.build_scene(egvs.load(path, settings)).effects == ()


@pytest.mark.parametrize("name", NAMES)
def test_notebook_is_executed_and_clean(name: str) -> None:
    notebook = read(name)
    nbformat.validate(notebook)
    assert notebook.metadata == {"kernelspec": execution.KERNEL, "language_info": {"name": "python"}}
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert list(execution.find_problems(notebook)) == []
    tidy = copy.deepcopy(notebook)
    execution.normalise(tidy)
    assert tidy == notebook


@pytest.mark.parametrize("name", NAMES)
def test_last_expression_has_output(name: str) -> None:
    """A cell that ends in an expression, or prints, shows something."""
    for cell in read(name).cells:
        if cell.cell_type == "code" and re.search(r"^( *print\(|[\w.]+$|SVG\()", cell.source, re.MULTILINE):
            assert cell.outputs, cell.source


@pytest.mark.parametrize("name", NAMES)
def test_notebook_reads_like_a_tutorial(name: str) -> None:
    cells = read(name).cells
    assert re.match(r"# \S", cells[0].source)
    last = cells[-1]
    assert last.cell_type == "markdown"
    assert all(f"**{word}.**" in last.source for word in ("Conclusion", "How sure", "Read next"))
    assert max(len(cell.source.splitlines()) for cell in cells if cell.cell_type == "code") <= 40


@pytest.mark.parametrize("name", NAMES)
def test_notebook_is_small(name: str) -> None:
    page = conversion.read_notebook(FOLDER / f"{name}.ipynb")
    assert {key: len(content) for key, content in page.figures.items() if len(content) > MAX_FIGURE_BYTES} == {}
    assert (FOLDER / f"{name}.ipynb").stat().st_size < MAX_NOTEBOOK_BYTES


def test_each_notebook_is_in_gallery_and_navigation() -> None:
    listed = re.findall(r"^- \[[^\]]+\]\(([\w-]+)\.ipynb\): ", (FOLDER / "index.md").read_text(encoding="utf-8"), re.M)
    config = (ROOT / "docs" / "mkdocs" / "mkdocs.yml").read_text(encoding="utf-8")
    in_navigation = re.findall(r"notebooks/([\w-]+)\.md", config)
    assert sorted(listed) == NAMES
    assert in_navigation == ["index", *listed]


def test_links_lead_to_files() -> None:
    for path in [FOLDER / "index.md", *FOLDER.glob("*.ipynb")]:
        for target in re.findall(r"\]\((?!\w+:)([^)#\s\\]+)", path.read_text(encoding="utf-8")):
            assert (FOLDER / target).exists(), (path.name, target)


# ---- the tools


def output(**data: str) -> nbformat.NotebookNode:
    return nbformat.v4.new_output("execute_result", data={key.replace("_", "/"): text for key, text in data.items()})


def notebook_with(*outputs: nbformat.NotebookNode, **metadata: Any) -> nbformat.NotebookNode:
    cell = nbformat.v4.new_code_cell("1", outputs=list(outputs), metadata=metadata)
    return nbformat.v4.new_notebook(cells=[nbformat.v4.new_markdown_cell("# Title"), cell])


@pytest.mark.parametrize(
    ("outputs", "problem"),
    [
        ([nbformat.v4.new_output("error", ename="ValueError", evalue="no")], "cell 2 raised ValueError: no"),
        ([nbformat.v4.new_output("stream", name="stderr", text="careful\n")], "writes to standard error: careful"),
        ([output(text_plain="saved in /home/me/runs")], "prints a path of this machine"),
        ([output(text_plain="PosixPath('/tmp/egvs/runs')")], "prints a path of this machine"),
        ([output(text_plain="'../../../../projects/scenarios'")], "prints a path of this machine"),
        ([nbformat.v4.new_output("stream", name="stdout", text="C:\\Users\\me")], "prints a path of this machine"),
    ],
)
def test_rejects_outputs_that_must_not_be_published(outputs: list[Any], problem: str) -> None:
    (actual,) = execution.find_problems(notebook_with(*outputs))
    assert problem in actual


def test_accepts_relative_paths_and_divisions() -> None:
    stream = nbformat.v4.new_output("stream", name="stdout", text="runs/market: 3/4, 12 m/s\n")
    assert list(execution.find_problems(notebook_with(stream))) == []


def test_normalise_removes_editor_metadata_and_joins_lines() -> None:
    lines = [nbformat.v4.new_output("stream", name="stdout", text=text) for text in ("a\n", "b\n")]
    notebook = notebook_with(*lines, alt="a figure", collapsed=True, execution={"iopub.status.busy": "2026"})
    notebook.metadata["widgets"] = {}
    execution.normalise(notebook)
    assert notebook.metadata == {"kernelspec": execution.KERNEL, "language_info": {"name": "python"}}
    assert notebook.cells[1].metadata == {"alt": "a figure"}
    assert [out.text for out in notebook.cells[1].outputs] == ["a\nb\n"]
    assert [cell.id for cell in notebook.cells] == ["cell-01", "cell-02"]


def write(notebook: nbformat.NotebookNode, folder: Path) -> Path:
    execution.normalise(notebook)
    nbformat.write(notebook, folder / "some.ipynb")
    return folder / "some.ipynb"


def test_page_has_text_code_table_and_figure(tmp_path: Path) -> None:
    png = base64.b64encode(b"not really a picture").decode()
    outputs = [
        output(text_html='<table border="1" class="dataframe"><tr><td>7</td></tr></table>'),
        output(image_png=png),
    ]
    notebook = notebook_with(*outputs, alt="what it shows", tags=["gallery"])
    notebook.cells[0].source += "\n[next](other.ipynb), [far](https://example.org/x.ipynb)"
    page = conversion.read_notebook(write(notebook, tmp_path))
    assert "[next](other.md), [far](https://example.org/x.ipynb)" in page.markdown
    assert "```python\n1\n```" in page.markdown
    assert "<table><tr><td>7</td></tr></table>" in page.markdown
    assert "![what it shows](some-1.png)" in page.markdown
    assert page.figures == {"some-1.png": b"not really a picture"}
    assert (page.gallery_figure, page.gallery_alt) == ("some-1.png", "what it shows")


def test_printed_text_is_escaped(tmp_path: Path) -> None:
    figure = output(**{"image_svg+xml": "<svg/>"})
    stream = nbformat.v4.new_output("stream", name="stdout", text="<b> & *c*\n")
    page = conversion.read_notebook(write(notebook_with(stream, figure, alt="x", tags=["gallery"]), tmp_path))
    assert '<pre class="notebook-output" markdown="0">&lt;b&gt; &amp; *c*</pre>' in page.markdown


@pytest.mark.parametrize(("metadata", "problem"), [({}, "no text alternative"), ({"alt": "x"}, "has the tag gallery")])
def test_figure_needs_text_alternative_and_gallery_a_figure(
    metadata: dict[str, Any], problem: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=problem):
        conversion.read_notebook(write(notebook_with(output(image_png="AA=="), **metadata), tmp_path))


def test_gallery_has_a_card_for_each_notebook() -> None:
    page = conversion.gallery((FOLDER / "index.md").read_text(encoding="utf-8"))
    assert page.count('<div class="notebook-card" markdown>') == len(NAMES)
    for name in NAMES:
        assert f"]({conversion.pages()[name].gallery_figure})]({name}.md)" in page


def run_tool(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a copy of the tool beside other notebooks."""
    (folder / "mkdocs").mkdir()
    (folder / "notebooks" / "data").mkdir(parents=True)
    for source in folder.glob("*.ipynb"):
        shutil.move(source, folder / "notebooks" / source.name)
    shutil.copy(ROOT / "docs" / "mkdocs" / "execute_notebooks.py", folder / "mkdocs")
    command = [sys.executable, str(folder / "mkdocs" / "execute_notebooks.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


@pytest.mark.slow
@pytest.mark.system
def test_outputs_are_those_of_this_program() -> None:
    """A notebook that runs again says the same; if the program changed on purpose, run make notebooks."""
    name = "two-lidars"
    executed = execution.execute(FOLDER / f"{name}.ipynb")
    for cell, again in zip(read(name).cells, executed.cells, strict=True):
        texts, new_texts = ([*map(list, map(execution.texts_of, c.get("outputs", ())))] for c in (cell, again))
        assert new_texts == texts, cell.source


@pytest.mark.slow
@pytest.mark.system
def test_tool_executes_in_place_and_leaves_no_files(tmp_path: Path) -> None:
    source = 'from pathlib import Path\nPath("made").mkdir()\nprint(sorted(p.name for p in Path().iterdir()))'
    cells = [nbformat.v4.new_markdown_cell("# Title"), nbformat.v4.new_code_cell(source)]
    path = write(nbformat.v4.new_notebook(cells=cells), tmp_path)
    done = run_tool(tmp_path)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"some +\d+ s, of the processors \d+ s; \d+ kB\n", done.stdout)
    executed = json.loads((tmp_path / "notebooks" / path.name).read_text(encoding="utf-8"))
    assert "".join(executed["cells"][1]["outputs"][0]["text"]) == "['data', 'made']\n"
    assert sorted(p.name for p in (tmp_path / "notebooks").iterdir()) == ["data", "some.ipynb"]


@pytest.mark.slow
@pytest.mark.system
def test_tool_fails_on_an_error_and_writes_nothing(tmp_path: Path) -> None:
    path = write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")]), tmp_path)
    before = path.read_bytes()
    done = run_tool(tmp_path)
    assert done.returncode == 1
    assert "some.ipynb: " in done.stderr and "ZeroDivisionError" in done.stderr
    assert (tmp_path / "notebooks" / "some.ipynb").read_bytes() == before
