"""Rules for the whole package: imports, docstrings, and public names.

Which package may import which is defined in ``pyproject.toml`` (import-linter); here are further rules.
"""

from __future__ import annotations

import ast
import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

import egvs
from egvs.artefacts.run_folder import extension_files
from egvs.core import plugins
from tests import platform_tests, public_names
from tests.conftest import write_mini
from tests.installed import EXTENSIONS, needs
from tests.public_names import run_folder, run_python  # noqa: F401 - a fixture

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "pipeline" / "egvs"
MODULES = sorted(str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py"))
FOLDERS = sorted({str(Path(name).parent) for name in MODULES} - {"."})


def tree(name: str) -> ast.Module:
    """Return the syntax tree of a module of the package."""
    return ast.parse((PACKAGE / name).read_text(encoding="utf-8"))


def imported_names(name: str) -> set[str]:
    """Return all imports of a module, also inside functions: ``a.b`` for ``import a.b`` and for ``from a import b``."""
    return platform_tests.imported_names((PACKAGE / name).read_text(encoding="utf-8"))


# ---- imports


@pytest.mark.slow
@needs(*EXTENSIONS)
def test_import_contracts_hold(capsys: pytest.CaptureFixture[str]) -> None:
    broken = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert not broken, capsys.readouterr().out


@pytest.mark.slow
def test_no_import_by_string() -> None:
    """Import contracts do not see imports by name; only plug-ins, stages, commands and lazy public names use them."""
    hidden = {
        name
        for name in MODULES
        for node in ast.walk(tree(name))
        if (isinstance(node, ast.Attribute) and node.attr == "import_module")
        or (isinstance(node, ast.Name) and node.id in ("__import__", "import_module"))
    }
    by_entry_point = {"core/readers.py", "extensions/tracks/source.py"}
    assert hidden <= {"cli/commands.py", "core/lazy.py", "runs/stage_registry.py", *by_entry_point}


@pytest.mark.slow
def test_parquet_and_schemas_are_read_in_one_place() -> None:
    readers = {name for name in MODULES if "pyarrow.parquet" in imported_names(name)}
    # files of other programs
    foreign = {"formats/parquet_process.py", "traffic/fcd.py", "extensions/tracks/formats/arrow_tables.py"}
    assert readers <= {"artefacts/parquet.py", "artefacts/origin.py", *foreign}
    named = {
        name
        for name in MODULES
        for node in ast.walk(tree(name))
        if isinstance(node, ast.Constant) and node.value == "data_schemas"
    }
    assert named == {"core/package_data.py"}


DECLARATIONS = {"commands", "files", "folder_kind", "readers", "report_section", "source"}
"""Light modules of extensions, which entry points name."""


@pytest.mark.slow
@pytest.mark.system
def test_run_imports_only_declarations_of_extensions(tmp_path: Path) -> None:
    """The second run also looks for files of a user in its folder."""
    code = """
import sys
from egvs.cli.app import app
for _ in range(2):
    try:
        app(["run", "demo", "--out", "out", "--set", "traffic.frames=50"])
    except SystemExit as end:
        assert not end.code
print([name for name in sys.modules if name.startswith("egvs.extensions.")])
"""
    shutil.copytree(egvs.shipped_scenario("demo"), tmp_path / "demo")
    imported = set(ast.literal_eval(run_python(code, tmp_path).splitlines()[-1]))
    modules = {name for name in imported if name.count(".") > 2}
    assert {name for name in modules if name.rpartition(".")[2] not in DECLARATIONS} == set()
    used = {
        plugins.plugin_module(group, name)
        for group in ("egvs.files", "egvs.report_sections")
        for name in plugins.plugin_names(group)
    }
    assert used <= imported


def test_the_core_names_no_file_of_an_extension() -> None:
    sources = [path for suffix in ("py", "j2", "js", "toml") for path in PACKAGE.rglob(f"*.{suffix}")]
    core = {path: path.read_text(encoding="utf-8") for path in sources if "extensions" not in path.parts}
    assert "what_if.json" in core[PACKAGE / "artefacts" / "run_folder.py"]
    named = [
        f"{path.relative_to(PACKAGE)}: {file.name}"
        for path, text in core.items()
        for file in extension_files()
        if file.name in text
    ]
    assert named == []


@pytest.mark.system
@pytest.mark.parametrize("module", ["egvs", "egvs.cli.app"])
def test_help_imports_nothing_heavy(module: str) -> None:
    heavy = "numpy numba pyarrow pydantic shapely trimesh matplotlib embreex scipy rich.table traci sumolib"
    code = f"import sys, {module}; print([m for m in {heavy.split()} if m in sys.modules])"
    assert run_python(code).strip() == "[]"


# ---- docstrings


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_module_docstring_starts_with_sentence(name: str) -> None:
    opening = re.match(r".+?[.:?!](?=\s|$)", ast.get_docstring(tree(name)) or "", re.DOTALL)
    assert opening, "no docstring, or none that opens with a sentence"
    assert opening[0][-1] in ".:", f"no plain sentence: {opening[0]}"
    assert "\n\n" not in opening[0], f"no end before the first paragraph's: {opening[0]}"


def test_every_folder_with_modules_is_a_package() -> None:
    assert [folder for folder in FOLDERS if f"{folder}/__init__.py" not in MODULES] == []


# ---- public names


SCENE = "from egvs import *; s = load('mini'); scene = build_scene(s); "
USES = {
    "EgvsError": "EgvsError('text')",
    "InputError": "InputError('file', 'problem', 'Hint').hint == 'Hint'",
    "JointScore": "JointScore.of(__import__('egvs').load('mini'), 'joint').candidates == ('pole_a', 'pole_b')",
    "NewScenarioOptions": "NewScenarioOptions(walk=True).check() is None",
    "Pose": "Pose(1.0, 2.0, 3.0).position_m == (1.0, 2.0, 3.0)",
    "RunError": "RunError('text').exit_code == 1",
    "Scanner": SCENE + "Scanner(scene).scan_site(scene.sites[0]).beams_in_roi > 0",
    "Scenario": "Scenario.model_fields['roi']",
    "Scene": SCENE + "isinstance(scene, Scene)",
    "Scorer": SCENE + "Scorer(scene, read_tpog('run/tpog.parquet')).limit > 0",
    "Sensor": SCENE + "isinstance(scene.sensor('small'), Sensor) and Sensor.directions(scene.sensor('small')).any()",
    "Site": "Site('a', __import__('egvs').Pose(1.0, 2.0, 3.0), 'VLP-16').points is None",
    "StudyOptions": "StudyOptions(__import__('egvs').Tolerance(1.0), 60.0).seeds is None",
    "Tolerance": "Tolerance(0.5).score is None",
    "Tpog": "(Tpog.p.fget(__import__('egvs').read_tpog('run/tpog.parquet')) <= 1).all()",
    "World": SCENE + "isinstance(scene.world, World) and scene.world.triangles_m.shape[1:] == (3, 3)",
    "build_scene": "build_scene(__import__('egvs').load('mini')).sites",
    "compare_runs": "compare_runs(['run', 'run']).agreements[0].tau == 1.0",
    "create_scenario": "list(create_scenario.__annotations__)[:2] == ['folder', 'maps']",
    "design_sensor": "from egvs import DesignRequest, load; "
    "design_sensor(load('mini'), DesignRequest('pole_a', ('small',), evaluations=20), 'design').chosen.score > 0",
    "draw_figure": "draw_figure('run', 'ranking', kind='svg', out='ranking.svg').stat().st_size > 0",
    "effect_statuses": "'rain' in [status.name for status in effect_statuses(__import__('egvs').load('mini'))]",
    "load": "load('mini').name == 'mini'",
    "open_session": "open_session('run').ranked[0].rank == 1",
    "place": "len(place(__import__('egvs').load('mini', ['placement.count=1']), 'placed').sensors) == 1",
    "read_scans": "len(read_scans('run/scans.parquet').to_pandas())",
    "read_scores": "list(read_scores('run/scores.parquet').to_pandas().site) == ['pole_a', 'pole_b']",
    "read_scores_by_period": "from egvs import load, run; "
    'halves = \'[{name="a",length_s=12},{name="b",begin_s=12,length_s=8}]\'; '
    "run(load('mini', ['traffic.periods=' + halves]), 'split'); "
    "read_scores_by_period('split/scores_by_period.parquet').to_pandas().period.nunique() == 2",
    "read_tpog": "read_tpog('run/tpog.parquet').p.max() > 0",
    "read_trajectories": "len(read_trajectories('run/trajectories.parquet').to_pandas()) == 80",
    "read_visibility": "read_visibility('run/visibility.parquet', 'pole_a').sum() > 0",
    "run": "run(__import__('egvs').load('mini'), 'again').stages['score']",
    "run_ablation": "run_ablation(__import__('egvs').load('mini'), 'alone')[0].effect == 'none'",
    "run_accuracy_study": "list(run_accuracy_study.__annotations__)[:2] == ['path', 'overrides']",
    "shipped_scenario": "shipped_scenario('demo').is_dir()",
    "verify": "verify('run') == []",
    "write_clouds": "(write_clouds(__import__('egvs').load('mini'), 'clouds', frames=2) / 'README.md').is_file()",
    "what_if": "from egvs import load; box = '{share=0.5,boxes=[{x_m=10,y_m=30,length_m=1,width_m=1,height_m=1}]}'; "
    "what_if('mini', ['what_if.crate=' + box]).answers[0].name == 'crate'",
}
"""Public name to an expression that uses it, in a folder with a scenario and its run."""


@pytest.mark.slow
@pytest.mark.system
def test_each_public_name_works_as_first_import_and_has_docstring(run_folder: Path) -> None:  # noqa: F811
    of_extensions = set() if find_spec("egvs.extensions.validation") else {"write_clouds"}
    names = set(egvs.__all__) - {"__version__"} - of_extensions
    public_names.check(egvs, {name: USES[name] for name in names}, run_folder)


def test_clouds_without_their_extension_say_which_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "plugin_names", lambda group: [])
    with pytest.raises(egvs.EgvsError, match="write_clouds needs the extension validation"):
        egvs.write_clouds(egvs.load(write_mini(tmp_path / "mini")), tmp_path / "clouds", frames=2)
    assert not (tmp_path / "clouds").exists()
