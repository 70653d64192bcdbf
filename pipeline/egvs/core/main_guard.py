"""Scripts that start worker processes need ``if __name__ == "__main__":``, or each worker runs them again."""

from __future__ import annotations

import ast
import sys
from pathlib import Path
from types import FrameType

from egvs.core.errors import RunError


def check_main_guard() -> None:
    """Raise a RunError if a worker process, which imports the main script first, would repeat the present call.

    Worker processes are started with ``spawn``. They import the script by its path and run all of its statements
    outside ``if __name__ == "__main__":``. Without this check they end in a traceback, and the main process may wait
    for them forever. A package's ``__main__`` and code without a file are not imported.
    """
    main = sys.modules["__main__"]
    path = getattr(main, "__file__", None)
    module_name = getattr(getattr(main, "__spec__", None), "name", "")
    line = _running_line(vars(main))
    if path is None or line is None or module_name.endswith("__main__") or not Path(path).is_file():
        return
    try:
        statements = ast.parse(Path(path).read_bytes()).body
    except (SyntaxError, ValueError):  # not a script: a compiled or zipped program
        return
    if not any(_is_guard(statement) and _contains(statement, line) for statement in statements):
        raise RunError(
            f"{path}: line {line} starts worker processes, each of which would run the whole script again. "
            'Put the calls below `if __name__ == "__main__":`, or use jobs=1.'
        )


def _running_line(main_names: dict[str, object]) -> int | None:
    """Return the line of the main script that is running; None outside of one."""
    frame: FrameType | None = sys._getframe()
    while frame is not None:
        if frame.f_globals is main_names and frame.f_code.co_name == "<module>":
            return frame.f_lineno
        frame = frame.f_back
    return None


def _is_guard(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.If) and any(
        isinstance(node, ast.Name) and node.id == "__name__" for node in ast.walk(statement.test)
    )


def _contains(statement: ast.stmt, line: int) -> bool:
    return statement.lineno <= line <= (statement.end_lineno or statement.lineno)
