"""Starting and querying SUMO."""

import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from egvs.core.errors import InputError, MissingBackendError, RunError
from egvs.stages import traffic
from egvs.traffic import sumo
from tests.stage_runner import run_stage
from tests.traffic.helpers import SMALL, fake_sumo, scenario, serve


def test_missing_system_library_is_named_with_its_package(tmp_path, monkeypatch):
    says = "sumo: error while loading shared libraries: libX11.so.6: cannot open shared object file: No such file"
    fake_sumo(tmp_path, monkeypatch, f"echo '{says}' >&2; exit 127")
    with pytest.raises(
        MissingBackendError, match=r"libX11\.so\.6 is missing. On Debian, run apt-get install .*libx11-6"
    ):
        sumo.run_program("sumo", ["--version"], tmp_path)


def test_reports_killed_sumo(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "kill -9 $$")
    with pytest.raises(RunError, match="sumo was killed by signal 9"):
        sumo.run_program("sumo", [], tmp_path)


@pytest.mark.parametrize("signal", [6, 8, 11])
def test_crash_is_an_error_of_the_input(tmp_path, monkeypatch, signal):
    """By damaged networks, some of which SUMO does not survive."""
    fake_sumo(tmp_path, monkeypatch, f"echo {'x' * 1000} >&2; kill -{signal} $$")
    with pytest.raises(sumo.SumoInputError, match=f"sumo crashed with signal {signal}:\n  x{{300}}$"):
        sumo.run_program("sumo", [], tmp_path)


def test_rejects_invalid_binary(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "")
    (tmp_path / "sumo").write_bytes(b"\x00not a program")
    with pytest.raises(MissingBackendError, match="sumo cannot be started"):
        sumo.run_program("sumo", [], tmp_path)


@pytest.mark.parametrize(("variable", "name"), [("SUMO_BINARY", "sumo"), ("NETCONVERT_BINARY", "netconvert")])
def test_rejects_missing_program_of_the_environment(tmp_path, monkeypatch, variable, name):
    for missing in (tmp_path / "absent", tmp_path, "no-such-program"):
        monkeypatch.setenv(variable, str(missing))
        with pytest.raises(InputError, match=f"{variable}: expected a program, got '{missing}'"):
            sumo.sumo_binary(name)
    monkeypatch.setenv(variable, "")
    assert sumo.sumo_binary(name).is_file()


def test_rejects_missing_folder_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("SUMO_HOME", str(tmp_path / "absent"))
    with pytest.raises(InputError, match="SUMO_HOME: expected a folder, got"):
        sumo.sumo_binary("sumo")


def test_finding_sumo_preserves_proj_variables(monkeypatch):
    """The wheel's data is of a PROJ that rasterio's refuses."""
    for name in ("PROJ_DATA", "PROJ_LIB", "SUMO_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.delitem(sys.modules, "sumo", raising=False)
    sumo.sumo_binary("sumo")
    assert "PROJ_DATA" not in os.environ and "PROJ_LIB" not in os.environ
    assert sumo.sumo_environment()["PROJ_DATA"].endswith("proj")
    monkeypatch.setenv("PROJ_DATA", "mine")
    sumo.sumo_binary("sumo")
    assert os.environ["PROJ_DATA"] == sumo.sumo_environment()["PROJ_DATA"] == "mine"


def test_programs_use_huge_pages_unless_the_user_sets_other_tunables(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, 'echo "$GLIBC_TUNABLES"')
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    assert sumo.run_program("sumo", [], tmp_path) == "glibc.malloc.hugetlb=1\n"
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=0")
    assert sumo.run_program("sumo", [], tmp_path) == "glibc.malloc.check=0\n"


def test_version_of_another_sumo_is_parsed(tmp_path, monkeypatch):
    fake_sumo(tmp_path, monkeypatch, "echo 'Eclipse SUMO sumo v1_27_0+0045-abc'")
    sumo.sumo_version.cache_clear()
    try:
        assert sumo.sumo_version() == "1.27.0+0045-abc"
    finally:
        sumo.sumo_version.cache_clear()


def test_rejects_incomplete_network_from_netconvert(tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "run_program", lambda *_: (tmp_path / "a.net.xml").write_text("<net>\n <edge"))
    with pytest.raises(RunError, match=r"a\.net\.xml: SUMO wrote an incomplete file. Is the disk full\?"):
        sumo.run_netconvert([], tmp_path, "a.net.xml")
    monkeypatch.setattr(sumo, "run_program", lambda *_: (tmp_path / "a.net.xml").write_text("<net>\n</net>\n"))
    sumo.run_netconvert([], tmp_path, "a.net.xml")


def test_rejects_traci_address_without_server(town, tmp_path):
    from sumolib.miscutils import getFreeSocketPort

    with pytest.raises(InputError, match="no SUMO simulation answers there"):
        run_stage(
            traffic, scenario(town, network="net.xml", **SMALL), tmp_path, traci=("localhost", getFreeSocketPort())
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "answer", [b"", b"HTTP/1.1 400 Bad Request\r\n", b"\0\0\0\5\0", b"\0\0\0\x0b\7\0\0\0\0\0\0", b"\0\0\0\4"]
)
def test_rejects_server_that_is_not_sumo(town, tmp_path, monkeypatch, answer):
    """One that listens and is silent, and some that say something else, and wait."""
    monkeypatch.setattr(sumo, "_ANSWER_TIMEOUT_S", 0.2)
    with socket.create_server(("localhost", 0)) as server, ThreadPoolExecutor(1) as threads:
        taken = threads.submit(server.accept)
        port = server.getsockname()[1]
        answered = threads.submit(lambda: taken.result()[0].sendall(answer))
        with pytest.raises(InputError, match=r"the server there does not answer as SUMO does within 0\.2 s"):
            run_stage(traffic, scenario(town, network="net.xml", **SMALL), tmp_path, traci=("localhost", port))
        answered.result()
        taken.result()[0].close()
    assert not (tmp_path / "trajectories.parquet").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("retry_connecting")
def test_reports_sumo_that_stops_answering(town, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(sumo, "_STEP_TIMEOUT_S", 0.2)
    process, port = serve(recorded[3] / "sumo")
    with process:
        try:
            with (
                pytest.raises(RunError, match=rf"SUMO at localhost:{port} closed .*, or did not answer for 0\.2 s"),
                sumo.connect_traci("localhost", port) as connection,
            ):
                process.send_signal(signal.SIGSTOP)
                connection.simulationStep()
        finally:
            process.kill()


@pytest.mark.slow
def test_importing_the_stage_does_not_import_sumo_tools():
    code = "import sys, egvs.stages.traffic; print([m for m in ('sumolib', 'traci') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
