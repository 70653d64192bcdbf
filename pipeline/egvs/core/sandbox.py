"""Run a program within limits: where it may write and read, its network, memory and time, and its parent.

Run by path: ``python -I -S sandbox.py [OPTION=VALUE ...] PARENT_PID PROGRAM ARGUMENT ...``, where standard input is a
pipe that the parent keeps open. Imports no other module of this package. The options are those of :data:`OPTIONS`.

On Linux: ask the kernel to kill this process when the parent ends (prctl, PR_SET_PDEATHSIG); let the kernel reject all
writing outside a folder and, where ``read`` is given, all reading of other files (Landlock, since Linux 5.13), and
sockets (seccomp); replace this process by the program. What the kernel cannot do is left out;
:func:`missing_protections` names it. Elsewhere: run the program, and kill it when the pipe is closed, because the
parent has ended.

References: man pages prctl(2), landlock(7), seccomp(2) and getrlimit(2).
"""

from __future__ import annotations

import ctypes
import os
import signal
import struct
import sys

OPTIONS = ("write", "read", "sockets", "memory_bytes", "processor_s")
"""``write``: the folder to write to; once. ``read``: a file or folder to read, as often as needed; without it,
everything may be read. ``sockets=no``: no network. ``memory_bytes``, ``processor_s``: limits of the process."""

CANNOT_START = 126
"""Exit code if the program could not be started; the last line of standard error is the reason."""

REPLACES_PROCESS = sys.platform.startswith("linux")
"""Whether the program replaces this process, instead of being watched by it."""

_PDEATHSIG = 1
_NO_NEW_PRIVILEGES = 38
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_VERSION_FLAG = 1
_PATH_BENEATH = 1
_WRITE_FILE, _READ_FILE, _READ_FOLDER = 1 << 1, 1 << 2, 1 << 3
_REFER, _TRUNCATE = 1 << 13, 1 << 14
_MAKE_AND_REMOVE = sum(1 << bit for bit in range(4, 13))
_FILE_ACCESS = _WRITE_FILE | _READ_FILE | _TRUNCATE

_SET_SECCOMP, _FILTER_MODE = 22, 2
_ALLOW, _REFUSE, _TEST_ACTION = 0x7FFF0000, 0x00050001, 2
"""Actions of a filter: allow the call; let it fail with EPERM. The operation of seccomp(2) that tests an action."""
_LOAD_WORD, _JUMP_IF_EQUAL, _JUMP_IF_AT_LEAST, _RETURN = 0x20, 0x15, 0x35, 0x06
_OTHER_CALLS = 0x40000000
"""Calls from here on are those of x32 on x86-64; no program here uses them."""
_IO_URING_SETUP = 425
_SYSTEM_CALLS = {
    "x86_64": (0xC000003E, 317, (41, 53, _IO_URING_SETUP)),
    "aarch64": (0xC00000B7, 277, (198, 199, _IO_URING_SETUP)),
}
"""By machine: AUDIT_ARCH, the number of seccomp(2), and those of socket(2), socketpair(2) and io_uring_setup(2)."""


def main(arguments: list[str]) -> int:
    """Replace this process by the program, or run it to its end and return its exit code."""
    options: dict[str, list[str]] = {name: [] for name in OPTIONS}
    while (option := arguments[0].partition("="))[0] in options and option[1]:
        options[option[0]].append(option[2])
        arguments = arguments[1:]
    parent, *command = arguments
    limit_resources(options["memory_bytes"], options["processor_s"])
    if not REPLACES_PROCESS:
        return run_watched(command)
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(parent):  # the parent ended before prctl
        return CANNOT_START
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    restrict_files(options["write"], options["read"], libc)
    if "no" in options["sockets"]:
        reject_sockets(libc)
    devnull = os.open(os.devnull, os.O_RDONLY)
    os.dup2(devnull, 0)
    try:
        os.execv(command[0], command)
    except OSError as error:
        print(error.strerror, file=sys.stderr)
        return CANNOT_START


def limit_resources(memory_bytes: list[str], processor_s: list[str]) -> None:
    """Let allocations above a limit fail, and let the kernel end the process (SIGXCPU) after so much processor time.

    RLIMIT_DATA counts what a process can write to, unlike RLIMIT_AS: neither the code of libraries nor reserved
    addresses, which take 0.5 GB in SUMO.
    """
    try:
        import resource
    except ImportError:  # Windows
        return
    for kind, values in ((resource.RLIMIT_DATA, memory_bytes), (resource.RLIMIT_CPU, processor_s)):
        for value in values:
            hard = resource.getrlimit(kind)[1]
            soft = int(value) if hard == resource.RLIM_INFINITY else min(hard, int(value))
            resource.setrlimit(kind, (soft, hard))


def restrict_files(writable: list[str], readable: list[str], libc: ctypes.CDLL) -> bool:
    """Let the kernel reject writing outside folders, and reading of files that are not named, if any is; return whether
    it can. A program is a file that must be readable, too.
    """
    version = _landlock_version(libc)
    if version < 1:
        return False
    write = _WRITE_FILE | _MAKE_AND_REMOVE | (_REFER if version >= 2 else 0) | (_TRUNCATE if version >= 3 else 0)
    read = _READ_FILE | _READ_FOLDER if readable else 0
    attributes = ctypes.create_string_buffer(struct.pack("=Q", write | read), 8)
    rules = libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(8), ctypes.c_uint32(0))
    if rules < 0:
        return False
    for path in (*writable, os.devnull):
        _allow(path, write | read, rules, libc)
    for path in readable:
        _allow(path, read, rules, libc)
    error: int = libc.syscall(_RESTRICT_SELF, rules, ctypes.c_uint32(0))
    os.close(rules)
    return error == 0


def _allow(path: str, access: int, rules: int, libc: ctypes.CDLL) -> None:
    """Add a file, or a folder with what it contains, to the rules; a path that does not exist is left out."""
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    if not os.path.isdir(path):  # noqa: PTH112 - importing pathlib takes longer than the rest
        access &= _FILE_ACCESS
    rule = ctypes.create_string_buffer(struct.pack("=Qi", access, descriptor), 12)
    libc.syscall(_ADD_RULE, rules, _PATH_BENEATH, rule, ctypes.c_uint32(0))
    os.close(descriptor)


def reject_sockets(libc: ctypes.CDLL) -> bool:
    """Let the kernel refuse new sockets, and io_uring, which could make some; return whether it can."""
    calls = _SYSTEM_CALLS.get(os.uname().machine)
    if calls is None:
        return False
    architecture, _, refused = calls
    refuse = 5 + len(refused)  # the last instruction; a jump counts from the instruction behind it
    instructions = [
        (_LOAD_WORD, 0, 0, 4),  # the architecture
        (_JUMP_IF_EQUAL, 0, refuse - 2, architecture),
        (_LOAD_WORD, 0, 0, 0),  # the number of the call
        (_JUMP_IF_AT_LEAST, refuse - 4, 0, _OTHER_CALLS),
        *((_JUMP_IF_EQUAL, refuse - 5 - position, 0, call) for position, call in enumerate(refused)),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, _REFUSE),
    ]
    code = b"".join(struct.pack("=HBBI", *instruction) for instruction in instructions)
    buffer = ctypes.create_string_buffer(code, len(code))
    program = ctypes.create_string_buffer(struct.pack("@HP", len(instructions), ctypes.addressof(buffer)))
    error: int = libc.prctl(_SET_SECCOMP, _FILTER_MODE, program, 0, 0)
    return error == 0


def missing_protections() -> list[str]:
    """Return what this system cannot enforce, in words; nothing is restricted."""
    if not REPLACES_PROCESS:
        return ["programs may read and write other files (only Linux confines them)", "programs may open sockets"]
    libc = ctypes.CDLL(None, use_errno=True)
    missing = []
    if _landlock_version(libc) < 1:
        missing.append("programs may read and write other files (the kernel has no Landlock)")
    calls = _SYSTEM_CALLS.get(os.uname().machine)
    action = ctypes.c_uint32(_REFUSE & 0xFFFF0000)
    if calls is None or libc.syscall(calls[1], _TEST_ACTION, 0, ctypes.byref(action)) != 0:
        missing.append("programs may open sockets (the kernel has no seccomp for this machine)")
    return missing


def _landlock_version(libc: ctypes.CDLL) -> int:
    """Return the version of Landlock; 0 or less where there is none."""
    version: int = libc.syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(_VERSION_FLAG))
    return version


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
