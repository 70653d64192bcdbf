"""A package of somebody else's adds a file format: found, read, written and offered without a change here."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from egvs.core import plugins
from egvs.core.errors import InputError, MissingBackendError
from egvs.formats.point_clouds import GROUP, read_points, write_points
from tests import processes
from tests.core.test_plugins import install, site  # noqa: F401  the fixture

pytestmark = pytest.mark.system

FOO = """
import numpy as np

class Foo:
    "Points as text, one number a line."

    def read(self, path, place):
        return np.array([float(word) for word in path.read_text().split()]).reshape(-1, 3)

    def write(self, path, points_m):
        path.write_text("\\n".join(map(repr, points_m.ravel().tolist())))

class Bar:
    def read(self, path, place):
        return np.zeros((1, 3))

FOO, BAR = Foo(), Bar()
"""

USER = """
import sys
from pathlib import Path
import numpy as np
from egvs.core.errors import InputError
from egvs.formats.point_clouds import read_points, write_points
path = Path(sys.argv[1])
write_points(path, np.array([[0.1, 2.0, 3.0], [4.0, np.nan, 6.0]]))
points, dropped = read_points(path, "")
assert points.tolist() == [[0.1, 2.0, 3.0]] and dropped == 1
try:
    write_points(path.with_suffix(".bar"), points)
except InputError as error:
    print(error)
"""


def test_a_package_adds_a_format(tmp_path: Path) -> None:
    install(tmp_path / "site", "foo", "foo = foo_points:FOO\nbar = foo_points:BAR", {"foo_points": FOO}, GROUP)
    done = processes.python(USER, tmp_path / "a.FOO", beside=tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert "a.bar: is of the unknown kind '.bar'; one of .foo, .pcd, .ply" in done.stdout


def test_our_own_formats_are_found_and_complete() -> None:
    assert {"csv", "las", "laz", "pcd", "ply"} <= set(plugins.plugin_names(GROUP))
    for name in plugins.plugin_names(GROUP):
        assert callable(plugins.load_plugin(GROUP, name).read)


def test_reading_imports_no_other_format(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
                    "end_header\n1 2 3\n", encoding="ascii")  # fmt: skip
    assert np.array_equal(read_points(path, "")[0], [[1, 2, 3]])
    code = (
        "import sys\nfrom pathlib import Path\nfrom egvs.formats.point_clouds import read_points\n"
        f"read_points(Path({str(path)!r}), '')\n"
        "print([m for m in sys.modules if m in ('egvs.formats.pcd', 'egvs.formats.las', 'pyarrow', 'laspy')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


READ = """
import numpy as np
def read(path, place):
    {}
"""


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("raise RuntimeError('boom')", r"ended with RuntimeError\('boom'\)"),
        ("raise SystemExit(0)", r"ended with SystemExit\(0\)"),
        ("return None", "returns NoneType"),
        ("return [[1.0, 2.0, 3.0]]", "returns list"),
        ("return np.array([['a', 'b', 'c']])", "returns ndarray of <U1"),
        ("return np.ones((5, 2))", r"returns an array of the shape \(5, 2\)"),
        ("return np.ones(3)", r"returns an array of the shape \(3,\)"),
    ],
)
def test_a_reader_that_fails_is_named_with_the_file(site: Path, body: str, found: str) -> None:  # noqa: F811
    install(site, "foo", "foo = plug_foo", {"plug_foo": READ.format(body)}, GROUP)
    with pytest.raises(InputError, match=rf"a\.foo: its reader plug_foo \(package foo\) {found}; "):
        read_points(site / "a.foo", "sites.csv: row A")


def test_whole_numbers_are_points(site: Path) -> None:  # noqa: F811
    install(site, "foo", "foo = plug_foo", {"plug_foo": READ.format("return np.array([[1, 2, 3]])")}, GROUP)
    points, dropped = read_points(site / "a.foo", "")
    assert (points.dtype, points.tolist(), dropped) == (np.float64, [[1.0, 2.0, 3.0]], 0)


def test_what_a_reader_says_itself_is_passed_on(site: Path) -> None:  # noqa: F811
    body = "from egvs.core.errors import InputError; raise InputError(place, 'is empty', 'a point')"
    install(site, "foo", "foo = plug_foo", {"plug_foo": READ.format(body)}, GROUP)
    with pytest.raises(InputError, match=r"a\.foo: is empty; a point$"):
        read_points(site / "a.foo", "")


def test_a_format_that_cannot_read_is_refused_and_keeps_no_other_from_being_written(site: Path) -> None:  # noqa: F811
    install(site, "foo", "foo = plug_foo", {"plug_foo": ""}, GROUP)
    with pytest.raises(MissingBackendError, match=r"it has no read; .*'plug_foo' of the package foo"):
        read_points(site / "a.foo", "")
    write_points(site / "a.ply", np.ones((1, 3)))
    assert read_points(site / "a.ply", "")[0].tolist() == [[1.0, 1.0, 1.0]]
