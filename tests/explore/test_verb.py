"""`egvs explore` on the command line: what it prints, how it ends, what it refuses."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path

import pytest

from egvs.explore import page
from tests.processes import EGVS


@pytest.mark.system
@pytest.mark.slow
def test_it_serves_until_an_interrupt_and_leaves_nothing(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-c", EGVS, "explore", mini, "--no-browser", "--out", out]
    (tmp_path / "tmp").mkdir()
    started = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env=os.environ | {"TMPDIR": str(tmp_path / "tmp")},
    )  # fmt: skip
    assert started.stdout is not None
    address = next(line.split()[0] for line in started.stdout if line.startswith("http"))
    before = {path: path.read_bytes() for path in out.iterdir()}
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    assert opener.open(address).status == 200
    os.kill(started.pid, signal.SIGINT)
    printed, said = started.communicate()
    assert (started.returncode, printed.strip()) == (0, "")
    assert said.splitlines()[-1].startswith("score")  # no word of an interrupt
    with pytest.raises(ProcessLookupError):
        os.killpg(started.pid, 0)  # nobody is left of all that it started
    with pytest.raises(urllib.error.URLError, match="refused"):
        opener.open(address)
    assert not any(tmp_path.glob("tmp/egvs-work-*"))  # where runs with other settings are made
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_the_address_is_printed_and_opened(
    run_egvs, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(page.Page, "run", lambda page: opened.append(page.address))
    code, out, err = run_egvs("explore", mini, "--out", tmp_path / "run")
    assert (code, err.splitlines()[-1].partition(" ")[0]) == (0, "score")
    assert opened[0] == opened[1]
    assert out.splitlines()[-1] == f"{opened[0]}  (press Ctrl-C to stop)"
    run_egvs("explore", tmp_path / "run", "--no-browser")
    assert len(opened) == 3


def test_it_begins_with_the_view_of_a_link(
    run_egvs, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple] = []

    def run(page: page.Page) -> None:
        page._show(page._latest)
        shown.append((page.view.site.name, page.view.site.pose.z_m, page.view.layer))

    monkeypatch.setattr(page.Page, "run", run)
    explore = ("explore", mini, "--no-browser", "--out", tmp_path / "run", "--view")
    assert run_egvs(*explore, "site=pole_a&pose=10,12,4.5,0,0,0&layer=seen")[0] == 0
    assert shown == [("pole_a", 4.5, "seen")]
    code, _, err = run_egvs(*explore, "site=nobody")
    assert (code, err.splitlines()[-1]) == (2, "egvs: --view: site: 'nobody'; one of pole_a, pole_b")


def test_without_the_extra_it_says_how_to_install_it(run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mini.parent)
    monkeypatch.setitem(sys.modules, "viser", None)
    code, out, err = run_egvs("explore", mini)
    assert (code, out) == (2, "")
    assert err == "egvs: egvs explore needs viser, which is not installed: pip install 'egvs[explore]'\n"
    assert not Path("runs").exists()


def test_a_port_that_is_taken_is_one_message_before_any_work(
    run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(mini.parent)
    with socket.socket() as other:
        other.bind((page.HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        code, out, err = run_egvs("explore", mini, "--port", port)
    assert (code, out) == (2, "")
    assert err == f"egvs: --port: {port} is taken; another one, or 0 for any that is free\n"
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("nowhere", "--no-browser"), "nowhere"),
        (("mini", "--port", "70000"), "less than or equal to 65535"),
        (("mini", "--set", "score.gamma=-1"), "score.gamma"),
    ],
)
def test_what_is_wrong_is_one_message(
    run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(mini.parent)
    code, out, err = run_egvs("explore", *options)
    assert (code, out) == (2, "")
    assert message in err
    assert "Traceback" not in err
    assert not Path("runs").exists()
