"""Words for numbers: one way to write a percentage, everywhere."""

from __future__ import annotations

import re
from pathlib import Path

import egvs
from egvs.core import wording

PACKAGE = Path(egvs.__file__).parent

FORMAT = re.compile(r"\{[^{}\n]*:[-+,z]*\.\d%\}|\"[-+,z]*\.\d%\"")
"""A share that Python formats itself: without a space before the sign."""

LITERAL = re.compile(r"""[0-9}]%[ .,;:)"']""")
"""A percentage without a space in a sentence; not the width in a style sheet, which a semicolon or letter follows."""


def test_percentages_have_a_space_and_a_sign_on_request() -> None:
    shares = (0.9304, 1.0, -0.0001, -0.125)
    assert [wording.format_percent(share) for share in shares] == ["93.0 %", "100.0 %", "0.0 %", "-12.5 %"]
    assert wording.format_percent(0.9304, 0) == "93 %"
    assert [wording.format_percent(share, 2, signed=True) for share in shares[:2]] == ["+93.04 %", "+100.00 %"]


def test_all_percentages_are_written_in_one_way() -> None:
    """Modules write shares with format_percent, and literal percentages as it does."""
    offences = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if FORMAT.search(line) or (LITERAL.search(line) and "width" not in line):
                offences.append(f"{path.relative_to(PACKAGE)}:{number}: {line.strip()}")
    assert offences == []
    assert FORMAT.search('f"{share:.1%} found"') and LITERAL.search('"over 99% found"')  # what it looks for
