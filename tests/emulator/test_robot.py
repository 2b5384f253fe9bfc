import asyncio
import re
from pathlib import Path

import can
import numpy as np
import pytest
from smbus2 import i2c_msg

from emulator.chips import signal
from emulator.clock import RealClock, SteppedTime
from emulator.probes import scene as scenes
from emulator.probes.scene import Fault, Place, Probe, Scene
from emulator.robot import Robot
from skin_host.bus.answers import Discovered, parse_answer
from skin_host.bus.board import configuration
from skin_host.bus.commands import (
    Discover,
    SetBoardConfig,
    SetTxMode,
    TxMode,
    command_frame,
)
from skin_host.bus.pair import PairBus, pair
from skin_host.bus.wire import FrameBatch, find_skin_frames
from skin_host.clock import SteppedClock
from skin_host.config import settings as configurations
from skin_host.config.settings import Settings, changed
from skin_host.errors import ConfigurationError, LogError, RequestError
from skin_host.layout import Layout, build_layout

CONFIG = Path(__file__).parents[2] / "config"


def load(name: str = "demo") -> tuple[Settings, Layout]:
    path = CONFIG / f"{name}.toml"
    settings = configurations.load(path)
    return settings, build_layout(settings, path.parent)


def press(part: str, taxel: int, kpa: float, diameter_mm: float = 6.0) -> Probe:
    return Probe(
        part=part,
        at=Place(taxel=taxel),
        diameter_mm=diameter_mm,
        pressure_kpa=[(0.0, kpa), (1e6, kpa)],
    )


def values(batch: FrameBatch, layout: Layout) -> np.ndarray:
    """The last byte of every taxel in a batch, int16[n]; -1 where none came."""
    found = find_skin_frames(batch)
    latest = np.full(layout.n_taxels, -1, np.int16)
    of_address = {board.settings.address: board for board in layout.boards}
    for row, address, triangle, half in zip(
        found.row, found.board, found.triangle, found.half, strict=True
    ):
        first = of_address[address].taxel_index[triangle, 0]
        if half == 0:
            latest[first : first + 7] = batch.data[row, 1:8]
        else:
            latest[first + 7 : first + 12] = batch.data[row, 1:6]
    return latest


def bytes_of(robot: Robot, seconds: float, dt_s: float = 0.05) -> bytes:
    sent = b""
    for _ in range(round(seconds / dt_s)):
        batch = robot.step(dt_s)["can0"]
        columns = [batch.id[:, None].view(np.uint8), batch.data, batch.t_ns[:, None].view(np.uint8)]
        sent += np.hstack(columns).tobytes()
    return sent


def test_boards_are_silent_until_a_host_starts_them() -> None:
    robot = Robot(*load())
    assert len(robot.step(1.0)["can0"]) == 0


def test_every_fitted_triangle_is_sent_in_two_frames_a_period() -> None:
    settings, layout = load()
    robot = Robot(settings, layout)
    robot.bring_up()
    sent = robot.step(1.02)["can0"]
    assert len(sent) == 20 * 2 * len(layout.triangles)
    assert (values(sent, layout) >= 0).all()


def test_an_untouched_skin_sends_its_no_load_value_within_the_noise() -> None:
    settings, layout = load()
    robot = Robot(settings, layout)
    robot.bring_up()
    sent = values(robot.step(0.2)["can0"], layout)
    assert np.median(np.abs(sent - 240)) <= 1


def test_a_press_lowers_the_bytes_of_the_taxels_under_it_and_no_others() -> None:
    settings, layout = load()
    start = layout.part("left_forearm").start
    scene = Scene(noise=False, probe=[press("left_forearm", 27, 80.0)])
    scene.probe[0].start_s = 1.5
    robot = Robot(settings, layout, scene)
    robot.bring_up()
    robot.step(1.0)
    sent = values(robot.step(0.2)["can0"], layout)
    assert sent[start + 27] < 200
    assert (np.delete(sent, start + 27) == 240).all()


def test_the_truth_of_a_press_is_its_pressure_where_it_covers_the_pad() -> None:
    robot = Robot(*load(), Scene(probe=[press("left_forearm", 27, 80.0)]))
    robot.step(0.5)
    truth = robot.true_pressure_kpa("left_forearm")
    assert truth[27] == pytest.approx(80.0, rel=1e-2)
    assert np.count_nonzero(truth) == 1


def test_the_same_scene_and_seed_give_the_same_bytes() -> None:
    scene = scenes.load(CONFIG / "scenes" / "demo.toml")
    runs = []
    for seed in (1, 1, 2):
        robot = Robot(*load(), scene, seed=seed)
        robot.bring_up()
        runs.append(bytes_of(robot, 8.0))
    assert runs[0] == runs[1]
    assert runs[0] != runs[2]


def test_signal_and_chip_fidelity_send_the_same_bytes() -> None:
    scene = scenes.load(CONFIG / "scenes" / "demo.toml")
    runs = []
    for fidelity in ("signal", "chip", {"hand": "chip", "forearm_outer": "signal"}):
        robot = Robot(*load(), scene, fidelity=fidelity)
        robot.converters.by_bus = True
        robot.bring_up()
        runs.append(bytes_of(robot, 9.0))
    assert runs[0] == runs[1] == runs[2]


def test_sweeps_that_are_computed_ahead_are_those_that_are_computed_one_by_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs = []
    for reads_ahead in (16, 1):
        monkeypatch.setattr(signal, "_READS_AHEAD", reads_ahead)
        robot = Robot(*load(), scenes.load(CONFIG / "scenes" / "demo.toml"))
        probe = robot.touch(Probe(part="left_forearm", at=Place(taxel=30), force_n=[(0.0, 0.0)]))
        robot.bring_up()
        sent = bytes_of(robot, 3.0)
        probe.press(2.0)
        sent += bytes_of(robot, 1.0, 0.017)
        mend = robot.inject(Fault(name="chip_gone", board="hand", triangle=2))
        probe.lift()
        sent += bytes_of(robot, 2.0)
        mend()
        robot.inject(Fault(name="temperature_step", value=2.0))
        sent += bytes_of(robot, 1.0)
        robot.inject(Fault(name="late_period", board="forearm_inner", value=7.0))
        runs.append(sent + bytes_of(robot, 3.0))
    assert runs[0] == runs[1]


def test_the_size_of_a_step_does_not_change_the_bytes() -> None:
    runs = []
    for dt_s in (0.002, 0.05, 0.25):
        robot = Robot(*load(), scenes.load(CONFIG / "scenes" / "demo.toml"))
        robot.bring_up()
        runs.append(bytes_of(robot, 8.0, dt_s))
    assert runs[0] == runs[1] == runs[2]


@pytest.mark.parametrize(("fault", "value"), [("bus_off", None), ("babbling_node", 1.0)])
def test_the_size_of_a_step_does_not_change_how_long_a_bus_is_disturbed(
    fault: str, value: float | None
) -> None:
    """Faults that began and ended within a step were none of it, and those that ended in it were
    over since its begin.
    """
    settings, layout = load("icub_hand")
    scene = Scene(fault=[Fault(name=fault, bus="can0", at_s=3.0, until_s=3.4, value=value)])
    runs = []
    for dt_s in (0.01, 0.15, 3.0):
        robot = Robot(settings, layout, scene)
        robot.bring_up()
        runs.append((bytes_of(robot, 3.0, dt_s), robot.wires["can0"].lost))
    assert runs[0] == runs[1] == runs[2]
    assert runs[0][1] > 0


def test_frames_of_one_bus_follow_each_other_as_the_bitrate_allows() -> None:
    robot = Robot(*load())
    robot.bring_up()
    sent = robot.step(0.5)["can0"]
    assert (np.diff(sent.t_ns) >= 111_000).all()
    # Within a burst the lower address wins the bus.
    first = sent.id[: 2 * 33] >> 4 & 0xF
    assert (np.diff(first.astype(int)) >= 0).all()


def test_a_place_that_is_not_there_is_named_with_its_key() -> None:
    settings, layout = load()
    for probe, message in (
        (Probe(part="tail", depth_mm=[(0, 1), (1, 1)]), r"probe\[0\].part: no part \"tail\""),
        (
            Probe(part="left_hand", at=Place(triangle=9), depth_mm=[(0, 1), (1, 1)]),
            r"probe\[0\].at.triangle: 9; part \"left_hand\" has triangles 0 to 8",
        ),
        (
            Probe(part="left_hand", at=Place(taxel=108), depth_mm=[(0, 1), (1, 1)]),
            r"probe\[0\].at.taxel: 108; part \"left_hand\" has taxels 0 to 107",
        ),
    ):
        with pytest.raises(ConfigurationError, match=message):
            Robot(settings, layout, Scene(probe=[probe]))


@pytest.mark.parametrize(
    ("depth_mm", "compliance", "message"),
    [
        (1.88, 0.0, None),
        (1.89, 0.0, r'probe\[1\].depth_mm: 1.89 mm on "left_hand", whose foam is 2 mm; wanted up'),
        (1e9, 1000.0, "wanted up to 5.27e"),
        (2.5, 0.06, None),
        (9.0, 0.06, "wanted up to 5.04 mm"),
    ],
)
def test_a_probe_that_would_go_deeper_than_the_foam_is_refused(
    depth_mm: float, compliance: float, message: str | None
) -> None:
    probe = Probe(
        part="left_hand",
        at=Place(taxel=3),
        depth_mm=[(0, 0), (1, depth_mm), (2, 0)],
        compliance_mm_per_n=compliance,
    )
    scene = Scene(probe=[press("left_hand", 3, 20.0), probe])
    if message is None:
        Robot(*load(), scene)
        return
    with pytest.raises(ConfigurationError, match=message):
        Robot(*load(), scene)


def test_skin_recovers_from_a_hand_that_presses_deeper_than_its_foam() -> None:
    settings, layout = load()
    robot = Robot(settings, layout, Scene(noise=False))
    robot.bring_up()
    taxel = layout.part("left_hand").start + 15
    untouched = values(robot.step(0.12)["can0"], layout)
    probe = robot.touch(
        Probe(part="left_hand", at=Place(taxel=15), diameter_mm=3, depth_mm=[(0, 1)])
    )
    for depth_mm in (2.0, 2.1, 10.0, 1e9):
        probe.press(depth_mm)
        seen = values(robot.step(0.2)["can0"], layout)
        assert probe.force_n < 100
        assert robot.true_pressure_kpa("left_hand").max() < 3000
        assert seen[taxel] == 0
        others = np.delete(np.arange(layout.n_taxels), taxel)
        assert np.abs(seen[others] - untouched[others]).max() <= 1
    probe.lift()
    robot.step(120.0)
    after = values(robot.step(0.2)["can0"], layout)
    assert np.abs(after - untouched).max() <= 4


def test_an_unknown_fidelity_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="there are: signal, chip"):
        Robot(*load(), fidelity="perfect")


async def test_a_robot_answers_and_streams_on_a_python_can_bus() -> None:
    robot = Robot(*load())
    robot.bring_up()
    with (
        can.Bus(interface="virtual", channel="test-robot") as inside,
        can.Bus(interface="virtual", channel="test-robot") as outside,
    ):
        can_id, data = command_frame(Discover(), 15)
        outside.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        life = asyncio.create_task(robot.run({"can0": inside}))
        answers, streamed = set(), 0
        while len(answers) < 3 or streamed < 100:
            message = outside.recv(0)
            if message is None:
                await asyncio.sleep(0.005)
                continue
            answer = parse_answer(message.arbitration_id, bytes(message.data))
            if answer is not None and isinstance(answer[1], Discovered):
                answers.add(answer[0])
            streamed += message.arbitration_id >> 8 == 4
        life.cancel()
    assert answers == {12, 13, 14}


async def test_boards_whose_computer_was_busy_get_their_commands_one_after_the_other() -> None:
    settings, layout = load()
    robot = Robot(settings, layout, Scene(noise=False))
    clock = SteppedTime()
    with (
        can.Bus(interface="virtual", channel="test-busy") as inside,
        can.Bus(interface="virtual", channel="test-busy") as outside,
    ):
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        await clock.advance(0.01)
        # The first command 50 takes its zero before the chips have converted, the second after.
        board = layout.boards[0]
        _, *set_ups = configuration(board, [one for one in layout.triangles if one.board == 0])
        start = [SetTxMode(TxMode.START)]
        for message in [SetBoardConfig(0, 50, 240), *set_ups, *set_ups, *start]:
            can_id, data = command_frame(message, board.settings.address)
            outside.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        for _ in range(3):
            await clock.advance(0.2)
        life.cancel()
        frames = iter(lambda: outside.recv(0), None)
        status = {bytes(frame.data[6:8]) for frame in frames if frame.data[0] == 0xC0}
    assert status == {b"\0\0"}


async def test_a_busy_computer_delays_frames_but_not_their_time_stamps() -> None:
    robot = Robot(*load(), Scene(noise=False))
    robot.bring_up()
    clock = SteppedTime()
    with (
        can.Bus(interface="virtual", channel="test-late") as inside,
        can.Bus(interface="virtual", channel="test-late") as outside,
    ):
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        for late_s in (0.05, 0.13, 0.02, 0.2, 0.2, 0.11, 0.07):
            await clock.advance(late_s)
        life.cancel()
        frames = iter(lambda: outside.recv(0), None)
        stamps_s = [
            frame.timestamp
            for frame in frames
            if frame.arbitration_id == 0x4C0 and frame.data[0] == 0x40
        ]
    assert len(stamps_s) >= 14
    assert np.diff(stamps_s) == pytest.approx(0.05, abs=0.002)
    assert stamps_s[-1] <= clock.now_ns() * 1e-9


async def test_a_robot_that_is_slower_than_its_time_can_be_ended() -> None:
    """Signals are processed between two parts of a time that is long."""
    robot, clock = Robot(*load()), SteppedTime()
    with can.Bus(interface="virtual", channel="test-slow") as inside:
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        await clock.advance(0.01)
        await clock.advance(4.0)
        for _ in range(3):
            await asyncio.sleep(0)
        life.cancel()
        await asyncio.gather(life, return_exceptions=True)
    assert life.cancelled()
    assert 0 < robot.t_ns < 3_000_000_000


async def test_a_pause_that_a_host_takes_for_silence_is_reported(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """As on vcan and udp_multicast; the demo's own bus shows pauses to the daemon."""
    robot, clock = Robot(*load()), SteppedTime()
    ours, theirs = pair()
    with can.Bus(interface="virtual", channel="test-pause") as plain:
        life = asyncio.create_task(robot.run({"can0": plain}, clock))
        for passed_s in (0.002, 0.1, 0.4, 0.3):
            await clock.advance(passed_s)
        life.cancel()
    (said,) = caplog.messages
    assert said.startswith("bus can0: this computer held the emulator up for 400 ms")
    caplog.clear()
    with PairBus(ours) as marked, theirs:
        life = asyncio.create_task(robot.run({"can0": marked}, clock))
        for passed_s in (0.002, 0.4):
            await clock.advance(passed_s)
        life.cancel()
    assert not caplog.messages


@pytest.mark.parametrize("noise", [True, False])
async def test_a_robot_without_noise_warns_that_a_daemon_calibrates_none_of_it(
    noise: bool, caplog: pytest.LogCaptureFixture
) -> None:
    robot, clock = Robot(*load(), Scene(noise=noise)), SteppedTime()
    with can.Bus(interface="virtual", channel="test-still") as inside:
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        await clock.advance(0.01)
        life.cancel()
    assert [line.partition(":")[0] for line in caplog.messages] == (
        [] if noise else ["the scene has noise = false"]
    )


@pytest.mark.parametrize("speed", [0.01, 0.1, 1.0, 10.0])
def test_a_pause_is_measured_in_the_time_of_the_host(
    speed: float, caplog: pytest.LogCaptureFixture
) -> None:
    robot, host = Robot(*load()), SteppedClock()

    async def live() -> None:
        with can.Bus(interface="virtual", channel="test-pause-of-host") as plain:
            life = asyncio.create_task(robot.run({"can0": plain}, RealClock(speed, host)))
            await host.sleep(1.0)  # of slow emulated time it looks rarely, and is not late
            assert not caplog.messages
            for pause_s in (0.05, 0.4, 0.4, 0.0):  # no more than one in 10 s is reported
                await host.sleep(0.1)
                host.advance(pause_s)
            life.cancel()

    with host.runner() as runner:
        runner.run(live())
    (said,) = caplog.messages
    found = re.search(r"held the emulator up for (\d+) ms", said)
    assert found is not None
    # The robot looked for the last time up to one interval of its own before.
    assert 400 <= int(found[1]) <= 400 + 2.5 / speed


@pytest.mark.parametrize("stalled_s", [0.3, 1.2, 7.33, 3600.01])
async def test_boards_do_not_stall_with_their_computer(stalled_s: float) -> None:
    settings, layout = load()
    robot = Robot(settings, layout, Scene(noise=False))
    robot.bring_up()
    brought_up_s = robot.t_ns * 1e-9
    clock = SteppedTime()
    with (
        can.Bus(interface="virtual", channel="test-stall") as inside,
        can.Bus(interface="virtual", channel="test-stall") as outside,
    ):
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        for _ in range(30):
            await clock.advance(0.01)
        # The stall begins while a sweep is on its way, the test ends when none is.
        while robot.wires["can0"].idle:
            await clock.advance(0.001)
        for late_s in (stalled_s, *[0.01] * 30):
            await clock.advance(late_s)
        while not robot.wires["can0"].idle:
            await clock.advance(0.001)
        life.cancel()
        frames = list(iter(lambda: outside.recv(0), None))
    lived_s = [(robot.t_ns - board.start_ns) * 1e-9 for board in robot.boards.values()]
    assert lived_s == pytest.approx([clock.now_ns() * 1e-9 + brought_up_s] * 3, abs=0.1)
    for board in layout.boards:
        mine = [one for one in frames if one.arbitration_id >> 4 & 0xF == board.settings.address]
        stamps_s = np.array([one.timestamp for one in mine])
        sweeps = np.split(stamps_s, np.flatnonzero(np.diff(stamps_s) > 0.02) + 1)
        assert {len(sweep) for sweep in sweeps} == {2 * len(board.triangles)}
        pauses_s = np.diff([sweep[0] for sweep in sweeps])
        periods = np.round(pauses_s / 0.05)
        assert pauses_s == pytest.approx(0.05 * periods, abs=0.002)
        assert (np.flatnonzero(periods > 1).size > 0) == (stalled_s > 5.0)
        assert clock.now_ns() * 1e-9 - stamps_s[-1] < 0.05


def test_a_program_can_press_with_a_probe_of_its_own() -> None:
    settings, layout = load()
    robot = Robot(settings, layout, Scene(noise=False))
    robot.bring_up()
    start = layout.part("left_hand").start
    probe = robot.touch(Probe(part="left_hand", at=Place(taxel=3), depth_mm=[(0, 1)]))
    seen = []
    for depth_mm in (0.0, 0.3, 0.6, 0.0):
        probe.press(depth_mm)
        seen.append(int(values(robot.step(0.12)["can0"], layout)[start + 3]))
        assert (probe.force_n > 0) == (depth_mm > 0)
    assert seen[0] == 240
    assert seen[0] > seen[1] > seen[2]
    assert seen[3] > seen[1]


def test_a_program_can_slide_its_probe_to_another_taxel() -> None:
    settings, layout = load()
    robot = Robot(settings, layout, Scene(noise=False))
    probe = robot.touch(
        Probe(part="left_forearm", at=Place(taxel=3), diameter_mm=3, force_n=[(0, 1)])
    )
    for x_mm, taxel in ((0.0, 3), (6.43, 0)):
        probe.press(0.5, x_mm)
        robot.step(0.05)
        assert np.flatnonzero(robot.true_pressure_kpa("left_forearm")).tolist() == [taxel]
    probe.lift()
    robot.step(0.05)
    assert not robot.true_pressure_kpa("left_forearm").any()


def test_what_a_program_presses_loads_the_fingertip_below_it() -> None:
    settings, layout = load("fingertips")
    robot = Robot(settings, layout, Scene(noise=False))
    robot.bring_up()
    covered = robot.touch(Probe(part="thumb_skin", at=Place(taxel=3), force_n=[(0.0, 0.0)]))
    bare = robot.touch(Probe(part="index", force_n=[(0.0, 0.0)]))

    def loads_n() -> list[float]:
        robot.step(0.1)
        return [
            float(np.linalg.norm(board._load(robot.t_ns)[:3] - board._load._offset[:3]))
            for board in robot.fingertips.boards.values()
        ]

    assert loads_n() == pytest.approx([0.0, 0.0], abs=1e-9)
    covered.press(2.0)
    bare.press(3.0)
    assert loads_n() == pytest.approx([3.0, 2.0], rel=0.01)
    covered.lift()
    bare.lift()
    assert loads_n() == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_program_cannot_pull_at_a_bare_fingertip_by_pressing_with_less_than_nothing() -> None:
    robot = Robot(*load("fingertips"), Scene(noise=False))
    robot.bring_up()
    finger = robot.touch(Probe(part="index", force_n=[(0.0, 0.0)]))
    finger.press(-2.0)
    robot.step(0.1)
    assert finger.force_n == 0.0
    assert not robot.fingertips.force_n("index", robot.t_ns).any()


def test_what_a_program_pulls_slides_when_friction_does_not_hold_it() -> None:
    settings, layout = load("fingertips")
    robot = Robot(settings, layout, Scene(noise=False))
    robot.bring_up()
    finger = robot.touch(Probe(part="index", friction=0.6, force_n=[(0.0, 0.0)]))
    finger.press(3.0)

    def shear_n() -> float:
        for _ in range(50):
            robot.step(0.01)
        force_n = robot.fingertips.force_n("index", robot.t_ns)
        return float(np.hypot(force_n[0], force_n[1]))

    assert shear_n() == 0.0
    finger.pull(1.0)
    assert shear_n() == pytest.approx(1.0, abs=0.05)
    assert robot.fingertips.slipped_mm("index") == 0.0
    finger.pull(2.4)
    assert shear_n() == pytest.approx(0.85 * 0.6 * 3.0, rel=0.05)
    assert robot.fingertips.slipped_mm("index") > 10.0
    finger.lift()
    assert shear_n() == 0.0
    finger.press(3.0)
    assert shear_n() == 0.0
    assert robot.fingertips.slipped_mm("index") == 0.0


GRASP_LOG = CONFIG.parent / "../shared/data/icub_grasp.log"


@pytest.mark.skipif(not GRASP_LOG.exists(), reason="the recording is not here")
def test_a_board_can_send_what_was_recorded_from_a_real_one() -> None:
    robot = Robot(*load("icub_hand"), recordings={"left_hand": GRASP_LOG})
    assert len(robot.step(1.0)["can0"]) == 0
    robot.bring_up()
    sent = robot.step(1.02)["can0"]
    recorded = [line.split()[2] for line in GRASP_LOG.read_text().splitlines()[:600]]
    replayed = [
        f"{can_id:03X}#{data.tobytes().hex().upper()}"
        for can_id, data in zip(sent.id, sent.data, strict=True)
    ]
    assert len(replayed) == 20 * 10
    assert any(replayed == recorded[at : at + 200] for at in range(0, 400, 10))


def test_a_recording_without_the_board_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "some.log"
    log.write_text("(1.0) can0 410#40F0F0F0F0F0F0F0\n")
    with pytest.raises(LogError, match="no data frames of a board with address 14"):
        Robot(*load("icub_hand"), recordings={"left_hand": log})
    with pytest.raises(LogError, match="cannot be read"):
        Robot(*load("icub_hand"), recordings={"left_hand": tmp_path / "none.log"})
    with pytest.raises(ConfigurationError, match='recordings: no board "foot"'):
        Robot(*load("icub_hand"), recordings={"foot": log})


@pytest.mark.parametrize("model", ["mtb3", "mtb4", "mtb4c"])
def test_all_models_of_boards_live_in_a_robot_at_both_fidelities(model: str) -> None:
    runs = []
    for fidelity in ("signal", "chip"):
        settings, layout = load()
        for name in settings.boards:
            settings = changed(settings, {f"boards.{name}.model": model})
        robot = Robot(
            settings, layout, scenes.load(CONFIG / "scenes" / "demo.toml"), fidelity=fidelity
        )
        robot.converters.by_bus = True
        robot.bring_up()
        robot.step(5.0)
        sent = robot.step(2.0)["can0"]
        assert len(sent) == pytest.approx(40 * 2 * len(layout.triangles), rel=0.03)
        assert np.median(np.abs(values(sent, layout) - 240)) <= 1
        runs.append(sent.data.tobytes() + sent.id.tobytes() + sent.t_ns.tobytes())
    assert runs[0] == runs[1]


def test_registers_are_the_same_whether_results_came_over_the_bus_or_not() -> None:
    seen = []
    for by_bus in (True, False):
        scene = scenes.load(CONFIG / "scenes" / "demo.toml")
        robot = Robot(*load(), scene, fidelity="chip")
        robot.converters.by_bus = by_bus
        robot.bring_up()
        sent = robot.step(8.0)["can0"].data.tobytes()
        registers = [i2c_msg.read(0x2C, 2 * 0x20) for _ in robot.converters.lines]
        for lines, answer in zip(robot.converters.lines.values(), registers, strict=True):
            # From where the board's own reading left the pointer.
            lines[0].i2c_rdwr(answer)
        whole = [robot.converters.synced(chip) for chip in robot.converters.registers]
        words = [chip.write(b"\0\0") and chip.read(2 * 0x290) for chip in whole]
        seen.append((sent, [bytes(answer) for answer in registers], words))
    assert seen[0] == seen[1]


def test_a_board_whose_chips_somebody_else_set_up_sends_what_they_read() -> None:
    robot = Robot(*load(), Scene(noise=False), fidelity="chip")
    robot.bring_up()
    robot.step(0.2)
    for lines in robot.converters.lines.values():
        # Excitation off: all results are in the middle of the scale.
        lines[0].i2c_rdwr(i2c_msg.write(0x2C, [0x00, 0x00, 0x10, 0xB0]))
    robot.step(0.2)
    assert robot.boards["hand"].chips.read()[0].tolist() == [32768] * 12
    assert robot.boards["hand"].chips.read()[1].tolist() != [32768] * 12


def test_others_on_an_i2c_line_of_the_robot_find_its_chips_at_work() -> None:
    robot = Robot(*load(), Scene(noise=False), fidelity={"hand": "chip"})
    robot.step(0.1)
    line = robot.converters.lines[0][0]
    control = i2c_msg.write(0x2C, [0x00, 0x00, 0x00, 0xB0])
    pointer, results = i2c_msg.write(0x2C, [0x00, 0x0B]), i2c_msg.read(0x2C, 24)
    line.i2c_rdwr(control)
    robot.step(0.1)
    line.i2c_rdwr(pointer, results)
    assert any(bytes(results))


@pytest.mark.parametrize("dt_s", [-1.0, -1e-9, float("nan"), float("inf")])
def test_time_goes_forward_only(dt_s: float) -> None:
    """A second back was taken without a word, and the boards sent nothing until then."""
    robot = Robot(*load())
    robot.step(1.0)
    with pytest.raises(RequestError, match="dt_s: seen"):
        robot.step(dt_s)
    assert robot.t_ns == 1_000_000_000


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), 1e308, -1e10])
def test_a_probe_is_pressed_and_pulled_by_numbers_only(number: float) -> None:
    """Pressing by NaN pressed nothing, without a word."""
    robot = Robot(*load())
    finger = robot.touch(Probe(part="left_hand", at=Place(taxel=3), force_n=[(0, 0)]))
    with pytest.raises(RequestError, match="drive: seen"):
        finger.press(number)
    with pytest.raises(RequestError, match="x_mm: seen"):
        finger.press(1.0, number)
    with pytest.raises(RequestError, match="force_n: seen"):
        finger.pull(number)
    with pytest.raises(ConfigurationError, match="diameter_mm: seen"):
        robot.touch(Probe(part="left_hand", diameter_mm=number))


async def test_time_that_is_left_out_in_whole_periods_of_many_seconds_is_not_taken_back() -> None:
    """Boards of 48 and 125 ms are in step every 6 s: more than had passed was left out."""
    robot, clock = Robot(*load()), SteppedTime()
    robot.bring_up()
    hand, *_ = robot.boards.values()
    for board in robot.boards.values():
        board.period_ns = 48_000_000
    hand.period_ns = 125_000_000
    lived_ns = [robot.t_ns]
    with can.Bus(interface="virtual", channel="test-whole-periods") as inside:
        life = asyncio.create_task(robot.run({"can0": inside}, clock))
        for passed_s in (0.1, 11.5, *[0.05] * 20):
            await clock.advance(passed_s)
            lived_ns.append(robot.t_ns)
            assert not life.done()
        life.cancel()
    assert lived_ns == sorted(lived_ns)
    assert lived_ns[-1] > lived_ns[2]
