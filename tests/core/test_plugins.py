"""Plug-ins of other packages: found by their entry points, loaded once, and never in this program's own place."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from egvs.core import plugins, readers
from egvs.core.errors import InputError, MissingBackendError, MissingExtraError

GROUP = "egvs.test_group"


def install(folder: Path, package: str, entries: str, modules: dict[str, str], group: str = GROUP) -> None:
    """Lay a package of somebody else's into a folder as pip would."""
    info = folder / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entries}\n", encoding="utf-8")
    for name, source in modules.items():
        (folder / f"{name}.py").write_text(source, encoding="utf-8")


def install_readers(folder: Path, package: str, rows: str, modules: dict[str, str]) -> None:
    """Lay a package with readers into a folder; ``rows`` are the calls that make them."""
    declarations = f"from egvs.core.readers import Reader\nREADERS = ({rows},)\n"
    name = f"plug_{package.replace('-', '_')}_readers"
    install(folder, package, f"{package} = {name}:READERS", {name: declarations, **modules}, readers.GROUP)


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path, as site-packages is."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(tmp_path))
    clear_caches()
    yield tmp_path
    clear_caches()
    for name in set(sys.modules) - before:
        if name.startswith("plug_"):
            del sys.modules[name]


def clear_caches() -> None:
    plugins.load_plugin.cache_clear()
    plugins._all_entry_points.cache_clear()
    plugins._entry_points_by_name.cache_clear()
    readers._table.cache_clear()


def test_plugin_names_are_sorted_without_imports(site: Path) -> None:
    install(site, "two", "b = plug_b:PART\na = plug_a", {"plug_a": "raise RuntimeError", "plug_b": "PART = [7]"})
    assert plugins.plugin_names(GROUP) == ["a", "b"]
    assert "plug_a" not in sys.modules and "plug_b" not in sys.modules
    assert plugins.load_plugin(GROUP, "b") == [7]
    assert plugins.load_plugin(GROUP, "b") is plugins.load_plugin(GROUP, "b")


def test_this_program_has_priority_then_packages_by_name(site: Path) -> None:
    install(site, "zebra", "a = plug_z:PART\nb = plug_z:PART", {"plug_z": "PART = 'zebra'"})
    install(site, "antelope", "a = plug_c:PART\nb = plug_c:PART", {"plug_c": "PART = 'antelope'"})
    install(site, "egvs", "a = plug_e:PART", {"plug_e": "PART = 'own'"})
    assert (plugins.load_plugin(GROUP, "a"), plugins.load_plugin(GROUP, "b")) == ("own", "antelope")


def test_message_of_unknown_name_lists_known_ones(site: Path) -> None:
    install(site, "one", "a = plug_a", {})
    with pytest.raises(InputError, match=r"^egvs\.test_group: unknown name 'c'\. Choose one of a\.$"):
        plugins.load_plugin(GROUP, "c")
    with pytest.raises(InputError, match="Choose one of none"):
        plugins.load_plugin("egvs.nobody", "c")


@pytest.mark.parametrize(
    ("entry", "source", "problem"),
    [
        ("plug_missing:PART", "", "No module named 'plug_missing'"),
        ("plug_a:PART", "", "module 'plug_a' has no attribute 'PART'"),
        ("plug_a", "import nowhere_to_be_found", "No module named 'nowhere_to_be_found'"),
        ("plug_a", "def", "invalid syntax"),
        ("plug_a", "raise RuntimeError('boom')", r"its import raised RuntimeError\('boom'\)"),
        ("plug_a", "1 / 0", r"its import raised ZeroDivisionError\('division by zero'\)"),
        ("plug_a", "raise SystemExit(0)", r"its import raised SystemExit\(0\)"),
    ],
)
def test_message_of_broken_plugin_names_its_package(site: Path, entry: str, source: str, problem: str) -> None:
    install(site, "somebody-elses", f"a = {entry}", {"plug_a": source})
    place = rf"\(entry point '{entry}' of the package somebody-elses\)"
    with pytest.raises(MissingBackendError, match=rf"^'a' of egvs\.test_group cannot be loaded: {problem}.*{place}"):
        plugins.load_plugin(GROUP, "a")


def test_interrupt_while_loading_is_passed_on(site: Path) -> None:
    install(site, "somebody-elses", "a = plug_a", {"plug_a": "raise KeyboardInterrupt"})
    with pytest.raises(KeyboardInterrupt):
        plugins.load_plugin(GROUP, "a")


def test_check_names_missing_attributes_and_the_package(site: Path) -> None:
    install(site, "somebody-elses", "zz = collections:OrderedDict", {})
    plugin = plugins.load_plugin(GROUP, "zz")
    plugins.check_plugin(GROUP, "zz", plugin, ("items", "fromkeys.__call__"), "a dictionary")
    message = r"it has no NAME, items\.b; expected a dictionary \(entry point .* of the package somebody-elses\)"
    with pytest.raises(MissingBackendError, match=message):
        plugins.check_plugin(GROUP, "zz", plugin, ("NAME", "items", "items.b"), "a dictionary")


def test_rejects_entry_point_without_module(site: Path) -> None:
    install(site, "somebody-elses", "a = !!no module", {})
    with pytest.raises(
        MissingBackendError, match=r"does not name a module.*'!!no module' of the package somebody-elses"
    ):
        plugins.plugin_module(GROUP, "a")


def test_sorts_packages_without_name(site: Path) -> None:
    for package in ("one", "two"):
        install(site, package, f"{package} = plug_{package}", {})
    (site / "two-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\n", encoding="utf-8")
    assert plugins.plugin_names(GROUP) == ["one", "two"]
    assert (plugins.plugin_package(GROUP, "one"), plugins.plugin_package(GROUP, "two")) == ("one", "?")


@pytest.mark.parametrize(
    ("there", "message"),
    [
        ({"plug_x": None}, r"^it needs plug_x, which is not installed. Run pip install 'egvs\[some\]'$"),
        (
            {"sklearn": None, "torch": None},
            r"^it needs scikit-learn, PyTorch, which are not installed. Run pip install",
        ),
    ],
)
def test_message_of_missing_extra_says_what_to_install(
    there: dict[str, None], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in there:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=message) as refused:
        plugins.require_libraries("it", "some", "json", *there)
    assert refused.value.exit_code == 2


def test_require_extra_imports_nothing(site: Path) -> None:
    (site / "plug_there.py").write_text("raise SystemExit", encoding="utf-8")
    plugins.require_libraries("it", "some", "plug_there")
    assert "plug_there" not in sys.modules
