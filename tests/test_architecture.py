"""Rules for the whole package: imports, docstrings, and public names.

Which package may import which is defined in ``pyproject.toml`` (import-linter); here are further rules.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

import egvs
from tests import platform_tests
from tests.conftest import write_mini

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


def run_python(code: str, folder: Path = ROOT, stdin: str = "") -> str:
    """Run ``code`` in a new process in ``folder`` and return what it prints."""
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, input=stdin, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


# ---- imports


def test_import_contracts_hold(capsys: pytest.CaptureFixture[str]) -> None:
    broken = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert not broken, capsys.readouterr().out


@pytest.mark.slow
def test_no_import_by_string() -> None:
    """Import contracts do not see imports by name; only plug-ins and lazy public names use them."""
    hidden = {
        name
        for name in MODULES
        for node in ast.walk(tree(name))
        if (isinstance(node, ast.Attribute) and node.attr == "import_module")
        or (isinstance(node, ast.Name) and node.id in ("__import__", "import_module"))
    }
    assert hidden <= {"core/lazy.py"}


@pytest.mark.slow
def test_parquet_and_schemas_are_read_in_one_place() -> None:
    readers = {name for name in MODULES if "pyarrow.parquet" in imported_names(name)}
    # files of other programs
    foreign = {"traffic/fcd.py", "formats/vector_files.py", "extensions/tracks/formats/arrow_tables.py"}
    assert readers <= {"artefacts/parquet.py", "artefacts/origin.py", *foreign}
    named = {
        name
        for name in MODULES
        for node in ast.walk(tree(name))
        if isinstance(node, ast.Constant) and node.value == "data_schemas"
    }
    assert named == {"core/package_data.py"}


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


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of a small scenario that keeps what its sites see."""
    folder = tmp_path_factory.mktemp("offered")
    write_mini(folder / "mini")
    scenario = egvs.load(folder / "mini", ["score.keep_visibility='all'"])
    egvs.run(scenario, folder / "run", jobs=1)
    return folder


SCENE = "from egvs import *; s = load('mini'); scene = build_scene(s); "
USES = {
    "DesignRequest": "DesignRequest('pole_a').channels is None",
    "EgvsError": "EgvsError('text')",
    "FrameSampling": "FrameSampling(30).spacing_s is None",
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
    "accept": "accept.__kwdefaults__['max_vehicle_height_m'] == 4.5",
    "build_scene": "build_scene(__import__('egvs').load('mini')).sites",
    "compare_runs": "compare_runs(['run', 'run']).agreements[0].tau == 1.0",
    "create_scenario": "list(create_scenario.__annotations__)[:2] == ['folder', 'maps']",
    "design_sensor": "from egvs import DesignRequest, load; "
    "design_sensor(load('mini'), DesignRequest('pole_a', ('small',), evaluations=20), 'design').chosen.score > 0",
    "draw_figure": "draw_figure('run', 'ranking', kind='svg', out='ranking.svg').stat().st_size > 0",
    "effect_statuses": "'rain' in [status.name for status in effect_statuses(__import__('egvs').load('mini'))]",
    "fit_sensor": "'sweeps' in fit_sensor.__annotations__",
    "load": "load('mini').name == 'mini'",
    "open_session": "open_session('run').ranked[0].rank == 1",
    "place": "len(place(__import__('egvs').load('mini', ['placement.count=1']), 'placed').sensors) == 1",
    "read_scans": "len(read_scans('run/scans.parquet').to_pandas())",
    "read_scores": "list(read_scores('run/scores.parquet').to_pandas().site) == ['pole_a', 'pole_b']",
    "read_scores_by_period": "from egvs import load, run; "
    'halves = \'[{name="a",length_s=12},{name="b",begin_s=12,length_s=8}]\'; '
    "run(load('mini', ['traffic.periods=' + halves]), 'split'); "
    "read_scores_by_period('split/scores_by_period.parquet').to_pandas().period.nunique() == 2",
    "read_sweeps": "read_sweeps([]) == []",
    "read_tpog": "read_tpog('run/tpog.parquet').p.max() > 0",
    "read_trajectories": "len(read_trajectories('run/trajectories.parquet').to_pandas()) == 80",
    "read_visibility": "read_visibility('run/visibility.parquet', 'pole_a').sum() > 0",
    "run": "run(__import__('egvs').load('mini'), 'again').stages['score']",
    "run_ablation": "run_ablation(__import__('egvs').load('mini'), 'alone')[0].effect == 'none'",
    "run_accuracy_study": "list(run_accuracy_study.__annotations__)[:2] == ['path', 'overrides']",
    "shipped_scenario": "shipped_scenario('demo').is_dir()",
    "validate_sites": "validate_sites.__kwdefaults__['jobs'] is None",
    "verify": "verify('run') == []",
    "what_if": "from egvs import load; box = '{share=0.5,boxes=[{x_m=10,y_m=30,length_m=1,width_m=1,height_m=1}]}'; "
    "what_if('mini', ['what_if.crate=' + box]).answers[0].name == 'crate'",
    "write_acceptance": "write_acceptance.__defaults__ == (None,)",
    "write_fit": "list(write_fit.__annotations__)[:2] == ['fit', 'name']",
    "write_sheets": "len(write_sheets('run', ['pole_a'], kind='svg', out=__import__('pathlib').Path('sheets'))) == 1",
}
"""Public name to an expression that uses it, in a folder with a scenario and its run."""


ONE_EACH = """
import json, os, sys, tempfile
import numba, numpy, pyarrow.parquet, pydantic, scipy.special, trimesh, urllib.request, xml.sax.saxutils

class Model(pydantic.BaseModel):  # imports modules that pydantic loads lazily
    number: int

assert not {"egvs", "pandas", "matplotlib", "pyproj"} & set(sys.modules)
results = {}
for name, code in json.loads(sys.stdin.read()).items():
    with tempfile.TemporaryFile("w+") as output:
        child = os.fork()
        if child == 0:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
            exec(compile(code, name, "exec"), {"__name__": "__main__"})
            sys.stdout.flush()
            os._exit(0)
        failed = os.waitpid(child, 0)[1]
        output.seek(0)
        results[name] = failed, output.read()
print(json.dumps(results))
"""
"""Runs each code in a process of its own, in which nothing of this program was imported. Imported before are
libraries that cost most of the time."""


@pytest.mark.slow
@pytest.mark.system
def test_each_public_name_works_as_first_import_and_has_docstring(run_folder: Path) -> None:
    codes = {}
    for name in sorted(set(egvs.__all__) - {"__version__"}):
        *before, use = USES[name].split("; ")
        lines = [f"from egvs import {name}", *before, f"assert {use}"]
        codes[name] = "\n".join(
            [*lines, f"import inspect\nprint(inspect.isclass({name}))\nprint(inspect.getdoc({name}))"]
        )
    for name, (failed, output) in json.loads(run_python(ONE_EACH, run_folder, json.dumps(codes))).items():
        assert not failed, (name, output)
        kind, doc = output.split("\n", 1)
        assert doc.strip() not in ("", "None"), name
        assert kind == str(name[0].isupper()), name


@pytest.mark.slow
@pytest.mark.system
def test_run_does_not_import_validation(run_folder: Path) -> None:
    code = (
        "import sys, egvs;"
        "s = egvs.load('mini', ['score.gamma=3']); egvs.run(s, 'other', jobs=1);"
        "print([m for m in sys.modules if m.startswith('egvs.extensions.validation.')])"
    )
    assert run_python(code, run_folder).strip() == "['egvs.extensions.validation.ranking_check']"  # the report has it
