r"""LaTeX becomes MathML while the site is built, so that formulas need neither a script nor a network."""

from __future__ import annotations

import re

from latex2mathml.converter import convert

_WORD = re.compile(r"\\(?:text|begin|end)\{[^{}]*\}|\\mathrm\{([^{}]*)\}|\\[A-Za-z]+|([A-Za-z]{2,})")
_NAME = r"(?:<msub>)?<mi>(?:ln|log|exp|sin|cos|tan)</mi>(?:<mn>\d</mn></msub>)?+"
_APART = re.compile(rf"(?<=</mi>)(?={_NAME})|(?<=</msub>)(?={_NAME})|({_NAME})(?!<mo|</ms)")


def mathml(latex: str, display: str = "inline") -> str:
    """One formula; words of several letters (``detect``, ``EGVS``) stand upright instead of as products of letters."""

    def upright(match: re.Match[str]) -> str:
        word = match[1] or match[2]
        return rf"\text{{{word}}}" if word else match[0]

    text = _WORD.sub(upright, re.sub(r"\\mathrel\{(.)\}", r"\1", " ".join(latex.split())))
    return _APART.sub(lambda m: (m[1] or "") + '<mspace width="0.17em" />', convert(text, display=display))
