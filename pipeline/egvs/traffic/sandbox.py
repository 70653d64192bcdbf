"""Starts a program that may write in one folder only and that ends with the process that started it.

A script of its own, run by Python before the program: ``confined.py FOLDER PARENT PROGRAM ARGUMENT ...``. Standard
input is a pipe that the parent holds open.

Steps on Linux: ask the kernel for a signal when the parent ends (prctl, PR_SET_PDEATHSIG); let the kernel refuse all
writing outside the folder (Landlock, from Linux 5.13 on; an older one is gone on without); become the program. On other
systems: run the program, and kill it when the pipe says that the parent is gone.

References: man pages prctl(2) and landlock(7).
"""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import sys

CANNOT_START = 126
"""Exit code where the program could not be started; what is wrong stands in the last line of standard error."""

REPLACES_PROCESS = sys.platform.startswith("linux")
"""Whether the program takes this process' place, and is not watched by it."""

_PDEATHSIG = 1
_NO_NEW_PRIVILEGES = 38
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION = 1
_BENEATH = 1
_WRITE_FILE, _REFER, _TRUNCATE = 1 << 1, 1 << 13, 1 << 14
_MAKE_AND_REMOVE = sum(1 << bit for bit in range(4, 13))
_OF_FILES = _WRITE_FILE | _TRUNCATE


def main(arguments: list[str]) -> int:
    """Become the program, or run it to its end; the exit code where it could not be started or was run."""
    folder, parent, *command = arguments
    if not REPLACES_PROCESS:
        return run_watched(command)
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(parent):  # it ended before the kernel was asked
        return CANNOT_START
    restrict_writes_to(folder, libc)
    devnull = os.open(os.devnull, os.O_RDONLY)
    os.dup2(devnull, 0)
    try:
        os.execv(command[0], command)
    except OSError as error:
        print(error.strerror, file=sys.stderr)
        return CANNOT_START


def restrict_writes_to(folder: str, libc: ctypes.CDLL) -> bool:
    """Whether the kernel refuses from now on to let this process write anywhere but in ``folder``."""
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION))
    if version < 1:
        return False
    handled = _WRITE_FILE | _MAKE_AND_REMOVE | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    attributes = ctypes.create_string_buffer(struct.pack("=Q", handled), 8)
    rules = libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(8), ctypes.c_uint32(0))
    if rules < 0:
        return False
    for path, access in ((folder, handled), (os.devnull, handled & _OF_FILES)):
        place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rule = ctypes.create_string_buffer(struct.pack("=Qi", access, place), 12)
        libc.syscall(_ADD_RULE, rules, _BENEATH, rule, ctypes.c_uint32(0))
        os.close(place)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    done: int = libc.syscall(_RESTRICT_SELF, rules, ctypes.c_uint32(0))
    os.close(rules)
    return done == 0


def run_watched(command: list[str]) -> int:
    """Run the program to its end, or to the end of standard input; its exit code."""
    import subprocess  # costs a third of the start, which other systems need not pay
    import threading

    try:
        program = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    except OSError as error:
        print(error.strerror, file=sys.stderr)
        return CANNOT_START

    def end_with_parent() -> None:
        while os.read(0, 1):
            pass
        program.kill()

    threading.Thread(target=end_with_parent, daemon=True).start()
    return program.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
