"""Files that code hosts, installers and container builders read agree with the Makefile, the pins and each other."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

import egvs
from tests.installed import COMPLETE

ROOT = Path(__file__).resolve().parent.parent
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PRE_COMMIT = ROOT / ".pre-commit-config.yaml"
COMMUNITY_FILES = {
    "CITATION.cff",
    "CODE_OF_CONDUCT.md",
    "CONTRIBUTING.md",
    "Dockerfile",
    "SECURITY.md",
    ".github",
    ".pre-commit-config.yaml",
}
PROJECT_FILES = {
    ".ci",
    ".gitignore",
    "CHANGELOG.md",
    "LICENSE",
    "Makefile",
    "README.md",
    "benchmarks",
    "constraints.txt",
    "data_schemas",
    "docs",
    "pipeline",
    "pyproject.toml",
    "scenarios",
    "tests",
}


def read(name: str | Path) -> str:
    """Read a file of the project."""
    return (ROOT / name).read_text(encoding="utf-8")


def make_targets() -> set[str]:
    """Return the names of all targets of the Makefile that are no files."""
    targets = set(re.findall(r"^([a-z][\w-]*):", read("Makefile"), re.MULTILINE))
    phony = re.search(r"^\.PHONY: (.*)$", read("Makefile"), re.MULTILINE)
    assert phony is not None
    assert set(phony[1].split()) == targets
    return targets


def test_make_test_runs_the_tests_that_are_marked_complete() -> None:
    """Tests in another folder would be left out by their mark."""
    listed = re.search(r"^COMPLETE_TESTS := (.*)$", read("Makefile"), re.MULTILINE)
    assert listed is not None
    assert {f"{folder}/" for folder in listed[1].split()} | {"tests/extensions/"} == set(COMPLETE)


def constraints() -> dict[str, str]:
    """Return the pinned version of each library."""
    return dict(line.split("==") for line in read("constraints.txt").splitlines())


def pins(text: str) -> dict[str, set[str]]:
    """Return all versions that a text pins, by name of the library."""
    versions: dict[str, set[str]] = {}
    for name, version in re.findall(r"([\w.-]+)==([\w.]+)", text):
        versions.setdefault(name, set()).add(version)
    return versions


def workflow_commands(path: Path) -> list[str]:
    """Return the commands of all steps of a workflow."""
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with the development tools")
    jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    return [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]


@pytest.mark.system
def test_top_level_has_only_known_names() -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: it cannot be told which files belong to the project")
    command = ["git", "-C", str(ROOT), "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    names = {line.partition("/")[0] for line in listed}
    assert names == PROJECT_FILES | COMMUNITY_FILES
    assert not [line for line in listed if line.startswith("scenarios/runs/")], "a run folder is in the repository"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflow_calls_make_targets_that_exist(path: Path) -> None:
    called = {match for command in workflow_commands(path) for match in re.findall(r"^make ([\w-]+)", command)}
    assert called
    assert called <= make_targets()


def test_workflows_cover_every_kind_of_check() -> None:
    commands = "\n".join(command for path in WORKFLOWS for command in workflow_commands(path))
    called = set(re.findall(r"^make ([\w-]+)", commands, re.MULTILINE))
    assert called >= {"lint", "test", "unit", "test-portable", "test-slow", "test-nightly", "test-train", "docs"}
    assert called >= {"wheel", "fuzz", "bench", "bench-history"}
    text = read(".github/workflows/checks.yml")
    for name in ("ubuntu-latest", "windows-latest", "macos-latest", '"3.11"', '"3.12"', '"3.13"'):
        assert name in text


def test_pages_name_make_targets_that_exist() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "docs/release-notes.md", "docs/container.md", "docs/benchmarks.md"):
        assert set(re.findall(r"`make ([\w-]+)", read(name))) <= make_targets(), name


@pytest.mark.parametrize("name", [".pre-commit-config.yaml", ".ci/project-files.txt"])
def test_versions_of_tools_equal_the_constraints(name: str) -> None:
    pinned = pins(read(name))
    for library, versions in pinned.items():
        assert len(versions) == 1, f"{library} has several versions"
        assert versions == {constraints().get(library, *versions)}, library


def test_pre_commit_runs_the_pinned_ruff_and_cffconvert() -> None:
    pinned = pins(read(PRE_COMMIT))
    assert pinned["ruff"] == {constraints()["ruff"]}
    assert pinned["cffconvert"] == pins(read(".ci/project-files.txt"))["cffconvert"]


def test_yaml_files_are_valid() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with the development tools")
    files = [*(ROOT / ".github").rglob("*.yml"), PRE_COMMIT, ROOT / "CITATION.cff"]
    assert len(files) >= 7
    for path in files:
        assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict), path


def test_issue_forms_have_unique_ids_and_required_questions() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML comes with the development tools")
    for name in ("bug.yml", "feature.yml"):
        form = yaml.safe_load(read(f".github/ISSUE_TEMPLATE/{name}"))
        assert form["name"] and form["description"]
        questions = [part for part in form["body"] if part["type"] != "markdown"]
        identifiers = [part["id"] for part in questions]
        assert len(set(identifiers)) == len(identifiers)
        assert any(part.get("validations", {}).get("required") for part in questions)


def test_version_is_stated_once_and_cited() -> None:
    assert tomllib.loads(read("pyproject.toml"))["project"]["dynamic"] == ["version"]
    version = re.search(r"^version: (.+)$", read("CITATION.cff"), re.MULTILINE)
    assert version is not None and version[1] == egvs.__version__
    assert f"Release notes for {egvs.__version__.partition('rc')[0].removesuffix('.0')}" in read(
        "docs/release-notes.md"
    )


def test_image_copies_files_that_exist_and_is_not_root() -> None:
    text = read("Dockerfile")
    last_stage = text[text.rindex("\nFROM ") :]
    users = re.findall(r"^USER (\w+)(?::\w+)?$", last_stage, re.MULTILINE)
    assert users and users[-1] not in ("root", "0")
    sources = [line.split()[1:-1] for line in text.splitlines() if line.startswith("COPY ") and "--from" not in line]
    copied = {name for names in sources for name in names}
    assert all((ROOT / name).exists() for name in copied)
    needed = set(tomllib.loads(read("pyproject.toml"))["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"])
    assert needed | {"pipeline", "pyproject.toml", "constraints.txt", "README.md", "LICENSE"} <= copied
