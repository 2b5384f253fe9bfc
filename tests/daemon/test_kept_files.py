"""Files of the state directory: damaged ones are set aside, newer ones left alone, all reported."""

import asyncio
import errno
import json
import logging
import os
import socket
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.cli import main
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, Mqtt, changed, load
from skin_host.daemon import metrics
from skin_host.daemon.calibrate import calibration_path, stored_calibration
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.keeper import AGAIN_S
from skin_host.daemon.memory import remembered
from skin_host.daemon.state import NodeState, Zeros, load_kept
from skin_host.errors import NewerFileError, OtherRobotError
from skin_host.files import write_document
from skin_host.layout import PadKind, build_layout
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.calibration import with_gains
from skin_host.processing.calibration.file import save_calibration
from tests.support.broker import Mosquitto, free_port
from tests.support.fault_bench import FaultBench
from tests.support.live import CONFIG, FINGER_N, living
from tests.support.stepped import stepped
from tests.support.waiting import PATIENCE_S, until

STATE = {"schema": "skin.state/1", "disabled": ["left_hand"]}
#: A press that lasts.
PRESSED = [(0.0, 0.0), (0.1, 60.0), (1000.0, 60.0)]
NEWER: list[dict[str, Any]] = [
    STATE | {"schema": "skin.state/2"},
    STATE | {"sensitivity": 3},
    STATE | {"thresholds": {"votes_of_9": 1}},
]


@pytest.mark.parametrize("content", NEWER)
def test_a_state_of_a_newer_version_is_refused_and_left_as_it_is(
    tmp_path: Path, content: dict[str, Any]
) -> None:
    path = tmp_path / "state.json"
    path.write_text(json.dumps(content))
    with pytest.raises(NewerFileError, match="start that version, or move the file away with: mv"):
        load_kept(path, NodeState)
    assert json.loads(path.read_text()) == content
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("content", [b"", b"{", b"[" * 100_000, b'{"schema":"x"}', b"\xff" * 10])
def test_a_damaged_state_is_set_aside_once_and_stays_until_it_is_replaced(
    tmp_path: Path, content: bytes
) -> None:
    """Otherwise the start after one that failed would find nothing damaged."""
    path = tmp_path / "state.json"
    path.write_bytes(content)
    for _ in range(3):
        assert load_kept(path, NodeState) == NodeState()
    first, aside = sorted(tmp_path.iterdir())
    assert first == path
    assert aside.name.startswith("state.json.damaged-")
    assert path.read_bytes() == aside.read_bytes() == content
    write_document(path, NodeState())
    assert aside.read_bytes() == content


def test_a_disk_without_permissions_keeps_files_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As FAT of a memory card does."""

    def no_modes(path: Path, *_: object) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(path))

    monkeypatch.setattr(os, "chmod", no_modes)
    path = tmp_path / "state.json"
    write_document(path, NodeState(disabled=["left_hand"]))
    assert load_kept(path, NodeState).disabled == ["left_hand"]
    assert list(tmp_path.iterdir()) == [path]


def pressed_hand() -> Scene:
    """The hand is pressed from 4 s on."""
    press = Probe(
        part="left_hand", at=Place(triangle=4), diameter_mm=10, pressure_kpa=PRESSED, start_s=4.0
    )
    return Scene(probe=[press], quiet=True)


@pytest.fixture
def kept(calibrated: FaultBench, tmp_path: Path) -> tuple[Any, Any, Path]:
    """Settings, layout and the file of the robot's calibration."""
    settings = changed(load(CONFIG), {"service.state_directory": str(tmp_path)})
    layout = build_layout(settings, CONFIG.parent)
    path = calibration_path(settings, "main")
    assert calibrated.engine.calibration is not None
    save_calibration(path, calibrated.engine.calibration, layout)
    return settings, layout, path


def test_a_calibration_of_another_robot_is_refused(kept: tuple[Any, Any, Path]) -> None:
    settings, layout, path = kept
    assert stored_calibration(settings, layout, "main") is not None
    path.write_text(path.read_text().replace('"robot": "demo"', '"robot": "other"'))
    with pytest.raises(OtherRobotError, match=r'of robot "other", this is robot "demo"; give each'):
        stored_calibration(settings, layout, "main")


def test_a_calibration_of_a_newer_version_is_refused_and_a_damaged_one_set_aside(
    kept: tuple[Any, Any, Path],
) -> None:
    settings, layout, path = kept
    whole = path.read_text()
    for newer in (
        whole.replace("skin.calibration/1", "skin.calibration/2"),
        whole.replace('"robot"', '"colour": 1,\n "robot"'),
    ):
        path.write_text(newer)
        with pytest.raises(NewerFileError):
            stored_calibration(settings, layout, "main")
        assert path.read_text() == newer
    path.write_text(whole[:1000])
    assert stored_calibration(settings, layout, "main") is None
    first, aside = sorted(path.parent.iterdir())
    assert first == path
    assert ".damaged-" in aside.name
    assert path.read_text() == aside.read_text() == whole[:1000]


@pytest.mark.parametrize("command", ["run", "calibrate"])
def test_no_command_overwrites_a_newer_calibration(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "demo-main.calibration.json"
    path.write_text('{"schema":"skin.calibration/2"}')
    config = tmp_path / "robot.toml"
    config.write_text(CONFIG.read_text() + f'\n[service]\nstate_directory = "{tmp_path}"\n')
    assert main([command, str(config)]) == 2
    assert "of a newer version" in capsys.readouterr().err
    assert path.read_text() == '{"schema":"skin.calibration/2"}'


@stepped
async def test_what_could_not_be_kept_is_answered_and_a_fault_until_it_is(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    blocked = tmp_path / "state"
    blocked.write_text("a file where a folder is wanted")
    async with living(can_bus_settings, blocked, clock=clock) as live:
        handle = live.daemon.control.handle
        told = await live.until("state_not_kept")
        assert ("state_not_kept", "calibration") in told
        assert (await handle("calibrate", b'{"seconds":0.3}'))["kept"] is False
        assert (await handle("thresholds", b'{"reset":true}'))["kept"] is False
        assert ("state_not_kept", "state") in live.faults()
        blocked.unlink()
        assert (await handle("calibrate", b'{"seconds":0.3}'))["kept"] is True
        assert (await handle("thresholds", b'{"reset":true}'))["kept"] is True
        assert not {code for code, _ in live.faults()} & {"state_not_kept"}


async def test_a_metrics_port_in_use_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(metrics, "RETRY_S", 0.01)
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):
        serving = asyncio.create_task(metrics.serve(port, dict))
        await until(lambda: "no metrics" in caplog.text)
        await asyncio.sleep(0.1)
    said = [r for r in caplog.records if r.levelno >= logging.WARNING]
    assert len(said) == 1

    async def answers() -> bool:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
        except OSError:
            return False
        writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
        found = await reader.read()
        writer.close()
        return found.startswith(b"HTTP/1.0 200")

    async with asyncio.timeout(PATIENCE_S):
        while not await answers():  # noqa: ASYNC110  # the port tells nobody
            await asyncio.sleep(0.05)
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)


async def test_a_password_that_comes_late_is_read_then(
    mosquitto: Mosquitto, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    keys = Mqtt(host=mosquitto.host, port=mosquitto.port, username="skin", password_file="password")
    async with Publisher(keys, "robot", folder=tmp_path) as publisher:
        await until(lambda: "No such file" in publisher.counters.last_error)
        (tmp_path / "password").write_text("sesame")
        await until(lambda: publisher.counters.connected)
    assert "Traceback" not in caplog.text
    assert "sesame" not in caplog.text


@stepped
async def test_what_was_pressed_when_its_board_was_zeroed_is_in_a_file_at_once(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """A crash a moment later must not make a pressed taxel look untouched."""
    async with living(can_bus_settings, tmp_path, scene=pressed_hand(), clock=clock) as live:
        engine = live.daemon.engine
        await live.wait(lambda: bool(engine.zeros.at_risk(touched=True).any()))
        touched = np.flatnonzero(engine.zeros.at_risk(touched=True))  # the hand begins at 0
        file = tmp_path / "demo-main.zeros.json"
        assert not file.exists()
        before = engine.ledger.rezeros.sum()
        configuring = asyncio.create_task(live.daemon.configure())
        await live.wait(lambda: engine.ledger.rezeros.sum() > before)
        await clock.sleep(0.2)
        assert set(json.loads(file.read_bytes())["unknown"]["left_hand"]) >= set(touched.tolist())
        await configuring


def test_baselines_of_another_skin_are_not_used(kept: tuple[Any, Any, Path]) -> None:
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    hand = layout.part("left_hand").n_taxels
    arm = layout.part("left_forearm").n_taxels
    zeros = Zeros(
        calibration=calibration.id,
        baselines={"left_hand": [7.0] * hand, "left_forearm": [7.0] * (arm - 1), "tail": [7.0]},
    )
    write_document(path.with_name("demo-main.zeros.json"), zeros)
    pipeline = Daemon(settings, layout, calibration=calibration).engine.pipeline
    assert pipeline is not None
    part = layout.part("left_hand")
    mine = np.zeros(layout.n_taxels, np.bool_)
    mine[part.start : part.stop] = True
    assert (pipeline.baseline == np.where(mine, 7.0, calibration.baseline)).all()


def doubted(daemon: Daemon) -> list[int]:
    """Numbers of the taxels whose zero is not known."""
    return np.flatnonzero(daemon.engine.zeros.at_risk(touched=False)).tolist()


def test_zeros_that_are_not_known_are_in_doubt_from_the_start(kept: tuple[Any, Any, Path]) -> None:
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    arm = layout.part("left_forearm")
    beyond = [-1, arm.n_taxels]  # of a skin that was larger
    zeros = Zeros(
        calibration=calibration.id, unknown={"left_forearm": [3, 17, *beyond], "tail": [1]}
    )
    file = path.with_name("demo-main.zeros.json")
    write_document(file, zeros)
    daemon = Daemon(settings, layout, calibration=calibration)
    assert doubted(daemon) == [arm.start + 3, arm.start + 17]
    # A later calibration has measured them.
    written = "2000-01-01T00:00:00+00:00"
    older = Zeros(calibration="an older one", unknown={"left_forearm": [3]}, written=written)
    write_document(file, older)
    assert doubted(Daemon(settings, layout, calibration=calibration)) == []


def stuck(daemon: Daemon) -> list[int]:
    """Numbers of the stuck taxels."""
    return np.flatnonzero(daemon.engine.stuck()).tolist()


@pytest.mark.parametrize("calibration_id", ["", "another"])
def test_pads_that_were_stuck_are_so_from_the_start(
    kept: tuple[Any, Any, Path], calibration_id: str
) -> None:
    """A chip's fault has nothing to do with which calibration is in use."""
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    arm = layout.part("left_forearm")
    zeros = Zeros(
        calibration=calibration_id or calibration.id,
        stuck={"left_forearm": [3, 17, -1, arm.n_taxels], "tail": [1]},
        written="2000-01-01T00:00:00+00:00",
    )
    write_document(path.with_name("demo-main.zeros.json"), zeros)
    daemon = Daemon(settings, layout, calibration=calibration)
    assert stuck(daemon) == [arm.start + 3, arm.start + 17]
    assert doubted(daemon) == []


@pytest.mark.parametrize("written", ["9999-12-31T00:00:00+00:00", "", "x", "2000-01-01T00:00:00"])
def test_a_calibration_that_was_put_back_ends_no_doubt(
    kept: tuple[Any, Any, Path], written: str
) -> None:
    """It was taken before the taxel was touched when its board was zeroed; or with the curves of a
    recording came its zero."""
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    zeros = Zeros(calibration="a later one", unknown={"left_forearm": [3]}, written=written)
    write_document(path.with_name("demo-main.zeros.json"), zeros)
    arm = layout.part("left_forearm")
    daemon = Daemon(settings, layout, calibration=calibration)
    assert doubted(daemon) == [arm.start + 3]


@pytest.mark.parametrize("content", [b"", b"{", b'{"schema":"skin.zeros/1"}', b'{"unknown":5}'])
def test_without_the_file_of_unknown_zeros_all_are_in_doubt(
    kept: tuple[Any, Any, Path], content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    """It is there because some were touched: whoever damages it must not make them untouched."""
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    assert doubted(Daemon(settings, layout, calibration=calibration)) == []
    path.with_name("demo-main.zeros.json").write_bytes(content)
    daemon = Daemon(settings, layout, calibration=calibration)
    wanted = np.flatnonzero(calibration.usable & (layout.pad_kind == PadKind.PRESSURE))
    assert set(doubted(daemon)) >= set(wanted.tolist())
    if content[:2] != b'{"' or b"schema" not in content:
        assert "skin command calibrate" in caplog.text
    # One that is being taken anyway needs nothing of it.
    assert doubted(Daemon(settings, layout)) == []


def test_baselines_of_an_older_calibration_are_not_used(kept: tuple[Any, Any, Path]) -> None:
    settings, layout, path = kept
    calibration = stored_calibration(settings, layout, "main")
    assert calibration is not None
    hand = layout.part("left_hand").n_taxels
    zeros = Zeros(calibration="an older one", baselines={"left_hand": [7.0] * hand})
    write_document(path.with_name("demo-main.zeros.json"), zeros)
    pipeline = Daemon(settings, layout, calibration=calibration).engine.pipeline
    assert pipeline is not None
    assert (pipeline.baseline == calibration.baseline).all()


@stepped
async def test_a_daemon_that_ends_keeps_the_baselines_that_it_used(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    file = tmp_path / "demo-main.zeros.json"
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well()
        daemon = live.daemon
        assert not file.exists()  # the calibration has just measured them
    kept, pipeline = load_kept(file, Zeros), daemon.engine.pipeline
    assert pipeline is not None
    assert set(kept.baselines) == {part.name for part in daemon.layout.parts}
    for part in daemon.layout.parts:
        used = pipeline.baseline[part.start : part.stop]
        assert np.abs(np.array(kept.baselines[part.name]) - used).max() < 0.01


@stepped
async def test_zeros_that_cannot_be_kept_are_a_fault_until_they_are(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "demo-main.zeros.json"
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well()
        file.mkdir()
        (file / "in the way").touch()
        await live.daemon.configure([1])
        assert ("state_not_kept", "zeros") in await live.until("state_not_kept")
        await clock.sleep(5.0)
        said = [r.getMessage() for r in caplog.records if "zeros not kept" in r.getMessage()]
        assert len(said) == 1, said
        (file / "in the way").unlink()
        file.rmdir()
        await live.wait(lambda: ("state_not_kept", "zeros") not in live.faults())
        assert set(load_kept(file, Zeros).baselines) == {p.name for p in live.daemon.layout.parts}
        # Nothing is written again without need.
        written = file.stat().st_ino
        await clock.sleep(5.0)
        assert file.stat().st_ino == written


@stepped
async def test_what_is_pressed_is_in_doubt_only_if_the_daemon_ends_then(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    file = tmp_path / "demo-main.zeros.json"
    async with living(can_bus_settings, tmp_path, scene=pressed_hand(), clock=clock) as live:
        engine = live.daemon.engine
        await live.wait(lambda: bool(engine.zeros.at_risk(touched=True).any()))
        await live.daemon.configure([1])  # the arm's, which is not pressed
        await clock.sleep(3.0)
        assert load_kept(file, Zeros).unknown == {}
        touched = np.flatnonzero(
            engine.zeros.at_risk(touched=True)
        ).tolist()  # the hand begins at 0
        assert touched
    assert set(load_kept(file, Zeros).unknown["left_hand"]) >= set(touched)


async def test_of_two_writes_of_the_zeros_the_newer_one_stays_however_long_the_first_one_takes(
    can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that stalls had the first one take the name after the daemon had ended."""
    stalls, goes_on = threading.Event(), threading.Event()

    def stall(path: Path, document: object) -> None:
        if not stalls.is_set():
            stalls.set()
            goes_on.wait(PATIENCE_S)
        write_document(path, document)

    async with living(can_bus_settings, tmp_path) as live:
        daemon = live.daemon
        monkeypatch.setattr("skin_host.daemon.keeper.write_document", stall)
        await daemon.configure()  # gives all boards other zeros
        await until(stalls.is_set)
        ending = asyncio.create_task(daemon.keeper.end())
        await asyncio.sleep(0.1)
        assert not ending.done()
        assert not (tmp_path / "demo-main.zeros.json").exists()
        daemon.engine.zeros.doubt(np.arange(daemon.layout.n_taxels) == 1)
        goes_on.set()
        await ending
        assert load_kept(tmp_path / "demo-main.zeros.json", Zeros).unknown == {"left_hand": [1]}


@stepped
async def test_zeros_belong_to_the_calibration_that_is_kept_while_a_newer_one_is_not(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is nearly full takes the smaller file alone. The next start would judge boards
    that still send by zeros of before, and not know what presses a pad that was zeroed in a press.
    """

    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        await live.until_well()
        daemon, finger = live.daemon, live.finger()
        kept = daemon.engine.calibration
        finger.press(FINGER_N / 4)  # bytes do not end when it is lifted
        await live.wait(lambda: bool(daemon.engine.zeros.touched().any()))
        await daemon.configure()
        await live.wait(lambda: bool(doubted(daemon)))
        pressed = np.array(doubted(daemon))
        finger.press(0.0)
        await clock.sleep(60.0)  # foam recovers
        monkeypatch.setattr("skin_host.daemon.keeper.save_calibration", refuse)
        await daemon.calibrate(2.0)
        await clock.sleep(3.0)
        crashed = tmp_path / "demo-main.zeros.json"
        after_a_crash = crashed.read_bytes()
    crashed.write_bytes(after_a_crash)
    memory = remembered(daemon.settings, daemon.layout, "main")
    assert kept is not None and memory.calibration is not None
    assert memory.calibration.id == kept.id
    next_one = Daemon(daemon.settings, daemon.layout, memory=memory)
    assert next_one.engine.pipeline is not None and daemon.engine.pipeline is not None
    baseline = daemon.engine.pipeline.baseline[pressed]
    assert (baseline < -5.0).any()
    np.testing.assert_allclose(next_one.engine.pipeline.baseline[pressed], baseline, atol=1.5)


@pytest.mark.parametrize("configuration", ["other", "same", "damaged"])
def test_a_calibration_of_another_configuration_is_kept_when_a_new_one_takes_its_name(
    kept: tuple[Any, Any, Path],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    tmp_path: Path,
    configuration: str,
) -> None:
    """It may hold curves that were fitted. What was touched is known all the same."""
    settings, layout, path = kept
    found = stored_calibration(settings, layout, "main")
    assert found is not None
    zeros = Zeros(calibration=found.id, touched={"left_hand": [7]}, parts=["left_hand"])
    write_document(path.with_name("demo-main.zeros.json"), zeros)
    before = path.read_text()
    if configuration == "other":
        before = before.replace(f'"{found.configuration}"', '"0123456789ab"')
    elif configuration == "damaged":
        before = before[:1000]
    path.write_text(before)
    seen: list[Any] = []

    async def take(*_: Any, touched: Any) -> Any:
        seen.append(touched)
        return found

    monkeypatch.setattr("skin_host.daemon.calibrate.take_calibration", take)
    config = tmp_path / "robot.toml"
    more = f'\n[mqtt]\nport = 1\n[service]\nstate_directory = "{tmp_path}"\n'
    config.write_text(CONFIG.read_text() + more)
    assert main(["calibrate", str(config)]) == 0
    assert stored_calibration(settings, layout, "main") is not None
    assert seen == [{"left_hand": [7]}]
    former = [one for one in tmp_path.iterdir() if ".former-" in one.name]
    assert [one.read_text() for one in former] == ([before] if configuration == "other" else [])
    assert ("fit them again" in caplog.text) == (configuration == "other")


@stepped
async def test_a_daemon_keeps_the_calibration_of_another_configuration_too(
    clock: SteppedClock, can_bus_settings: Bus, kept: tuple[Any, Any, Path]
) -> None:
    *_, path = kept
    configuration = json.loads(path.read_text())["configuration"]
    before = path.read_text().replace(f'"{configuration}"', '"0123456789ab"')
    path.write_text(before)
    async with living(can_bus_settings, path.parent, clock=clock):
        (former,) = [one for one in path.parent.iterdir() if ".former-" in one.name]
        assert former.read_text() == before
        assert json.loads(path.read_text())["configuration"] == configuration


@stepped
async def test_gains_that_were_fitted_while_the_disk_was_full_outlive_the_next_try_to_keep(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So do those of a disk that was mounted after the daemon had found an empty folder."""
    with monkeypatch.context() as full:
        full.setattr("skin_host.daemon.keeper.save_calibration", refuse)
        async with living(can_bus_settings, tmp_path, clock=clock) as live:
            daemon = live.daemon
            await live.until("state_not_kept")
            used = daemon.engine.calibration
            assert used is not None
            gain = np.linspace(0.5, 2.0, daemon.layout.n_taxels).round(6)
            fitted = with_gains(replace(used, baseline=used.baseline + 3.0), gain, used.bend)
            path = calibration_path(daemon.settings, "main")
            save_calibration(path, fitted, daemon.layout)
            full.undo()
            await live.wait(lambda: not daemon.keeper.unkept)
    kept = stored_calibration(daemon.settings, daemon.layout, "main")
    assert kept is not None
    np.testing.assert_array_equal(kept.gain, gain)
    np.testing.assert_allclose(kept.baseline, used.baseline, atol=1e-6)
    memory = remembered(daemon.settings, daemon.layout, "main")
    assert memory.zeros.are_of(kept.id)


@stepped
async def test_no_later_try_to_keep_replaces_the_calibration_of_a_newer_version(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = '{"schema":"skin.calibration/2"}'
    with monkeypatch.context() as full:
        full.setattr("skin_host.daemon.keeper.save_calibration", refuse)
        async with living(can_bus_settings, tmp_path, clock=clock) as live:
            await live.until("state_not_kept")
            path = calibration_path(live.daemon.settings, "main")
            path.write_text(newer)
            full.undo()
            await clock.sleep(2 * AGAIN_S)
            assert path.read_text() == newer
            assert "of a newer version" in live.daemon.keeper.unkept["calibration"]
            path.unlink()
            await live.wait(lambda: not live.daemon.keeper.unkept)


@stepped
async def test_a_calibration_of_another_configuration_has_one_second_name_however_often_it_is_tried(
    clock: SteppedClock, can_bus_settings: Bus, kept: tuple[Any, Any, Path]
) -> None:
    *_, path = kept
    configuration = json.loads(path.read_text())["configuration"]
    path.write_text(path.read_text().replace(f'"{configuration}"', '"0123456789ab"'))
    with pytest.MonkeyPatch.context() as full:
        full.setattr("skin_host.daemon.keeper.save_calibration", refuse)
        async with living(can_bus_settings, path.parent, clock=clock):
            await clock.sleep(5 * AGAIN_S)
    assert len([one for one in path.parent.iterdir() if ".former-" in one.name]) == 1


@stepped
async def test_a_calibration_that_may_not_be_read_is_not_lost_to_the_one_that_is_taken_without_it(
    clock: SteppedClock, can_bus_settings: Bus, kept: tuple[Any, Any, Path]
) -> None:
    """Somebody has put it there as root."""
    *_, path = kept
    path.chmod(0)
    if os.access(path, os.R_OK):
        pytest.skip("root may read everything")
    was = path.stat().st_ino
    async with living(can_bus_settings, path.parent, clock=clock):
        (former,) = [one for one in path.parent.iterdir() if ".former-" in one.name]
        assert former.stat().st_ino == was
        assert path.stat().st_ino != was


def refuse(path: Path, *_: object) -> None:
    """Write to a full disk."""
    raise OSError(errno.ENOSPC, "No space left on device", str(path))
