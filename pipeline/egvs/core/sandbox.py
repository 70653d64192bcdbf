"""Run a program that may write to one folder only, and that ends with the process that started it.

Run by path: ``python -I -S sandbox.py FOLDER PARENT_PID PROGRAM ARGUMENT ...``, where standard input is a pipe that the
parent keeps open. Imports no other module of this package.

On Linux: ask the kernel to kill this process when the parent ends (prctl, PR_SET_PDEATHSIG); let the kernel reject all
writing outside the folder (Landlock, since Linux 5.13; skipped on older kernels); replace this process by the program.
Elsewhere: run the program, and kill it when the pipe is closed, because the parent has ended.

References: man pages prctl(2) and landlock(7).
"""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import sys

CANNOT_START = 126
"""Exit code if the program could not be started; the last line of standard error is the reason."""

REPLACES_PROCESS = sys.platform.startswith("linux")
"""Whether the program replaces this process, instead of being watched by it."""

_PDEATHSIG = 1
_NO_NEW_PRIVILEGES = 38
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_FLAG = 1
_PATH_BENEATH = 1
_WRITE_FILE, _REFER, _TRUNCATE = 1 << 1, 1 << 13, 1 << 14
_MAKE_AND_REMOVE = sum(1 << bit for bit in range(4, 13))
_FILE_ACCESS = _WRITE_FILE | _TRUNCATE


def main(arguments: list[str]) -> int:
    """Replace this process by the program, or run it to its end and return its exit code."""
    folder, parent, *command = arguments
    if not REPLACES_PROCESS:
        return run_watched(command)
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(parent):  # the parent ended before prctl
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
    """Let the kernel reject writing outside a folder; return whether it can."""
    version = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION_FLAG))
    if version < 1:
        return False
    handled = _WRITE_FILE | _MAKE_AND_REMOVE | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    attributes = ctypes.create_string_buffer(struct.pack("=Q", handled), 8)
    rules = libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(8), ctypes.c_uint32(0))
    if rules < 0:
        return False
    for path, access in ((folder, handled), (os.devnull, handled & _FILE_ACCESS)):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        rule = ctypes.create_string_buffer(struct.pack("=Qi", access, descriptor), 12)
        libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, rule, ctypes.c_uint32(0))
        os.close(descriptor)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    error: int = libc.syscall(_RESTRICT_SELF, rules, ctypes.c_uint32(0))
    os.close(rules)
    return error == 0


def run_watched(command: list[str]) -> int:
    """Run the program until it ends or standard input is closed; return its exit code."""
    import subprocess  # not at the top: importing it takes a third of the start
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
