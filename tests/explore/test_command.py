"""`egvs explore` on the command line: output, end, and invalid options."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import webbrowser
from pathlib import Path

import pytest

from egvs.artefacts.run_record import StageRecord
from egvs.core.errors import InputError
from egvs.core.resource_usage import ResourceUsage
from egvs.explore import page, server, settings
from egvs.runs.run import StageListener
from tests.processes import EGVS

INTERRUPTIBLE = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {EGVS}"
"""A shell ignores the interrupt in what it starts in the background, and so do the processes of its tests."""


@pytest.mark.system
@pytest.mark.slow
def test_serves_until_interrupt_and_cleans_up(mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    command = [sys.executable, "-c", INTERRUPTIBLE, "explore", mini, "--no-browser", "--out", out]
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
    printed, errors = started.communicate(timeout=120)
    assert (started.returncode, printed.strip()) == (0, "")
    assert errors.splitlines()[-1].startswith("score")  # no message about the interrupt
    with pytest.raises(ProcessLookupError):
        os.killpg(started.pid, 0)  # no process is left
    with pytest.raises(urllib.error.URLError, match="refused"):
        opener.open(address)
    assert not any(tmp_path.glob("tmp/egvs-work-*"))  # temporary runs with other settings
    assert {path: path.read_bytes() for path in out.iterdir()} == before


@pytest.mark.parametrize("options", [(), ("--to", "page.html")])
@pytest.mark.parametrize(("entry", "source"), [("traffic (from the road classes)", "the assumed flows"),
                                               ("positions of the poles", "the counts")])  # fmt: skip
def test_says_what_simulated_flows_are_compared_with(
    run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], entry: str, source: str
) -> None:
    record = StageRecord("", {}, {}, {"frames": 10, "counts": [{"geh": 0.21}]}, ResourceUsage(seconds=1.0, peak_mb=1.0))

    def open_session(*_: object, listener: StageListener, **__: object) -> None:
        listener("traffic", "done", record)
        raise InputError("here", "the session would begin")

    monkeypatch.setattr(settings, "open_session", open_session)
    code, _, err = run_egvs("explore", mini, *options, "--set", f"assumed=['{entry}']")
    assert code == 2 and f"10 frames; largest GEH against {source} 0.2" in err


@pytest.mark.slow
def test_address_is_printed_and_opened(run_egvs, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(page.Page, "run", lambda page: opened.append(page.address))
    code, out, err = run_egvs("explore", mini, "--out", tmp_path / "run")
    assert (code, err.splitlines()[-1].partition(" ")[0]) == (0, "score")
    assert opened[0] == opened[1]
    assert out.splitlines()[-1] == f"{opened[0]}  (press Ctrl-C to stop)"
    run_egvs("explore", tmp_path / "run", "--no-browser")
    assert len(opened) == 3


@pytest.mark.slow
def test_starts_with_the_view_of_a_link(run_egvs, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple] = []

    real_run = page.Page.run

    def run(page: page.Page) -> None:
        loop = threading.Thread(target=real_run, args=(page,))
        loop.start()
        assert page.wait_until_idle(60)
        shown.append((page.view.site.name, page.view.site.pose.z_m, page.view.layer))
        page.end()
        loop.join()

    monkeypatch.setattr(page.Page, "run", run)
    explore = ("explore", mini, "--no-browser", "--out", tmp_path / "run", "--view")
    assert run_egvs(*explore, "site=pole_a&pose=10,12,4.5,0,0,0&layer=seen")[0] == 0
    assert shown == [("pole_a", 4.5, "seen")]
    code, _, err = run_egvs(*explore, "site=nobody")
    assert (code, err.splitlines()[-1]) == (2, "egvs: --view: site: expected one of pole_a, pole_b, got 'nobody'")


def test_says_how_to_install_viser(run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mini.parent)
    monkeypatch.setitem(sys.modules, "viser", None)
    code, out, err = run_egvs("explore", mini)
    assert (code, out) == (2, "")
    assert err == "egvs: egvs explore needs viser, which is not installed. Run pip install 'egvs[explore]'\n"
    assert not Path("runs").exists()


def test_port_in_use_is_reported_before_any_work(run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(mini.parent)
    with socket.socket() as other:
        other.bind((server.HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        code, out, err = run_egvs("explore", mini, "--port", port)
    assert (code, out) == (2, "")
    assert err == f"egvs: --port: port {port} is in use. Use another port, or 0 for any free one.\n"
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("nowhere", "--no-browser"), "nowhere"),
        (("mini", "--port", "70000"), "less than or equal to 65535"),
        (("mini", "--set", "score.gamma=-1"), "score.gamma"),
        (
            ("mini", "--to", "page.txt"),
            "--to: expected a file name ending in .html, got 'page.txt'. Use --to page.html.",
        ),
        (("mini", "--to", "mini"), "--to: expected a file name ending in .html, got 'mini'. Use --to page.html."),
        (("mini", "--to", "page.html", "--port", "8080"), "--to: cannot be combined with --port or --view."),
        (("nowhere", "--to", "page.html"), "nowhere"),
    ],
)
def test_invalid_options_give_one_message(
    run_egvs, mini: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(mini.parent)
    code, out, err = run_egvs("explore", *options)
    assert (code, out) == (2, "")
    assert message in err
    assert "Traceback" not in err
    assert not Path("runs").exists()


@pytest.mark.slow
def test_writes_page_file_without_serving(
    run_egvs, mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda _: pytest.fail("a browser was opened"))
    file = tmp_path / "page.html"
    code, out, err = run_egvs("explore", mini, "--out", tmp_path / "run", "--to", file)
    assert (code, err.splitlines()[-1].partition(" ")[0]) == (0, "score")
    size = f"{file.stat().st_size / 1e6:.1f} MB"
    assert out.startswith(f"{file}  ({size}; 20 s of traffic from pole_b; ")
    assert out.endswith(" returns on road users)\n")
