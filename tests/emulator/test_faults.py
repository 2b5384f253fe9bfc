"""Every fault by name, on a robot of the demo configuration, seen in the frames it sends."""

import errno
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from emulator.chips.cuse import Caller, I2cDevice, Ioctl
from emulator.faults import KINDS, parse
from emulator.probes.scene import Fault, Scene
from emulator.robot import Robot
from skin_host.bus.commands import Discover, SetTxMode, TxMode, command_frame
from skin_host.bus.wire import FrameBatch
from skin_host.config import settings as configurations
from skin_host.errors import ConfigurationError
from skin_host.layout import build_layout

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"
FINGERTIPS = CONFIG.with_name("fingertips.toml")


def make(
    scene: Scene | None = None,
    fidelity: str = "signal",
    *,
    by_bus: bool = False,
    config: Path = CONFIG,
) -> Robot:
    settings = configurations.load(config)
    robot = Robot(
        settings,
        build_layout(settings, config.parent),
        scene or Scene(noise=False),
        fidelity=fidelity,
    )
    robot.converters.by_bus = by_bus
    robot.bring_up()
    robot.step(0.21)
    return robot


@pytest.fixture(params=["signal", "chip"])
def robot(request: pytest.FixtureRequest) -> Robot:
    return make(fidelity=request.param)


def triangle(batch: FrameBatch, board: int, number: int) -> tuple[list[int], int]:
    """Values and status word of the last two frames of a triangle."""
    own = batch.data[batch.id == (0x400 | board << 4 | number)]
    a, b = own[own[:, 0] == 0x40][-1], own[own[:, 0] == 0xC0][-1]
    return [*a[1:].tolist(), *b[1:6].tolist()], int(b[6]) << 8 | int(b[7])


def frames(robot: Robot, seconds: float = 0.3) -> FrameBatch:
    return robot.step(seconds)["can0"]


UNTOUCHED = ([240] * 12, 0)
#: An ergoCub hand: its firmware has a map of chips, which is in force once the host has set it up.
ERGO_HAND = """\
robot = "ergo"
[buses.can0]
[boards.hand]
bus = "can0"
address = 2
skin_type = 3
[[parts.hand.patches]]
board = "hand"
triangles = "0-5"
"""


def ergo_hand(folder: Path, scene: Scene) -> Robot:
    """An ergoCub hand that no host has set up."""
    config = folder / "ergo.toml"
    config.write_text(ERGO_HAND)
    settings = configurations.load(config)
    return Robot(settings, build_layout(settings, folder), scene)


def gone(robot: Robot) -> set[int]:
    """The triangles of the ergoCub hand that send an error."""
    sent = frames(robot)
    return {number for number in range(6) if triangle(sent, 2, number)[1]}


@pytest.mark.parametrize("number", range(6))
def test_a_fault_is_of_the_same_chip_before_and_after_the_board_is_set_up(
    tmp_path: Path, number: int
) -> None:
    fault = Fault(name="chip_gone", board="hand", triangle=number)
    robot = ergo_hand(tmp_path, Scene(noise=False, fault=[fault]))
    robot.step(0.01)
    robot.bring_up()
    robot.step(0.5)
    assert gone(robot) == {number}
    robot.inject(Fault(name="chip_back", board="hand", triangle=number))
    robot.step(0.5)
    assert gone(robot) == set()
    robot.inject(Fault(name="board_reset", board="hand"))
    robot.inject(fault)
    robot.bring_up()
    robot.step(0.5)
    assert gone(robot) == {number}


def test_a_chip_that_is_gone_reads_all_ones_and_comes_back(robot: Robot) -> None:
    robot.inject(Fault(name="chip_gone", board="hand", triangle=2))
    assert triangle(frames(robot), 14, 2) == ([0] * 12, 0xFFF2)
    assert triangle(frames(robot), 14, 3) == UNTOUCHED
    robot.inject(Fault(name="chip_back", board="hand", triangle=2))
    assert triangle(frames(robot), 14, 2) == UNTOUCHED


def test_a_chip_that_reads_zero_makes_the_board_take_a_new_baseline(robot: Robot) -> None:
    robot.inject(Fault(name="chip_gone", board="hand", triangle=2, value=0))
    first = frames(robot, 0.1)
    assert triangle(first, 14, 2) == ([255] * 12, 0xFFF1)
    assert triangle(frames(robot, 0.5), 14, 2) == UNTOUCHED


def test_a_board_goes_on_sending_when_all_its_chips_are_gone(robot: Robot) -> None:
    (hand,) = (board for board in robot.layout.boards if board.name == "hand")
    for number in hand.triangles:
        robot.inject(Fault(name="chip_gone", board="hand", triangle=number))
    sent = frames(robot)
    assert {tuple(triangle(sent, 14, number)[0]) for number in hand.triangles} == {(0,) * 12}


def test_a_shorted_finger_takes_its_whole_line_with_it(robot: Robot) -> None:
    robot.inject(Fault(name="shorted_finger", board="hand", triangle=1))
    sent = frames(robot, 0.06)
    for number in range(4):
        assert triangle(sent, 14, number) == ([255] * 12, 0xFFF1)
    assert triangle(sent, 14, 4) == UNTOUCHED


def test_a_chip_at_a_wrong_address_leaves_its_own_place_empty(robot: Robot) -> None:
    robot.inject(Fault(name="wrong_address", board="hand", triangle=0, value=3))
    sent = frames(robot)
    assert triangle(sent, 14, 0)[1] & 0xF == 2
    values, status = triangle(sent, 14, 3)
    assert values != UNTOUCHED[0]
    assert status & 0xF == 0


def test_swapped_lines_exchange_their_triangles(robot: Robot) -> None:
    before = [robot.boards["forearm_outer"].chips.read()[slot].tolist() for slot in (0, 4)]
    mend = robot.inject(Fault(name="swapped_lines", board="forearm_outer", triangle=0, value=1))
    after = [robot.boards["forearm_outer"].chips.read()[slot].tolist() for slot in (4, 0)]
    assert after == before
    assert triangle(frames(robot), 13, 0) != UNTOUCHED
    mend()
    assert triangle(frames(robot), 13, 0) == UNTOUCHED


def test_a_stuck_taxel_stays_where_it_is_told(robot: Robot) -> None:
    mend = robot.inject(Fault(name="stuck_taxel", board="hand", triangle=0, taxel=5, value=144.0))
    values, _ = triangle(frames(robot), 14, 0)
    assert values == [240] * 5 + [240 - 100] + [240] * 6
    mend()
    assert triangle(frames(robot), 14, 0) == UNTOUCHED


@pytest.mark.parametrize("fidelity", ["signal", "chip"])
def test_several_stuck_taxels_of_a_chip_stay_and_are_mended_one_by_one(fidelity: str) -> None:
    robot = make(Scene(quiet=True), fidelity)
    robot.inject(Fault(name="stuck_taxel", board="hand", triangle=9, taxel=4))
    mend = robot.inject(Fault(name="stuck_taxel", board="hand", triangle=9, taxel=5))

    def still() -> list[int]:
        rows = np.array([triangle(frames(robot, 0.05), 14, 9)[0] for _ in range(60)])
        return np.flatnonzero(np.ptp(rows[1:], axis=0) == 0).tolist()

    assert still() == [4, 5]
    mend()
    assert still() == [4]


@pytest.mark.parametrize("fidelity", ["signal", "chip"])
def test_a_noisy_taxel_moves_more_than_its_neighbours(fidelity: str) -> None:
    robot = make(Scene(quiet=True), fidelity)
    robot.inject(Fault(name="noisy_taxel", board="hand", triangle=9, taxel=5))
    rows = np.array([triangle(frames(robot, 0.05), 14, 9)[0] for _ in range(80)])
    assert rows[:, 5].std() == pytest.approx(6.0, rel=0.4)
    assert np.median(rows.std(axis=0)) < 1.5


def test_a_reset_board_is_silent_until_it_is_started_again(robot: Robot) -> None:
    robot.inject(Fault(name="board_reset", board="hand"))
    assert 14 not in set(frames(robot).id >> 4 & 0xF)
    robot.bring_up()
    assert triangle(frames(robot), 14, 0) == UNTOUCHED


def test_a_silent_board_neither_hears_nor_sends(robot: Robot) -> None:
    mend = robot.inject(Fault(name="board_silent", board="hand"))
    robot.receive("can0", *command_frame(Discover(), 15))
    senders = set((frames(robot).id >> 4 & 0xF).tolist())
    assert senders == {12, 13}
    mend()
    assert 14 in (frames(robot).id >> 4 & 0xF)


def test_a_late_period_sends_fewer_bursts(robot: Robot) -> None:
    robot.inject(Fault(name="late_period", board="hand", value=50))
    sent = frames(robot, 2.0)
    of_hand = (sent.id >> 4 & 0xF) == 14
    assert np.count_nonzero(of_hand) / 18 == pytest.approx(20, abs=1)
    assert np.count_nonzero(~of_hand) / 48 == pytest.approx(40, abs=1)


def test_a_period_that_is_shortened_to_less_than_nothing_is_a_millisecond(robot: Robot) -> None:
    robot.inject(Fault(name="late_period", board="hand", value=-40))
    sent = frames(robot, 1.0)
    assert np.count_nonzero((sent.id >> 4 & 0xF) == 14) / 18 == pytest.approx(96, abs=6)
    robot.inject(Fault(name="late_period", board="hand", value=-1000))
    robot.step(0.05)
    due_ns = robot.boards["hand"].next_ns
    assert due_ns == pytest.approx(robot.t_ns, abs=1_000_000)


def test_a_jittered_period_spreads_the_bursts_and_loses_none(robot: Robot) -> None:
    robot.inject(Fault(name="jittered_period", board="hand", value=5))
    sent = frames(robot, 2.0)
    first = sent.t_ns[sent.id == 0x4E0][::2]
    assert len(first) == pytest.approx(40, abs=1)
    assert 1e6 < np.diff(first).std() < 15e6


def test_lost_frames_are_missing_in_their_share(robot: Robot) -> None:
    robot.inject(Fault(name="frame_loss", bus="can0", value=0.25))
    expected = 20 * 2 * 33
    assert len(frames(robot, 1.0)) == pytest.approx(0.75 * expected, rel=0.1)


def test_bit_errors_change_one_bit_of_a_frame(robot: Robot) -> None:
    whole = frames(robot, 1.0)
    robot.inject(Fault(name="bit_errors", bus="can0", value=0.1))
    spoilt = frames(robot, 1.0)
    n = min(len(whole), len(spoilt))
    assert (whole.id[:n] == spoilt.id[:n]).all()
    flipped = np.unpackbits(whole.data[:n] ^ spoilt.data[:n], axis=1).sum(axis=1)
    assert set(flipped.tolist()) == {0, 1}
    assert np.count_nonzero(flipped) == pytest.approx(0.1 * n, rel=0.3)


def test_nothing_passes_while_the_bus_is_off(robot: Robot) -> None:
    mend = robot.inject(Fault(name="bus_off", bus="can0"))
    robot.receive("can0", *command_frame(Discover(), 15))
    assert len(frames(robot, 0.5)) == 0
    assert robot.wires["can0"].lost > 0
    mend()
    assert len(frames(robot, 0.1)) > 0


def test_a_babbling_node_delays_and_drops_what_the_boards_send(robot: Robot) -> None:
    robot.inject(Fault(name="babbling_node", bus="can0", value=0.97))
    sent = frames(robot, 1.0)
    babble = sent.id == 0
    assert np.count_nonzero(babble) > 7000
    assert np.count_nonzero(~babble) < 20 * 2 * 33 / 2
    assert robot.wires["can0"].lost > 0


@pytest.mark.parametrize(("share", "obeyed"), [(0.97, True), (1.0, False)])
def test_no_command_passes_a_bus_that_a_node_fills(
    robot: Robot, share: float, obeyed: bool
) -> None:
    mend = robot.inject(Fault(name="babbling_node", bus="can0", value=share))
    frames(robot, 0.1)
    robot.receive("can0", *command_frame(SetTxMode(TxMode.STOP), 14))
    mend()
    frames(robot, 0.1)
    assert (14 in frames(robot, 0.2).id >> 4 & 0xF) == (not obeyed)


def test_a_temperature_step_moves_the_bytes_that_are_not_compensated(robot: Robot) -> None:
    robot.inject(Fault(name="temperature_step", value=20.0))
    sent = frames(robot)
    palm, _ = triangle(sent, 14, 0)
    forearm, _ = triangle(sent, 13, 0)
    pressure = [0, 1, 2, 3, 4, 5, 7, 8, 9, 11]
    assert max(palm) < 240
    # 20 degrees are 200 codes or 50 units at the thermal pad; the firmware takes them out.
    assert forearm[6] == pytest.approx(240 - 50, abs=1)
    assert np.abs(np.array(forearm)[pressure] - 240).max() <= 6


def test_faults_of_a_scene_begin_and_end_on_time() -> None:
    scene = Scene(
        noise=False, fault=[Fault(name="chip_gone", board="hand", triangle=0, at_s=2, until_s=3)]
    )
    robot = make(scene)
    gone = []
    while robot.t_ns < 4e9:
        if triangle(frames(robot, 0.05), 14, 0) != UNTOUCHED:
            gone.append(robot.t_ns * 1e-9)
    # A burst is sampled every 50 ms and on the bus a few milliseconds later.
    assert gone[0] == pytest.approx(2.0, abs=0.1)
    assert gone[-1] == pytest.approx(3.0, abs=0.1)
    assert len(gone) == pytest.approx(20, abs=1)


def test_the_same_faults_give_the_same_bytes_at_both_fidelities() -> None:
    scene = Scene(
        fault=[
            Fault(name="chip_gone", board="hand", triangle=0, at_s=1.5, until_s=2),
            Fault(name="stuck_taxel", board="hand", triangle=1, taxel=3, at_s=1.2),
            Fault(name="noisy_taxel", board="hand", triangle=2, taxel=3, at_s=1.2, until_s=1.7),
            Fault(name="swapped_lines", board="forearm_inner", triangle=0, at_s=1.6, until_s=2.2),
            Fault(name="frame_loss", bus="can0", value=0.05, at_s=1.3),
            Fault(name="bit_errors", bus="can0", value=0.05, at_s=1.3),
            Fault(name="jittered_period", board="forearm_outer", at_s=1.4),
        ]
    )
    runs = [frames(make(scene, kind, by_bus=True), 2.0) for kind in ("signal", "chip")]
    assert (runs[0].id == runs[1].id).all()
    assert (runs[0].data == runs[1].data).all()
    assert (runs[0].t_ns == runs[1].t_ns).all()


WIRES = ("shared_address", "no_acknowledge", "data_held_low", "clock_stretched", "brown_out")


@pytest.mark.parametrize("name", WIRES)
def test_faults_of_the_wire_give_the_same_bytes_at_both_fidelities(name: str) -> None:
    fault = Fault(name=name, board="hand", triangle=2, at_s=1.3, until_s=1.6)
    scene = Scene(fault=[fault])
    runs = [frames(make(scene, kind, by_bus=True), 1.5) for kind in ("signal", "chip")]
    assert (runs[0].data == runs[1].data).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("shared_address", 1),
        ("no_acknowledge", 0),
        ("no_acknowledge", 1),
        ("data_held_low", 0),
        ("clock_stretched", 20),
        ("brown_out", None),
        ("bit_flipped", 0.02),
        ("slow_rise", 20),
    ],
)
def test_faults_of_the_wire_are_seen_in_the_frames_of_boards(
    robot: Robot, name: str, value: float | None
) -> None:
    mend = robot.inject(Fault(name=name, board="hand", triangle=2, value=value))
    sent = frames(robot, 0.5)
    words = sent.data[(sent.id == 0x4E2) & (sent.data[:, 0] == 0xC0)][:, 6:].tolist()
    assert any(word != [0, 0] for word in words)
    # Another data line; but all share one clock.
    assert triangle(sent, 14, 4)[1] == 0 or name == "clock_stretched"
    mend()
    if name != "brown_out":
        # The board may have taken another zero meanwhile; a new set-up mends that, too.
        robot.inject(Fault(name="board_reset", board="hand"))
        robot.bring_up()
        assert triangle(frames(robot), 14, 2) == UNTOUCHED


def test_a_chip_that_browned_out_measures_again_once_its_board_sets_it_up(robot: Robot) -> None:
    robot.inject(Fault(name="brown_out", board="hand", triangle=2))
    robot.step(1.0)
    robot.bring_up()
    values, _ = triangle(frames(robot), 14, 2)
    assert values == [240] * 12
    assert robot.boards["hand"].chips.read()[2][1:].tolist() == [0] * 11
    robot.inject(Fault(name="board_reset", board="hand"))
    robot.bring_up()
    assert robot.boards["hand"].chips.read()[2].all()


def test_a_data_line_that_is_held_costs_one_reading(robot: Robot) -> None:
    robot.inject(Fault(name="data_held_low", board="hand", triangle=2))
    sent = frames(robot, 0.1)
    statuses = sent.data[(sent.id == 0x4E0) & (sent.data[:, 0] == 0xC0)][:, 6:].tolist()
    assert [0, 0] != statuses[0] == [0xFF, 0xF1]
    assert statuses[-1] == [0, 0]


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("no_acknowledge board=hand triangle=2 value=0", errno.ENXIO),
        ("no_acknowledge board=hand triangle=2", errno.EREMOTEIO),
        ("data_held_low board=hand triangle=2 value=0", errno.ETIMEDOUT),
        ("clock_stretched board=hand triangle=2 value=200000", errno.ETIMEDOUT),
        ("chip_gone board=hand triangle=2", errno.ENXIO),
    ],
)
def test_i2c_clients_on_a_line_of_the_robot_meet_its_faults(line: str, error: int) -> None:
    robot = make(fidelity="chip")
    bus = I2cDevice(robot.converters.lines[0][0])
    client = bus.open()
    bus.ioctl(client, Ioctl.SLAVE, 0x2E, Caller(b"", 0))
    mend = robot.inject(parse(line))
    with pytest.raises(OSError) as raised:
        bus.write(client, bytes([0x00, 0x17]))
    assert raised.value.errno == error
    mend()
    bus.write(client, bytes([0x00, 0x17]))
    assert bus.read(client, 2) == b"\x14\x71"


@pytest.mark.parametrize("name", KINDS)
def test_every_fault_can_be_named_in_a_scene(name: str) -> None:
    kind = KINDS[name]
    tip = kind.on == "fingertip"
    targets = {"board": "index" if tip else "hand", "triangle": 0, "taxel": 0, "bus": "can0"}
    fault = Fault(name=name, **{key: targets[key] for key in kind.needs})
    robot = make(Scene(noise=False, fault=[fault]), config=FINGERTIPS if tip else CONFIG)
    robot.step(0.5)


def refused_value(value: float) -> str:
    return re.escape(f"fault[0].value: {value:g}; wanted")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (Fault(name="gremlins"), r'fault\[0\].name: no fault "gremlins"; there are: chip_gone, '),
        (Fault(name="chip_gone", board="hand"), r"fault\[0\].triangle: missing"),
        (
            Fault(name="chip_gone", board="foot", triangle=0),
            r'fault\[0\].board: no board "foot"; there are: hand',
        ),
        (
            Fault(name="chip_gone", board="hand", triangle=6),
            r'fault\[0\].triangle: 6 is not fitted on "hand"',
        ),
        (Fault(name="bus_off", bus="can7"), r'fault\[0\].bus: no bus "can7"; there are: can0'),
        (
            Fault(name="bit_flipped", board="hand", triangle=0, value=2),
            r"fault\[0\].value: 2; wanted 0 to 1",
        ),
        (Fault(name="bus_off", bus="can0", at_s=2, until_s=1), r"fault\[0\].until_s: wanted"),
        (
            Fault(name="bus_off", bus="can0", board="hand", triangle=3),
            r'fault\[0\].board: hand; fault "bus_off" has no board',
        ),
        (
            Fault(name="bus_off", bus="can0", value=1),
            r'fault\[0\].value: 1; fault "bus_off" has no',
        ),
        (
            Fault(name="wrong_address", board="hand", triangle=3),
            r"fault\[0\].value: is the chip's own address",
        ),
        (
            Fault(name="swapped_lines", board="hand", triangle=4, value=1),
            r"fault\[0\].value: is the triangle's own line",
        ),
        *(
            (Fault(name=name, board="hand", value=value), refused_value(value))
            for name, least in (("late_period", -1001.0), ("jittered_period", -1.0))
            for value in (least, 1e9, np.nan, np.inf)
        ),
        *(
            (Fault(name=name, bus="can0", value=value), refused_value(value) + " 0 to 1")
            for name in ("frame_loss", "bit_errors", "babbling_node")
            for value in (-0.1, 1.1, np.nan)
        ),
        *(
            (
                Fault(name=name, board="hand", triangle=0, taxel=taxel, value=value),
                refused_value(value),
            )
            for name, taxel, values in (
                ("chip_gone", None, (-1.0, 0x10000)),
                ("stuck_taxel", 0, (-1e5, 1e9)),
                ("noisy_taxel", 0, (-1.0, 1e9)),
                ("wrong_address", None, (-1.0, 4.0)),
                ("swapped_lines", None, (-1.0, 4.0)),
                ("no_acknowledge", None, (-1.0, 1e9)),
                ("clock_stretched", None, (-1.0, 1e9)),
            )
            for value in values
        ),
        *(
            (
                Fault(name=name, board="hand", triangle=0, value=2.5),
                refused_value(2.5) + " a whole number, ",
            )
            for name in (
                "chip_gone",
                "wrong_address",
                "swapped_lines",
                "shared_address",
                "no_acknowledge",
                "data_held_low",
                "slow_rise",
            )
        ),
        *(
            (Fault(name="temperature_step", value=value), refused_value(value))
            for value in (-1e6, 1e6)
        ),
    ],
)
def test_a_fault_that_cannot_happen_is_refused(fault: Fault, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        make(Scene(fault=[fault]))


def test_a_fault_can_be_given_as_a_line() -> None:
    assert parse("chip_gone board=hand triangle=3 until_s=5") == Fault(
        name="chip_gone", board="hand", triangle=3, until_s=5.0
    )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "chip_gone",
        "chip_gone board",
        "chip_gone bord=hand",
        "bus_off bus=a value=x",
        "bus_off bus=a triangle=3",
        "bus_off bus=a until_s=inf",
        "bus_off bus=a at_s=1e300",
        "late_period board=hand value=nan",
    ],
)
def test_a_line_that_is_no_fault_is_refused(text: str) -> None:
    with pytest.raises(ConfigurationError):
        parse(text)


def test_a_line_with_a_time_is_refused_because_its_fault_begins_at_once() -> None:
    with pytest.raises(ConfigurationError, match="at_s: 20; a fault given by a line begins at"):
        parse("chip_gone board=hand triangle=3 at_s=20")


def test_a_fault_in_the_middle_of_a_run_can_be_mended_by_its_answer() -> None:
    robot = make()
    mend: Callable[[], None] = robot.inject(parse("chip_gone board=hand triangle=3"))
    robot.step(0.1)
    mend()
    assert triangle(frames(robot), 14, 3) == UNTOUCHED


def measures(robot: Robot) -> bool:
    """Whether the third chip of the hand does."""
    words = robot.boards["hand"].chips.read()[2]
    return bool(((words > 0) & (words < 0xFFFF)).all())


#: Pairs of faults of one thing, and whether it is as it was.
OVERLAPS: list[tuple[str, str, Callable[[Robot], bool]]] = [
    (
        "chip_gone board=hand triangle=2",
        "chip_gone board=hand triangle=2 value=0",
        measures,
    ),
    (
        "chip_gone board=hand triangle=2",
        "shorted_finger board=hand triangle=1",
        measures,
    ),
    (
        "stuck_taxel board=hand triangle=0 taxel=5 value=144",
        "stuck_taxel board=hand triangle=0 taxel=5 value=72",
        lambda robot: triangle(frames(robot), 14, 0) == UNTOUCHED,
    ),
    (
        "noisy_taxel board=hand triangle=0 taxel=5",
        "noisy_taxel board=hand triangle=0 taxel=5 value=30",
        lambda robot: not robot.skin.noise_ff[:12].any(),
    ),
    (
        "swapped_lines board=forearm_outer triangle=0",
        "wrong_address board=forearm_outer triangle=5 value=3",
        lambda robot: triangle(frames(robot), 13, 0) == triangle(frames(robot), 13, 5) == UNTOUCHED,
    ),
    (
        "shared_address board=hand triangle=0",
        "swapped_lines board=hand triangle=1 value=2",
        lambda robot: (robot.converters.chip_of_slot[0] == make().converters.chip_of_slot[0]).all(),
    ),
    (
        "no_acknowledge board=hand triangle=2",
        "no_acknowledge board=hand triangle=2 value=0",
        lambda robot: not robot.converters.i2c_wire(0).lines[0].faulty,
    ),
    (
        "board_silent board=hand",
        "board_silent board=hand",
        lambda robot: 14 in frames(robot).id >> 4 & 0xF,
    ),
    (
        "late_period board=hand",
        "late_period board=hand value=50",
        lambda robot: not robot.late_ns,
    ),
    (
        "frame_loss bus=can0",
        "frame_loss bus=can0 value=1",
        lambda robot: robot.wires["can0"].loss_share == 0.0,
    ),
    ("bus_off bus=can0", "bus_off bus=can0", lambda robot: len(frames(robot)) > 100),
    (
        "babbling_node bus=can0",
        "babbling_node bus=can0 value=0.1",
        lambda robot: not robot.step(0.1) or not (frames(robot).id == 0).any(),
    ),
]


@pytest.mark.parametrize(
    ("first", "second", "is_well"), OVERLAPS, ids=lambda value: str(value)[:24]
)
@pytest.mark.parametrize("ends_first", [0, 1])
def test_of_two_faults_of_one_thing_it_is_well_again_when_both_have_ended(
    first: str, second: str, is_well: Callable[[Robot], bool], ends_first: int
) -> None:
    robot = make()
    mends = [robot.inject(parse(line)) for line in (first, second)]
    robot.step(0.1)
    mends[ends_first]()
    robot.step(0.1)
    assert not is_well(robot)
    mends[ends_first]()  # it has ended already
    robot.step(0.1)
    assert not is_well(robot)
    mends[1 - ends_first]()
    # Boards may have taken another zero meanwhile.
    robot.bring_up()
    robot.step(0.3)
    assert is_well(robot)


def test_a_pad_that_was_dead_from_the_first_is_dead_again_after_a_fault() -> None:
    robot = make(Scene())
    dead = int(np.flatnonzero(~np.isnan(robot.skin.held_ff))[0])
    held_ff = robot.skin.held_ff[dead]
    place = robot.layout.triangles[dead // 12]
    board = robot.layout.boards[place.board].name
    mend = robot.inject(
        Fault(name="stuck_taxel", board=board, triangle=place.number, taxel=dead % 12, value=50.0)
    )
    assert robot.skin.held_ff[dead] != held_ff
    mend()
    assert robot.skin.held_ff[dead] == held_ff


def test_a_fault_of_a_scene_that_cannot_happen_any_more_is_logged_and_the_robot_goes_on(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gone = Fault(name="wrong_address", board="hand", triangle=0, at_s=1.5)
    late = Fault(name="chip_gone", board="hand", triangle=0, at_s=1.6)
    robot = make(Scene(noise=False, fault=[gone, late]))
    assert len(frames(robot, 1.0)) > 1000
    (line,) = [record.getMessage() for record in caplog.records]
    assert line == 'fault[1] chip_gone does not happen: triangle: 0 is not fitted on "hand"'


def test_every_fault_is_explained_in_the_documentation() -> None:
    page = (CONFIG.parents[1] / "docs" / "scenes.md").read_text()
    for name in KINDS:
        assert f"| `{name}` |" in page


def test_the_page_of_faults_has_a_result_in_time_for_each_on_every_firmware() -> None:
    page = (CONFIG.parents[1] / "docs" / "faults.md").read_text()
    rows = [line.strip("|").split("|") for line in page.splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in row] for row in rows]

    skin = [name for name, kind in KINDS.items() if kind.on != "fingertip"]
    assert sorted(row[0].strip("`") for row in cells) == sorted([*skin, *skin])
    assert all(len(row) == 9 for row in cells)
    for _, _, within, *measured in cells:
        assert all(float(one.split(" s")[0]) <= float(within.split(" s")[0]) for one in measured)


@pytest.mark.parametrize("line", ["bus_off bus=can0 bus=can1", "bus_off name=bus_on bus=can0"])
def test_a_key_of_a_line_that_is_given_twice_is_refused(line: str) -> None:
    """The last one was taken without a word."""
    with pytest.raises(ConfigurationError, match="is given twice"):
        parse(line)


class TestWhichAreOn:
    """Each fault that is on can be ended by its line, whoever began it, and no other is listed."""

    @pytest.fixture
    def plain(self) -> Robot:
        return make()

    def test_one_that_is_over_is_not_on(self, plain: Robot) -> None:
        plain.inject(parse("frame_loss bus=can0 until_s=0.2"))
        assert [fault.name for fault in plain.faults_on] == ["frame_loss"]
        plain.step(0.3)
        assert plain.faults_on == []
        assert not plain.mend(parse("frame_loss bus=can0"))

    @pytest.mark.parametrize(
        "line",
        [
            "board_reset board=hand",
            "brown_out board=hand triangle=2",
            "chip_back board=hand triangle=2",
        ],
    )
    def test_one_that_cannot_be_undone_is_not_on(self, line: str, plain: Robot) -> None:
        plain.inject(parse(line))
        assert plain.faults_on == []
        assert not plain.mend(parse(line))

    def test_a_chip_that_is_back_is_not_gone(self, plain: Robot) -> None:
        plain.inject(parse("chip_gone board=hand triangle=2"))
        plain.inject(parse("chip_back board=hand triangle=2"))
        assert plain.faults_on == []

    def test_a_shorted_line_is_on_until_its_last_chip_is_back(self, plain: Robot) -> None:
        plain.inject(parse("shorted_finger board=hand triangle=0"))
        plain.inject(parse("chip_back board=hand triangle=0"))
        assert [fault.name for fault in plain.faults_on] == ["shorted_finger"]
        assert plain.mend(parse("shorted_finger board=hand triangle=0"))
        assert plain.faults_on == []

    @pytest.mark.parametrize(
        ("begun", "mended"),
        [
            ("frame_loss bus=can0", "frame_loss value=0.00660 bus=can0"),
            ("frame_loss bus=can0", "frame_loss bus=can0 until_s=3"),
            ("chip_gone board=hand triangle=2", "chip_gone triangle=2 board=hand value=65535"),
        ],
    )
    def test_it_is_the_same_however_it_is_written(
        self, begun: str, mended: str, plain: Robot
    ) -> None:
        plain.inject(parse(begun))
        assert plain.mend(parse(mended))
        assert plain.faults_on == []

    def test_one_of_the_scene_can_be_mended(self) -> None:
        fault = Fault(name="bus_off", bus="can0", at_s=0.05)
        robot = make(Scene(noise=False, fault=[fault]))
        assert robot.faults_on == [fault]
        assert robot.mend(parse("bus_off bus=can0"))
        assert not robot.wires["can0"].off
