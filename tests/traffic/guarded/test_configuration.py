"""Is nothing taken over of a user's configuration by which SUMO could read or write a file?"""

from xml.etree.ElementTree import parse

import pytest

from egvs.core.errors import InputError
from egvs.traffic import sumo, user_files

SCHEMA = "{http://www.w3.org/2001/XMLSchema}"


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    """Every option of SUMO with its type, as SUMO itself says."""
    folder = tmp_path_factory.mktemp("schema")
    sumo.run_program("sumo", ["--save-schema", "sumo.xsd"], folder)
    found = {e.get("name"): e.get("type", "") for e in parse(folder / "sumo.xsd").iter(f"{SCHEMA}element")}
    return {name: kind for name, kind in found.items() if kind.endswith("OptionType")}


def test_no_option_that_names_a_file_is_taken_over(options):
    named = {name for name, kind in options.items() if kind == "fileOptionType"}
    assert len(named) > 40 and named >= set(user_files.FILE_OPTIONS)
    assert not named & user_files.ACCEPTED_OPTIONS
    assert not [
        name for name in user_files.ACCEPTED_OPTIONS if name.endswith(("file", "files", "output", "path", "prefix"))
    ]


def test_every_option_taken_over_is_one_of_sumos(options):
    assert user_files.ACCEPTED_OPTIONS - options.keys() == set()


def read(folder, text):
    (folder / "net.xml").touch()
    (folder / "c.sumocfg").write_text(f'<configuration><net-file value="net.xml"/>{text}</configuration>')
    return user_files.read_sumocfg(folder / "c.sumocfg")


def test_every_option_is_taken_over_left_out_or_an_error(options, tmp_path):
    refused = set()
    for name in sorted(options.keys() - set(user_files.FILE_OPTIONS)):
        try:
            read(tmp_path, f'<{name} value="0"/>')
        except InputError as error:
            assert error.hint.startswith("Remove it")
            refused.add(name)
    assert refused == {
        "load-state", "load-state.offset", "load-state.remove-vehicles", "astar.all-distances",
        "astar.landmark-distances", "device.fcd-replay.probability", "device.fcd-replay.explicit",
        "device.fcd-replay.deterministic", "device.fcd-replay.files", "device.fcd-replay.consistency",
        "pedestrian.jupedsim.step-length", "pedestrian.jupedsim.exit-tolerance", "pedestrian.jupedsim.model",
        "pedestrian.jupedsim.strength-neighbor-repulsion", "pedestrian.jupedsim.range-neighbor-repulsion",
        "pedestrian.jupedsim.strength-geometry-repulsion", "pedestrian.jupedsim.range-geometry-repulsion", "help",
        "version",
    }  # fmt: skip


def test_what_is_no_option_of_sumo_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"c\.sumocfg: colour = 'red': option of SUMO not supported"):
        read(tmp_path, '<colour value="red"/>')


def test_options_of_the_traffic_are_taken_over(tmp_path):
    taken = read(tmp_path, '<scale value="2"/><processing><ignore-route-errors v="true"/></processing><b value="7"/>')
    assert (taken.options, taken.begin_s) == ({"scale": "2", "ignore-route-errors": "true"}, 7.0)


@pytest.mark.parametrize("value", ["nan", "-inf", "1e308", "-1", "seven"])
def test_a_beginning_that_is_no_time_is_refused(value, tmp_path):
    with pytest.raises(InputError, match=f"begin = '{value}': expected 0 to 1e\\+09 seconds"):
        read(tmp_path, f'<begin value="{value}"/>')
