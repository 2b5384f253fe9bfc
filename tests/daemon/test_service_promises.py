"""Full disks, damaged state, jumping clocks, systemd's socket, the metrics page."""

import asyncio
import logging
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.bus.logs import read_channels
from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.clock import SYSTEM, SteppedClock
from skin_host.config.settings import Bus, TouchSettings, changed
from skin_host.daemon import metrics, service
from skin_host.daemon.state import NodeState, Thresholds, load_kept
from skin_host.errors import BusError, RequestError
from skin_host.files import write_document
from skin_host.health import LINE_S, FaultLog
from skin_host.importing import configuration_text
from skin_host.recording.capture import FrameRecorder, candump_lines
from tests.support.fault_bench import FaultBench
from tests.support.live import living
from tests.support.stepped import stepped


def test_what_operators_changed_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "a" / "state.json"
    state = NodeState(disabled=["left_hand"], thresholds=Thresholds(margin_units=0.0, votes_of_3=3))
    write_document(path, state)
    assert load_kept(path, NodeState) == state
    touch = state.thresholds.over(TouchSettings())
    assert (touch.margin_units, touch.votes_of_3) == (0.0, 3)
    assert touch.hysteresis_units == TouchSettings().hysteresis_units


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"schema":"x"}', b"\xff" * 10])
def test_damaged_state_is_an_unchanged_one(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "state.json"
    path.write_bytes(content)
    assert load_kept(path, NodeState) == NodeState()
    assert "damaged" in caplog.text


@stepped
async def test_commands_work_and_say_so_where_nothing_can_be_written(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("a file where a folder is wanted")
    async with living(can_bus_settings, blocked / "state", clock=clock) as live:
        handle = live.daemon.control.handle
        await clock.sleep(0.3)  # the first calibration is still being kept
        usual_kpa = (await handle("thresholds", b"{}"))["decides_kpa"]["left_hand"]
        answer = await handle("thresholds", b'{"set":{"margin_units":5}}')
        assert answer["decides_kpa"]["left_hand"] > usual_kpa > 0.0
        assert answer["kept"] is False
        assert answer["touch"]["margin_units"] == 5.0
        assert (await handle("disable", b'{"part":"left_hand"}'))["disabled"] == ["left_hand"]
        assert live.daemon.records()["left_hand"]["state"] == "disabled"
        await handle("enable", b'{"part":"left_hand"}')
        await handle("calibrate", b'{"seconds":0.3,"part":"left_hand"}')
        with pytest.raises(Exception, match="cannot be written"):
            await handle("record", b"{}")
        with pytest.raises(Exception, match="no part"):
            await handle("disable", b'{"part":"tail"}')
        await live.until_well(but=frozenset({"state_not_kept"}))


@stepped
async def test_thresholds_that_no_reading_reaches_are_refused(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        handle = live.daemon.control.handle
        before = await handle("thresholds", b"{}")
        for key in ("margin_units", "minimum_threshold_units"):
            with pytest.raises(RequestError, match=r"no press would be felt by taxels 0-"):
                await handle("thresholds", b'{"set":{"%s":255}}' % key.encode())
        assert await handle("thresholds", b"{}") == before
        await handle("thresholds", b'{"set":{"margin_units":40}}')


@stepped
async def test_taxels_of_which_no_reading_reaches_the_threshold_are_not_valid(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    kept = NodeState(thresholds=Thresholds(margin_units=255.0))
    write_document(tmp_path / "demo-main.state.json", kept)
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        daemon = live.daemon
        health = daemon.records()["left_hand"]
        assert health["valid_taxels"] == 0
        assert len(health["taxel_verdicts"]["unreached"]) == health["taxels"]
        assert ("taxel_unreached", "left_hand") in live.faults()
        daemon.set_thresholds(Thresholds())
        await live.until_well()
        assert daemon.records()["left_hand"]["valid_taxels"] == health["taxels"]


@stepped
async def test_an_empty_request_changes_nothing(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        handle = live.daemon.control.handle
        calibration = live.daemon.engine.calibration
        for name in ("calibrate", "configure", "disable", "raw", "record", "reload"):
            with pytest.raises(RequestError, match="an empty request is refused"):
                await handle(name, b"")
        assert live.daemon.engine.calibration is calibration
        assert await handle("status", b"")


@stepped
async def test_a_recording_can_be_replayed(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        handle = live.daemon.control.handle
        await handle("record", b'{"file":"run.log","seconds":30}')
        await clock.sleep(0.5)
        answer = await handle("stop_recording", b"{}")
    assert answer["lost"] == 0
    path = tmp_path / "recordings" / "run.log"
    assert sum(len(batch) for _, batch in read_channels(path)) == answer["frames"] > 100


async def test_a_recording_ends_by_its_size(tmp_path: Path) -> None:
    ids, data = encode_sweep(
        14, np.arange(16), np.zeros((16, 12), np.uint8), np.zeros(16, np.uint16)
    )
    batch = FrameBatch(ids, np.full(32, 8, np.uint8), data, np.full(32, 10**18))
    assert candump_lines("can0", batch).count(b"\n") == 32
    recorder = FrameRecorder(tmp_path / "x.log", 10.0, 3000)
    for _ in range(4):
        recorder.put("can0", batch)
    recorder.finish()
    await recorder.finished()
    assert recorder.ended == "it reached its 3000 bytes"
    assert (tmp_path / "x.log").stat().st_size == recorder.bytes <= 3000


@pytest.mark.parametrize("jump_s", [-86_400.0, -3.0, 3.0, 86_400.0])
def test_a_clock_that_jumps_costs_a_moment(bench: FaultBench, jump_s: float) -> None:
    bench.t_s += jump_s
    bench.run(1.0)
    assert bench.valid["left_forearm"].sum() == 240
    assert bench.records["left_forearm"]["state"] in ("ok", "warning")
    bench.inject("board_silent", board="hand")
    bench.run(1.0)
    assert not bench.valid["left_hand"].any()
    assert ("board_silent", "hand") in bench.told


def test_faults_are_logged_together_and_rarely(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    fault_log = FaultLog()
    faults = {("board_silent", f"b{k}"): f"board b{k} is silent" for k in range(20)}
    for tenth in range(1200):
        flapping = faults if tenth % 100 < 60 else {}
        fault_log.note(flapping, 100.0 + tenth / 10)
    assert len(caplog.records) <= 120 / LINE_S + 1
    assert "19 more faults" in caplog.records[0].getMessage()
    caplog.clear()
    two = {("board_silent", f"b{k}"): f"board b{k} is silent" for k in range(2)}
    fault_log = FaultLog()
    for second in range(10):
        fault_log.note(two, 100.0 + second)
    assert "one more fault;" in caplog.records[0].getMessage()


def test_systemd_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        service.notify("READY=1")
        assert systemd.recv(100) == b"READY=1"
        service.notify(service.reloading(SYSTEM))
        assert systemd.recv(100).startswith(b"RELOADING=1\nMONOTONIC_USEC=")


@stepped
async def test_the_watchdog_is_fed_by_the_pipeline(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        monkeypatch.setenv("WATCHDOG_USEC", "400000")
        async with living(can_bus_settings, tmp_path / "state", clock=clock):
            heard = await _hear(systemd, 1.5)
            assert heard.count("WATCHDOG=1") >= 5
            assert any(line.startswith("STATUS=") for line in heard)
        assert "STOPPING=1" in _drain(systemd)


def test_a_busy_systemd_holds_nobody_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        for _ in range(2000):
            service.notify("WATCHDOG=1")


async def _hear(systemd: socket.socket, seconds: float) -> list[str]:
    heard: list[str] = []
    for _ in range(round(seconds / 0.05)):
        await asyncio.sleep(0.05)
        heard += _drain(systemd)
    return heard


def _drain(systemd: socket.socket) -> list[str]:
    heard: list[str] = []
    while True:
        try:
            heard += systemd.recv(4096).decode().split("\n")
        except BlockingIOError:
            return heard


async def test_metrics_are_served_on_localhost_alone(
    bench: FaultBench, unused_tcp_port: int
) -> None:
    bench.inject("board_silent", board="hand")
    bench.run(1.0)
    port = unused_tcp_port
    serving = asyncio.create_task(metrics.serve(port, lambda: bench.records))
    try:
        await asyncio.sleep(0.1)
        page = await _get(port, b"GET /metrics HTTP/1.0\r\n\r\n")
        assert 'skin_board_alive{board="hand"} 0' in page
        assert 'skin_valid_taxels{part="left_forearm"} 240' in page
        assert "404" in await _get(port, b"GET /other HTTP/1.0\r\n\r\n")
        assert "405" in await _get(port, b"POST /metrics HTTP/1.0\r\n\r\n")
        assert await _get(port, b"x" * 100_000 + b"\r\n\r\n") == ""
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def _get(port: int, request: bytes) -> str:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        return (await reader.read()).decode()
    except ConnectionError:
        return ""
    finally:
        writer.close()


@stepped
async def test_a_reload_takes_what_it_can_and_refuses_the_rest(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        known, running = daemon.engine.calibration, daemon.settings
        config = tmp_path / "demo.toml"
        daemon._configuration = config
        config.write_text("nonsense")
        with pytest.raises(Exception, match="not TOML"):
            await daemon.reload()
        for key, value in {"boards.hand.address": 9, "mqtt.port": 1884, "robot": "other"}.items():
            config.write_text(configuration_text(changed(running, {key: value})))
            with pytest.raises(Exception, match=rf"{key} changed; that needs a restart"):
                await daemon.reload()
        assert daemon.settings == running
        values = {"processing.touch.margin_units": 7.0, "parts.left_hand.frames": False}
        config.write_text(configuration_text(changed(running, values)))
        await daemon.reload()
        assert daemon.settings.processing.touch.margin_units == 7.0
        assert daemon.engine.touch_only == {0}
        assert daemon.engine.calibration is known
        await live.until_well()


@stepped
async def test_the_log_names_thresholds_that_are_not_those_of_the_configuration(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Otherwise who changes them there sees a reload or a start that changes nothing."""
    caplog.set_level(logging.INFO)
    named = (
        "margin_units = 3: set by an operator, in place of the configuration's; "
        "`skin command thresholds --reset` ends that"
    )

    def lines() -> int:
        return sum(record.getMessage() == named for record in caplog.records)

    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        daemon._configuration = config = tmp_path / "demo.toml"
        await daemon.control.handle("thresholds", b'{"set":{"margin_units":3,"votes_of_3":2}}')
        config.write_text(configuration_text(daemon._configured))
        await daemon.reload()
        assert lines() == 1
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        daemon._configuration = config
        assert lines() == 2
        values = {"processing.touch.margin_units": 3.0}
        config.write_text(configuration_text(changed(daemon._configured, values)))
        await daemon.reload()
        assert lines() == 2


@stepped
async def test_what_is_held_is_held_over_a_reload(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """A set-up of the boards would take it for their zero, and change nothing else: what a board is
    sent changes by a restart only.
    """
    probe = Probe(
        part="left_hand",
        at=Place(triangle=4),
        pressure_kpa=[(0, 0), (0.2, 60), (60, 60)],
        start_s=6,
    )
    scene = Scene(quiet=True, probe=[probe])
    async with living(can_bus_settings, tmp_path / "state", scene=scene, clock=clock) as live:
        daemon = live.daemon
        config = daemon._configuration = tmp_path / "demo.toml"
        values = {"parts.left_hand.foam_mm": 6.0}
        config.write_text(configuration_text(changed(daemon.settings, values)))
        await live.wait(lambda: bool(daemon.engine.zeros.touched().any()))
        await clock.sleep(2.0)
        held = daemon.engine.zeros.touched().copy()
        before = live.daemon.engine.ledger.rezeros.copy()
        await daemon.reload()
        await clock.sleep(3.0)
        assert daemon.settings.parts["left_hand"].foam_mm == 6.0
        assert (daemon.engine.ledger.rezeros == before).all()
        assert all(one.configurations == 1 for one in daemon.link.boards["can0"].records.values())
        assert daemon.engine.zeros.touched()[held].all()
        assert not daemon.engine.zeros.at_risk(touched=False).any()


@stepped
async def test_a_reload_that_fails_in_the_middle_leaves_what_is_in_use(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every change of the thresholds failed after it, until another reload."""
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        running = daemon.settings
        config = daemon._configuration = tmp_path / "demo.toml"
        values = {"processing.touch.margin_units": 7.0}
        config.write_text(configuration_text(changed(running, values)))

        def fail(*_: object, **__: object) -> None:
            raise ValueError("numbers of modes differ")

        with monkeypatch.context() as patched:
            patched.setattr("skin_host.daemon.daemon.Engine", fail)
            with pytest.raises(RequestError, match="cannot be used: ValueError"):
                await daemon.reload()
        assert daemon.settings == running
        daemon.set_thresholds(Thresholds(votes_of_3=3))
        assert daemon.settings.processing.touch.margin_units == TouchSettings().margin_units


@stepped
async def test_subscribers_know_where_taxels_are_by_a_reload_while_a_bus_is_down(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        daemon = live.daemon
        config = daemon._configuration = tmp_path / "demo.toml"
        values = {"parts.left_hand.foam_mm": 6.0}
        config.write_text(configuration_text(changed(daemon.settings, values)))

        async def down(_: object) -> None:
            raise BusError("can0 is down")

        monkeypatch.setattr(daemon.link, "set_up", down)
        before = daemon.publisher._info
        await daemon.reload()
        assert daemon.publisher._info is not before
        assert daemon.publisher._info.configuration == daemon._info().configuration


@stepped
async def test_thresholds_are_reset_and_then_set_by_one_request(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path / "state", clock=clock) as live:
        handle = live.daemon.control.handle
        await handle("thresholds", b'{"set":{"votes_of_3":3}}')
        answer = await handle("thresholds", b'{"reset":true,"set":{"margin_units":3}}')
        assert answer["touch"]["margin_units"] == 3.0
        assert answer["touch"]["votes_of_3"] == TouchSettings().votes_of_3


def test_lines_reach_the_journal_with_their_priority() -> None:
    formatter = service.JournalFormatter("%(message)s")
    for level, priority in ((10, 7), (20, 6), (30, 4), (40, 3), (50, 2)):
        record = logging.LogRecord("x", level, "", 0, "two\nlines", None, None)
        assert formatter.format(record) == f"<{priority}>two\n<{priority}>lines"


def test_an_error_that_ends_the_program_has_its_priority_in_the_journal_alone(
    tmp_path: Path,
) -> None:
    for to_journal in (True, False):
        with (tmp_path / "said").open("wb") as said:
            stream = os.fstat(said.fileno())
            inode = stream.st_ino if to_journal else stream.st_ino + 1
            done = subprocess.run(
                [sys.executable, "-m", "skin_host", "run", str(tmp_path / "absent.toml")],
                env=os.environ | {"JOURNAL_STREAM": f"{stream.st_dev}:{inode}"},
                stderr=said,
                check=False,
            )
        assert done.returncode == 2
        (line,) = (tmp_path / "said").read_text().splitlines()
        assert line.startswith("<3>skin run: " if to_journal else "skin run: ")
