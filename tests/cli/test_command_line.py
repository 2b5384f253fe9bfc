"""What a user sees who asks for the wrong thing: one clear line and the right status."""

import argparse
import contextlib
import errno
import io
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from skin_host.cli import build_parser, main, watch
from skin_host.config.settings import load, skin_hash
from skin_host.daemon.state import refuse_left_behind
from skin_host.layout import build_layout
from skin_host.processing.calibration.calibrator import Calibrator
from skin_host.processing.calibration.file import load_calibration
from tests.support.broker import free_port
from tests.support.moments import at_import
from tests.support.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "config/demo.toml"


def asked(*arguments: str) -> "subprocess.CompletedProcess[str]":
    """What a command that starts nothing says, without a process of its own."""
    said, complained = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(complained):
        try:
            status = main(arguments)
        except SystemExit as ended:
            assert isinstance(ended.code, int)
            status = ended.code
    return subprocess.CompletedProcess(arguments, status, said.getvalue(), complained.getvalue())


def skin(*arguments: str, **environment: str) -> "subprocess.CompletedProcess[str]":
    """The same of a whole program."""
    return subprocess.run(
        [sys.executable, "-m", "skin_host", *arguments],
        check=False,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | environment,
        timeout=PATIENCE_S,
    )


def refused(result: "subprocess.CompletedProcess[str]", status: int, *wanted: str) -> None:
    lines = result.stderr.strip().splitlines()
    assert result.returncode == status, result.stderr
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    for text in wanted:
        assert text in lines[0]


def changed(tmp_path: Path, old: str, new: str) -> str:
    text = DEMO.read_text()
    assert old in text
    path = tmp_path / "changed.toml"
    path.write_text(text.replace(old, new, 1))
    return str(path)


@pytest.mark.parametrize(
    ("old", "new", "path", "seen"),
    [
        ("address = 14", "address = 15", "boards.hand.address", "seen 15, wanted `int` <= 14"),
        ("address = 14", "adress = 14", "boards.hand", "adress"),
        ("address = 14", 'address = "x"', "boards.hand.address", "seen 'x', wanted `int`"),
        ('triangles = "0-4"', 'triangles = "0-40"', "parts.left_hand.patches[0].triangles", "40"),
        ('kind = "fingertip"', 'kind = "finger"', "parts.left_hand.patches[0].kind", "finger"),
        ('bus = "can0"', 'bus = "can9"', "boards.hand.bus", "can9"),
        ('robot = "demo"', "robot = demo", "TOML", "line"),
    ],
)
def test_a_wrong_configuration_is_named_by_file_and_key(tmp_path, old, new, path, seen):
    config = changed(tmp_path, old, new)
    refused(asked("check", config), 2, config, path, seen)


@pytest.mark.parametrize("config", sorted((ROOT / "config").glob("*.toml")), ids=lambda at: at.stem)
def test_every_configuration_of_the_project_is_right(config, capsys):
    assert main(["check", str(config)]) == 0, capsys.readouterr().err


def test_a_missing_interface_is_waited_for_and_named_with_what_mends_it(tmp_path):
    config = changed(tmp_path, 'interface = "virtual"', 'interface = "socketcan"')
    result = skin("run", config, "--calibrate", "--duration", "3", XDG_STATE_HOME=str(tmp_path))
    assert "Traceback" not in result.stderr
    assert "skin-demo" in result.stderr
    assert not list(tmp_path.rglob("*.calibration.json"))


def test_an_unknown_interface_kind_is_refused(tmp_path):
    config = changed(tmp_path, 'interface = "virtual"', 'interface = "pigeon"')
    refused(skin("run", config, "--calibrate", XDG_STATE_HOME=str(tmp_path)), 2, "pigeon")


@pytest.mark.parametrize(
    ("name", "content"),
    [("absent.log", None), ("empty.log", b""), ("noise.log", bytes(range(256))), ("x.asc", b"?")],
)
def test_an_unreadable_log_is_refused_and_leaves_no_output(tmp_path, name, content):
    log = tmp_path / name
    if content is not None:
        log.write_bytes(content)
    output = tmp_path / "out.jsonl"
    result = asked("replay", str(log), "--config", str(DEMO), "--output", str(output))
    refused(result, 2, str(log))
    assert not output.exists()
    assert {path.name for path in tmp_path.iterdir()} <= {name}


def test_a_log_of_another_robot_is_refused(tmp_path):
    log = tmp_path / "other.log"
    log.write_text("(1700000000.000000) can0 410#40F0F0F0F0F0F0F0\n")
    refused(asked("replay", str(log), "--config", str(DEMO)), 2, "no sweep of this skin")


def test_a_calibration_of_another_configuration_is_refused(tmp_path):
    calibration = tmp_path / "calibration.json"
    log = tmp_path / "x.log"
    log.write_text("(1700000000.000000) can0 4E0#40F0F0F0F0F0F0F0\n")
    calibration.write_text("{}")
    result = asked("replay", str(log), "--config", str(DEMO), "--calibration", str(calibration))
    refused(result, 2, str(calibration), "skin calibrate")


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        (["calibrat"], "meant calibrate?"),
        (["bench", "recieve"], "meant receive?"),
        (["bench", "recieve"], "skin bench --help"),
        (
            ["demo", "--seconds", "8"],
            "skin demo: unrecognized arguments: --seconds (see `skin demo",
        ),
        (["status", "--watch"], "unrecognized arguments: --watch (see `skin status --help`)"),
        (["run", str(DEMO), "--duraton", "3"], "meant --duration?"),
        (["run", str(DEMO), "--duration", "-3"], "seen -3, wanted a number above 0"),
        (["calibrate", str(DEMO), "--seconds", "0"], "seen 0, wanted a number above 0"),
        (["emulate", str(DEMO), "--speed", "fast"], "seen fast, wanted a number above 0"),
        (["run", str(DEMO), "--workers", "0"], "seen 0, wanted a whole number from 1 to"),
        (["emulate", str(DEMO), "--seed", "-1"], "seen -1, wanted a whole number from 0 to"),
        (["simulate", "--hours", "inf"], "seen inf, wanted a number below 10000"),
        (["simulate", "--until", "nan"], "seen nan, wanted a number above 0"),
        (["simulate", "--seeds", "0"], "seen 0, wanted a whole number from 1 to 1000000"),
        (["view", "--port", "65536"], "seen 65536, wanted a whole number from 0 to 65535"),
        (["plot", "map", "x.mcap", "--at", "inf"], "seen inf, wanted a number"),
    ],
)
def test_a_mistyped_word_comes_with_what_was_meant(typed, meant, capsys):
    with pytest.raises(SystemExit) as ended:
        main(typed)
    assert ended.value.code == 2
    assert meant in capsys.readouterr().err


def skin_of(config):
    """The layout of a configuration and its skin's hash."""
    settings = load(config)
    return build_layout(settings, config.parent), skin_hash(settings)


def actions_of(parser):
    """All arguments of a command and of its sub-commands."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from actions_of(command)


def test_every_number_has_bounds():
    numbers = [action.dest for action in actions_of(build_parser()) if action.type in (int, float)]
    assert "hours" in {action.dest for action in actions_of(build_parser())}
    assert numbers == []


def test_a_status_without_broker_waits_for_none(capsys):
    assert main(["status", "--broker", f"mqtt://127.0.0.1:{free_port()}"]) == 1
    assert "no broker listens there" in capsys.readouterr().err
    assert watch.PATIENCE_S < 2


@pytest.mark.parametrize(("options", "status"), [([], 0), (["--strict"], 1)])
def test_a_calibration_of_touched_skin_is_a_warning(options, status, tmp_path, monkeypatch, capsys):
    async def touched(settings, layout, *_, **__):
        calibrator = Calibrator(layout)
        raw, still = (np.full(part.n_taxels, 240, np.uint8) for part in layout.parts)
        for sweep in range(100):
            raw[3] = 240 if sweep < 70 else 150  # a finger comes and stays
            calibrator.add(0, raw, np.full(len(raw), fill_value=True))
            calibrator.add(1, still, np.full(len(still), fill_value=True))
        return calibrator.finish(skin_hash(settings), "2026-01-01T00:00:00+00:00")

    monkeypatch.setattr("skin_host.daemon.calibrate.take_calibration", touched)
    kept = tmp_path / "kept.json"
    assert main(["calibrate", str(DEMO), "--output", str(kept), *options]) == status
    assert kept.exists()
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert "taxel 3 of left_hand" in warning
    assert "repeat" in warning


@pytest.fixture
def looks_at(monkeypatch):
    """Have `skin calibrate` look at untouched skin of which these bytes come, without the first
    `absent` taxels of the hand.
    """

    def give(units, absent=0):
        async def taken(settings, layout, *_, **__):
            calibrator = Calibrator(layout)
            for index, part in enumerate(layout.parts):
                present = np.arange(part.n_taxels) >= absent * (part.name == "left_hand")
                for _ in range(100):
                    calibrator.add(index, np.full(part.n_taxels, units, np.uint8), present)
            return calibrator.finish(skin_hash(settings), "2026-01-01T00:00:00+00:00")

        monkeypatch.setattr("skin_host.daemon.calibrate.take_calibration", taken)

    return give


def test_pads_that_are_received_too_rarely_keep_what_the_file_has(looks_at, tmp_path, capsys):
    kept = tmp_path / "kept.json"
    command = ["calibrate", str(DEMO), "--output", str(kept), "--strict"]
    looks_at(240)
    assert main(command) == 0
    looks_at(230, absent=24)
    assert main(command) == 1
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert "taxels 0-23 of left_hand: received too rarely; they go on as before" in warning
    found = load_calibration(kept, *skin_of(DEMO))
    assert found.usable[:25].all()
    assert found.baseline[24] - found.baseline[23] == pytest.approx(10.0)


def test_pads_that_are_received_too_rarely_and_have_no_zero_are_a_warning(
    looks_at, tmp_path, capsys
):
    looks_at(240, absent=24)
    command = ["calibrate", str(DEMO), "--output", str(tmp_path / "kept.json")]
    assert main(command) == 0
    (warning,) = (line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert "taxels 0-23 of left_hand: received too rarely; not valid until calibrated" in warning
    assert main([*command, "--strict"]) == 1


@pytest.mark.parametrize(
    "arguments",
    [[], ["fly"], ["replay"], ["run"], ["emulate", "nope.toml"], ["view", "--broker", "x"]],
)
def test_a_wrong_command_is_one_line_and_status_2(arguments):
    refused(asked(*arguments), 2)


def test_the_program_ends_with_the_status_of_its_command():
    refused(skin("check", "nope.toml"), 2, "nope.toml")


@pytest.mark.parametrize("module", ["skin_host.cli", "skin_host.files", "skin_host.layout"])
def test_ctrl_c_while_a_command_is_being_imported_shows_no_traceback(module, tmp_path):
    act = "signal.signal(signal.SIGINT, signal.default_int_handler); signal.raise_signal(2)"
    result = skin("check", str(DEMO), **at_import(tmp_path, module, "check", act))
    assert (result.returncode, result.stderr) == (130, "")


def help_of(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    with pytest.raises(SystemExit) as ended:
        main([*command, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_help_is_a_word_too(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["help", "record"])
    assert ended.value.code == 0
    assert "Example: skin record" in capsys.readouterr().out


def test_every_command_has_help_with_an_example(capsys):
    commands = re.findall(r"^    ([a-z]+)", help_of(capsys), flags=re.MULTILINE)
    assert {"run", "calibrate", "check", "replay", "emulate", "demo", "scan"} <= set(commands)
    for command in commands:
        text = help_of(capsys, command)
        assert f"Example: skin {command}" in text
        assert not re.search(r"default:\s+(None|False|\[\])", text)


def test_a_reader_that_leaves_early_is_no_error():
    check = f"{sys.executable} -m skin_host check {DEMO} | head -n 1"
    result = subprocess.run(
        check, shell=True, check=False, capture_output=True, text=True, cwd=ROOT
    )
    assert result.stderr == ""


@pytest.mark.parametrize("stderr", ["2>&-", "2>/dev/full", "2>&1 >/dev/null | true"])
@pytest.mark.parametrize(
    ("words", "status"), [("check nope.toml", 2), ("fly", 2), (f"check {DEMO}", 0)]
)
def test_a_complaint_that_nobody_can_read_changes_no_status(words, status, stderr):
    # The reader of the last one is gone before anything is written.
    command, *reader = stderr.split(" | ")
    wait = "sleep 0.2; " if reader else ""
    line = f"({wait}exec {sys.executable} -m skin_host {words} {command})"
    line = " | ".join([line, *reader]) + "; exit ${PIPESTATUS[0]}"
    ended = subprocess.run(
        ["bash", "-c", line], check=False, cwd=ROOT, capture_output=True, text=True
    )
    assert ended.returncode == status, ended.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", [f"check {DEMO}", "--help", "check --help", "--version"])
def test_results_that_cannot_be_written_are_a_failure(words, unbuffered):
    line = f"{sys.executable} -m skin_host {words} >/dev/full"
    ended = subprocess.run(
        ["bash", "-c", line],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
    )
    refused(ended, 1, "standard output: No space left")


def test_a_report_without_the_package_for_pictures_is_refused_before_its_work(
    monkeypatch, tmp_path
):
    def work(**_):
        pytest.fail("it began its work")

    monkeypatch.setattr("skin_host.evaluation.report.run", work)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    refused(asked("report", "--quick", "--output", str(tmp_path / "r")), 1, "skin-host[plots]")


def test_a_terminal_without_a_character_shows_what_it_stands_for():
    result = skin("check", str(DEMO), PYTHONIOENCODING="ascii")
    assert result.returncode == 0
    assert " cm2\n" in result.stdout
    assert result.stdout.isascii()
    result = skin("check", "n\u00b2\u20ac.toml", PYTHONIOENCODING="ascii")
    refused(result, 2, "n2?.toml")


def test_a_connection_that_ended_is_not_taken_for_a_reader_that_read_enough(monkeypatch):
    def broken(_):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr("skin_host.cli.files._check", broken)
    refused(asked("check", str(DEMO)), 1, "Broken pipe")


@pytest.mark.parametrize(
    "command", [["run"], ["run", "--workers", "2"], ["calibrate"], ["run", "--node", "none"]]
)
def test_what_was_kept_in_the_working_directory_is_not_left_behind(tmp_path, monkeypatch, command):
    """Without its memory a daemon would take what is pressed at its start for the zero."""
    folder = tmp_path / "robots"
    folder.mkdir()
    config = folder / "robot.toml"
    config.write_text(DEMO.read_text() + '[service]\nstate_directory = "state"\n')
    former = tmp_path / "state"
    former.mkdir()
    (former / "demo-main.zeros.json").write_text("{}")
    monkeypatch.chdir(tmp_path)
    result = asked(command[0], "robots/robot.toml", *command[1:])
    refused(result, 2, "service.state_directory", f"mv {former} {folder / 'state'}")
    # With something there, or of another robot, nothing is left behind.
    (former / "demo-main.zeros.json").rename(former / "demo2-main.zeros.json")
    refuse_left_behind(load(config), folder)
    (former / "demo-main.zeros.json").write_text("{}")
    (folder / "state").mkdir()
    (folder / "state" / "demo-main.state.json").write_text("{}")
    refuse_left_behind(load(config), folder)


def test_a_kept_calibration_of_another_skin_stops_the_daemon_before_it_begins(tmp_path):
    kept = tmp_path / "skin-host/demo-main.calibration.json"
    kept.parent.mkdir()
    content = '{"schema":"skin.calibration/1","id":"a","time":"b","robot":"other",'
    content += '"configuration":"0","parts":{}}'
    kept.write_text(content)
    result = skin("run", str(DEMO), XDG_STATE_HOME=str(tmp_path))
    refused(result, 2, str(kept), 'robot "other"', "service.state_directory")
    assert kept.read_text() == content
