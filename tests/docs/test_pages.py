"""The pages of the documentation are followed to the letter: files, commands, programs.

Commands run in one process with an emulated robot on python-can's virtual bus. They meet the
test's broker and bus in place of those that the page names, and what lasts is cut short.
"""

import argparse
import asyncio
import os
import re
import shutil
import sqlite3
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

from emulator import faults
from skin_host.cli import build_parser
from skin_host.cli.common import run
from skin_host.mqtt.frames import encode_frame
from skin_host.processing.frame import PressureFrame
from tests.support import programs
from tests.support.broker import Mosquitto, free_port
from tests.support.pages import PAGES, ROOT, Block, Command, blocks, commands
from tests.support.waiting import PATIENCE_S
from tests.support.world import SAMPLES, World

WHILE_S = 0.3
SIMULATED_S = 5.0
FOLLOWED = [
    page
    for page in PAGES
    if any(command.words[0] == "skin" for block in blocks(page) for command in commands(block))
]
#: Exit statuses but 0 that tell something true: not every part is well this very moment.
TELLING = {"status": {0, 1}}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    program = programs.find("mosquitto")
    if program is None:
        pytest.skip("mosquitto is not installed")
    folder = tmp_path_factory.mktemp("world")
    broker = Mosquitto(program, tmp_path_factory.mktemp("broker"))
    broker.start()
    made = World(folder, tmp_path_factory.mktemp("state"), broker)
    made.write_recordings()
    if SAMPLES.exists():
        made.write_imports()
    for name in ("config", "docs", "examples"):
        (folder / name).symlink_to(ROOT / name)
    with made.alive():
        yield made
    broker.kill()


@pytest.fixture
def here(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fresh folder with everything in it, and no other place to write to."""
    folder = tmp_path / "here"
    shutil.copytree(world.folder, folder, symlinks=True)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    monkeypatch.setattr("skin_host.cli.watch.run", partial(run, duration_s=WHILE_S))
    monkeypatch.setattr("skin_host.cli.operate.set_up_logging", lambda *_: None)
    matplotlib.use("agg")
    return folder


@pytest.mark.parametrize("page", FOLLOWED)
def test_the_commands_of_a_page_can_be_followed(
    page: str, world: World, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    followed = 0
    for block in blocks(page):
        _write_file(block)
        for command in commands(block):
            if command.words[0] != "skin":
                continue
            arguments = build_parser().parse_args(command.words[1:])
            if missing := _missing(arguments):
                assert not SAMPLES.exists(), f"{page}:{command.line}: {missing} are not there"
                continue
            _follow(page, command, arguments, world, capsys)
            followed += 1
    if not followed:
        pytest.skip(f"{SAMPLES} is not here")


def _missing(arguments: argparse.Namespace) -> list[str]:
    """Files that a command reads and that nobody has made."""
    given = vars(arguments)
    read = [given.get(name) for name in ("config", "log", "recording", "scene")]
    read += given.get("files", [])
    return [str(path) for path in read if path is not None and not _here(path).exists()]


def _here(path: Path) -> Path:
    return Path("robot.toml") if path.is_relative_to("/etc/skin-host") else path


def _follow(
    page: str,
    command: Command,
    arguments: argparse.Namespace,
    world: World,
    capsys: pytest.CaptureFixture[str],
) -> None:
    capsys.readouterr()
    _adapt(arguments, world)
    status = arguments.run(arguments)
    seen = capsys.readouterr()
    where = f"{page}:{command.line}: {' '.join(command.words)}"
    assert status in TELLING.get(arguments.command, {0}), f"{where}: {seen.err}"
    for line in command.output:
        assert line in seen.out.splitlines(), where


def _adapt(arguments: argparse.Namespace, world: World) -> None:
    """Put the test's broker, bus and times in place of the page's."""
    given: dict[str, Any] = vars(arguments)
    if given.get("broker") or (given["command"] == "record" and not given["config"]):
        arguments.broker = world.broker
    if "config" in given and given["config"] is not None:
        arguments.config = _here(arguments.config)
    for name in ("duration", "seconds"):
        if name in given:
            setattr(arguments, name, WHILE_S)
    if "until" in given:
        arguments.until = SIMULATED_S
    match given["command"]:
        case "run" | "calibrate":
            arguments.config = world.bare
        case "emulate":
            arguments.config = world.empty
        case "scan":
            arguments.interface, arguments.channel = "virtual", world.channel("bare")
        case "listen":
            arguments.count = 1
            arguments.moves = True  # a press that lasts begins only once
        case "view":
            arguments.port = free_port()
        case "replay":
            arguments.speed = 100.0
            if arguments.onto == "broker" and arguments.config is not None:
                arguments.config = world.empty  # another robot than the one that lives
        case "record":
            arguments.file = arguments.file.with_stem(
                f"{arguments.file.stem}-{os.urandom(2).hex()}"
            )


def _write_file(block: Block) -> None:
    """What the text before a block of TOML calls a file becomes one."""
    named = re.search(r"saved\s+as\s+`([^`]+)`:\s*$", block.before)
    if block.language == "toml" and named:
        Path(named[1]).write_text(block.text)


def _programs(page: str) -> dict[str, Any]:
    """Write the files and run the programs of a page; return what they left."""
    left: dict[str, Any] = {}
    for block in blocks(page):
        _write_file(block)
        if block.language == "python":
            exec(compile("\n" * block.line + block.text, page, "exec"), left)
    return left


@pytest.fixture
def extended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What docs/extending.md leaves behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(faults, "KINDS", dict(faults.KINDS))
    return _programs("docs/extending.md")


def test_extending_adds_a_layout_a_model_and_a_fault(extended: dict[str, Any]) -> None:
    assert extended["layout"].n_taxels == 24
    assert (extended["begin"].event, extended["begin"].taxels) == ("begin", [17])
    np.testing.assert_allclose(extended["lost_kpa"], [10 * -np.expm1(-3.0), 0.0], atol=1e-9)
    assert not extended["without"].valid.any()
    assert extended["again"].valid.all()


def test_the_fault_of_the_page_is_listed_and_mended_as_all_others(extended: dict[str, Any]) -> None:
    robot, line = extended["robot"], faults.parse("loose_plug board=pad")
    assert robot.faults_on == []
    for _ in range(2):
        robot.inject(line)
    robot.inject(faults.parse("board_reset board=pad"))
    assert robot.faults_on == [line, line]
    assert robot.mend(line)
    assert robot.faults_on == []


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_the_model_of_the_page_keeps_the_promises_of_all_models(
    extended: dict[str, Any], wrong: float
) -> None:
    ours, theirs = (extended["OneMode"](2, beta=0.2, tau_s=10.0) for _ in range(2))
    for _ in range(5):
        ours.step([30.0, 10.0], 0.1)
        theirs.step([30.0, 10.0], 0.1)
    np.testing.assert_array_equal(ours.step([wrong, 10.0], 0.1), theirs.step([30.0, 10.0], 0.1))
    np.testing.assert_array_equal(
        ours.step([30.0, 10.0], -1.0), theirs.step([30.0, 10.0], float("nan"))
    )
    ours.reset(np.array([True, False]))
    assert (ours.step([0.0, 10.0], 0.1) == 0).tolist() == [True, False]


async def test_the_sink_of_the_page_keeps_touches(
    extended: dict[str, Any], world: World, tmp_path: Path
) -> None:
    database = tmp_path / "touches.db"
    keeping = asyncio.create_task(extended["keep_touches"](world.broker, database))
    rows = sqlite3.connect(database)
    # A noisy pad of the other part may touch, too.
    query = "select * from touch where part = 'left_hand' and event != 'end' and force_n > 0"
    async with asyncio.timeout(PATIENCE_S):
        while not (keeping.done() or _rows(rows, query)):  # noqa: ASYNC110 (a database tells nobody)
            await asyncio.sleep(0.1)
    assert not keeping.done(), keeping.exception()
    keeping.cancel()
    await asyncio.gather(keeping, return_exceptions=True)
    rows.close()


def _rows(database: sqlite3.Connection, query: str) -> list[Any]:
    try:
        return database.execute(query).fetchall()
    except sqlite3.OperationalError:  # the table has not been made yet
        return []


def test_a_frame_is_decoded_by_what_subscribers_are_told() -> None:
    decode = _programs("docs/subscribers.md")["pressures_kpa"]
    n = 13
    frame = PressureFrame(
        "palm",
        1,
        2,
        np.zeros(n, np.uint8),
        np.arange(n) * 1.5,
        np.zeros(n, np.bool_),
        np.arange(n) != 3,
        np.zeros(n, np.bool_),
    )
    kpa = decode(encode_frame(frame))
    assert kpa[3] is None
    assert kpa[12] == pytest.approx(18.0)


async def test_the_typed_subscriber_of_the_page_tells_frames(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    watching = asyncio.create_task(
        _programs("docs/subscribers.md")["watch"](world.broker, "left_hand")
    )
    seen = ""
    async with asyncio.timeout(PATIENCE_S):
        while "kPa 0 missed" not in seen:
            await asyncio.sleep(0.1)
            seen += capsys.readouterr().out
    watching.cancel()
    await asyncio.gather(watching, return_exceptions=True)


def test_a_recording_is_read_by_the_program_of_its_page(
    here: Path, world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = build_parser().parse_args(["export", "grasp.mcap", "grasp.npz"])
    assert arguments.run(arguments) == 0
    left = _programs("docs/recordings.md")
    assert left["kpa"].shape[1] == 108


def test_scenes_are_scripted_as_their_page_says(here: Path) -> None:
    left: dict[str, Any] = {}
    (program,) = [block for block in blocks("docs/scenes.md") if block.language == "python"]
    exec(compile(program.text, "docs/scenes.md", "exec"), left)
    assert left["truth_kpa"].max() > 0
    left["mend"]()
