"""Does SUMO read what was read here, and nothing else?"""

import gzip
from xml.etree.ElementTree import parse

import pytest

from egvs.core.errors import InputError
from egvs.formats import xml
from egvs.traffic import user_files

TEXT = '<?xml version="1.0" encoding="{}"?>\n<!-- note --><routes a="1"><route id="通り" edges="a  b"/></routes>\n'


def told(path):
    return [(e.tag, e.attrib, [c.attrib for c in e]) for e in xml.iter_elements(path, "")]


def test_a_harmless_file_is_copied_byte_for_byte_and_unzipped(tmp_path):
    data = TEXT.format("UTF-8").encode()
    (tmp_path / "a.xml").write_bytes(data)
    (tmp_path / "b.xml.gz").write_bytes(gzip.compress(data))
    for name in ("a.xml", "b.xml.gz"):
        assert user_files.copy_checked(tmp_path / name, tmp_path / "copy.xml") == []
        assert (tmp_path / "copy.xml").read_bytes() == data


@pytest.mark.parametrize("encoding", ["UTF-16", "iso-8859-1", "windows-1252"])
def test_another_encoding_becomes_utf8(tmp_path, encoding):
    data = TEXT.format(encoding).replace("通り", "é").encode(encoding)
    (tmp_path / "a.xml").write_bytes(data)
    user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml")
    assert (tmp_path / "copy.xml").read_bytes().decode() == '<routes a="1">\n<route id="é" edges="a  b" /></routes>\n'


def test_a_rewritten_file_says_the_same_but_for_its_outputs(tmp_path):
    text = (
        '<additional v="&lt;&quot;"><a x="1&amp;&#10;2"><b file="f"/><b/></a><c>t</c>'
        '<param key="x.file" value="f"/></additional>'
    )
    (tmp_path / "a.xml").write_text(text)
    assert user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml") == [
        "a.xml: outputs of SUMO are disabled: 1 of <b>, 1 of <param>"
    ]
    assert told(tmp_path / "copy.xml") == [
        ("a", {"x": "1&\n2"}, [{"file": "NUL"}, {}]),
        ("c", {}, []),
        ("param", {"key": "x.file", "value": "NUL"}, []),
    ]
    assert parse(tmp_path / "copy.xml").getroot().attrib == {"v": '<"'}


def test_names_that_sumo_would_read_as_more_are_changed():
    assert user_files.safe_name("a,b;${HOME}.rou.xml") == "a_b__{HOME}.rou.xml"


FURTHER = {
    "signs": '<variableSpeedSign id="v" lanes="a_0" file="speeds.xml"/>',
    "rerouters": '<rerouter id="r" edges="a" file="r.xml"/>',
    "inclusions": '<include href="more.xml"/>',
    "zones": '<taz id="t"/><tazRelation edgesFile="e.txt"/>',
    "signs within": '<parkingArea id="p"><variableSpeedSign id="v" file="speeds.xml"/></parkingArea>',
}


@pytest.mark.parametrize("text", FURTHER.values(), ids=FURTHER.keys())
def test_what_would_have_sumo_read_a_further_file_is_refused(tmp_path, text):
    (tmp_path / "a.xml").write_text(f"<additional>{text}</additional>")
    with pytest.raises(InputError, match=r"makes SUMO read a further file"):
        user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml")
    assert not (tmp_path / "copy.xml").exists()
    (tmp_path / "a.xml").write_text(
        '<additional><variableSpeedSign id="v"><step time="0" speed="9"/></variableSpeedSign></additional>'
    )
    assert user_files.copy_checked(tmp_path / "a.xml", tmp_path / "copy.xml") == []


def test_what_was_checked_is_not_parsed_again_unless_it_is_another(tmp_path, monkeypatch):
    path = tmp_path / "a.xml"
    path.write_text('<routes><a x="1"/></routes>')
    user_files.check_copyable(path)
    with monkeypatch.context() as patch:
        patch.setattr(user_files, "_checked_elements", None)
        assert user_files.copy_checked(path, tmp_path / "copy.xml") == []
    path.write_text('<routes><include href="f"/></routes>')
    with pytest.raises(InputError, match="makes SUMO read a further file"):
        user_files.check_copyable(path)
