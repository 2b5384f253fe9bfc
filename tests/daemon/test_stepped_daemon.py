"""The whole daemon lives by the clock that it is given: robot, buses and host in one event loop."""

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.probes.scene import Fault, Place, Probe, Scene
from skin_host.clock import EPOCH_NS, SteppedClock
from skin_host.config.settings import Bus
from skin_host.health import Record
from skin_host.mqtt.messages import ContactState
from skin_host.mqtt.publisher import Publisher
from skin_host.processing.contacts import LOST_NS
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from tests.support.live import Live, living
from tests.support.stack import ROOT
from tests.support.stepped import stepped

PRESS = Probe(
    part="left_hand",
    at=Place(triangle=4),
    diameter_mm=10,
    pressure_kpa=[(0, 0), (0.1, 60), (0.5, 60), (0.6, 0)],
    start_s=6.0,
    repeat_s=2.0,
)
LATELY = frozenset({"board_rezeroed"})
KASPAR = ROOT / "config" / "kaspar.toml"


@asynccontextmanager
async def well(
    clock: SteppedClock, state: Path, channel: str, *probes: Probe
) -> AsyncIterator[Live]:
    """A daemon and its robot, from when nothing is wrong with them."""
    bus, scene = Bus(interface="virtual", channel=channel), Scene(quiet=True, probe=[*probes])
    async with living(bus, state, scene=scene, clock=clock) as live:
        await live.until_well(but=LATELY)
        yield live


async def lived(clock: SteppedClock, state: Path, channel: str) -> list[object]:
    """Some seconds of a robot that is pressed now and then, as its touches were published."""
    said: list[object] = []
    bus = Bus(interface="virtual", channel=channel)
    async with living(bus, state, scene=Scene(quiet=True, probe=[PRESS]), clock=clock) as live:
        put = live.daemon.publisher.put_touch

        def note(event: Touch) -> None:
            said.append((event.event, event.id, event.t_ns, event.taxels, event.force_n))
            put(event)

        live.daemon.publisher.put_touch = note  # type: ignore[method-assign]
        await live.until_well(but=LATELY)
        await clock.sleep(8.0)
    return said


def run(state: Path, channel: str) -> list[object]:
    clock = SteppedClock()
    with clock.runner() as runner:
        return runner.run(lived(clock, state, channel))


def test_the_life_of_a_daemon_is_the_same_every_time(tmp_path: Path) -> None:
    first = run(tmp_path / "a", "stepped-a")
    kinds = [event[0] for event in first]  # type: ignore[index]
    assert kinds.count("begin") >= 2
    assert kinds.count("begin") == kinds.count("end")
    assert first[0][2] > EPOCH_NS  # type: ignore[index]
    assert run(tmp_path / "b", "stepped-b") == first


@stepped
async def test_a_process_that_stood_still_takes_no_board_for_silent(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with well(clock, tmp_path, "stepped-c") as live:
        ledger = live.daemon.engine.ledger
        clock.advance(3.0)
        await clock.sleep(0.5)
        assert not ledger.silences.any()


@stepped
async def test_what_was_untouched_before_a_process_stood_still_is_unknown_until_it_is_felt_again(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """Whatever presses it was not read, and health would publish the old state again."""
    async with well(clock, tmp_path, "stepped-o") as live:
        publisher = live.daemon.publisher
        await live.wait(lambda: publisher._states_of_contact["left_hand"] == "OFF")
        states: list[tuple[float, bytes]] = []
        put = publisher._outbox.put_state

        def note(topic: str, payload: bytes) -> None:
            if topic.endswith("/left_hand/contact"):
                states.append((clock.monotonic_s(), payload))
            put(topic, payload)

        late_ns: list[int] = []
        put_frame = publisher.put_frame

        def note_frame(frame: PressureFrame) -> None:
            late_ns.append(clock.now_ns() - frame.t_ns)
            put_frame(frame)

        publisher._outbox.put_state = note  # type: ignore[method-assign]
        publisher.put_frame = note_frame
        for stood_s in (0.6, 3.0, 60.0):
            states.clear()
            clock.advance(stood_s)
            went_on_s = clock.monotonic_s()
            await clock.sleep(2.0)
            assert [state for _, state in states][:2] == [b"UNKNOWN", b"OFF"]
            assert states[0][0] - went_on_s < 0.1
            assert states[1][0] - went_on_s > 0.1
        assert 0 < max(late_ns) < LOST_NS
        states.clear()
        clock.advance(0.4)  # as long as a triangle may miss its frames
        await clock.sleep(1.0)
        assert b"UNKNOWN" not in [state for _, state in states]


@stepped
async def test_what_no_fingertip_felt_before_a_process_stood_still_is_unknown_until_it_is_received(
    clock: SteppedClock, tmp_path: Path
) -> None:
    bus, config = Bus(interface="virtual", channel="stepped-p"), ROOT / "config" / "fingertips.toml"
    async with living(bus, tmp_path, config=config, scene=Scene(quiet=True), clock=clock) as live:
        publisher = live.daemon.publisher
        await live.wait(lambda: {*publisher._states_of_contact.values()} == {"OFF"})
        clock.advance(3.0)
        await clock.sleep(0.05)
        assert {*publisher._states_of_contact.values()} == {"UNKNOWN"}
        await clock.sleep(1.0)
        assert {*publisher._states_of_contact.values()} == {"OFF"}


@stepped
async def test_a_clock_that_is_set_costs_no_board(clock: SteppedClock, tmp_path: Path) -> None:
    async with well(clock, tmp_path, "stepped-d") as live:
        ledger = live.daemon.engine.ledger
        for jump_s in (3600.0, -7200.0):
            clock.set(jump_s)
            await clock.sleep(1.0)
            assert not ledger.silences.any()
            await live.until_well(but=LATELY)


@stepped
async def test_a_clock_that_is_set_changes_no_contact(clock: SteppedClock, tmp_path: Path) -> None:
    lasting = Probe(
        part="left_hand",
        at=Place(triangle=4),
        diameter_mm=10,
        pressure_kpa=[(0, 0), (0.1, 60), (1000, 60)],
        start_s=4.0,
    )
    async with well(clock, tmp_path, "stepped-e", lasting) as live:
        await clock.sleep(4.0)
        publisher = live.daemon.publisher
        put_contact, put_touch = publisher.put_contact, publisher.put_touch
        said: set[tuple[str, str]] = set()

        def note_contact(part: str, state: ContactState) -> None:
            said.add((part, state))
            put_contact(part, state)

        def note_touch(event: Touch) -> None:
            said.add((event.part, event.event))
            put_touch(event)

        publisher.put_contact = note_contact  # type: ignore[method-assign]
        publisher.put_touch = note_touch  # type: ignore[method-assign]
        for jump_s in (-0.7, 3600.0, *[10.0] * 48, -20.0):  # also between the frames of a sweep
            clock.set(jump_s)
            await clock.sleep(0.1511)
        assert said == {("left_hand", "ON"), ("left_hand", "move"), ("left_forearm", "OFF")}


@stepped
@pytest.mark.parametrize("is_asleep", [False, True])
async def test_foam_recovers_while_the_computer_sleeps_and_not_when_its_clock_is_set(
    clock: SteppedClock, tmp_path: Path, is_asleep: bool
) -> None:
    held = Probe(
        part="left_hand",
        at=Place(triangle=4),
        diameter_mm=10,
        pressure_kpa=[(0, 0), (0.1, 60), (20, 60), (20.1, 0), (1000, 0)],
        start_s=4.0,
    )
    async with well(clock, tmp_path, f"stepped-foam-{is_asleep}", held) as live:
        await clock.sleep(24.0)
        pipeline = live.daemon.engine.pipeline
        assert pipeline is not None
        before_kpa = float(pipeline.relaxation_kpa.max())
        (clock.suspend if is_asleep else clock.set)(3600.0)
        await clock.sleep(0.2)
        after_kpa = float(pipeline.relaxation_kpa.max())
        assert before_kpa > 1.0
        assert (after_kpa < 0.6 * before_kpa) == is_asleep
        assert (after_kpa > 0.8 * before_kpa) == (not is_asleep)


@stepped
async def test_a_contact_is_on_in_a_touch_only_also_where_many_frames_are_read_together(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with well(clock, tmp_path, "stepped-k", PRESS) as live:
        await clock.sleep(2.0)
        publisher = live.daemon.publisher
        put_contact, put_touch = publisher.put_contact, publisher.put_touch
        touched: set[int] = set()
        said: list[tuple[ContactState, bool]] = []

        def note_contact(part: str, state: ContactState) -> None:
            if part == "left_hand":
                said.append((state, bool(touched)))
            put_contact(part, state)

        def note_touch(event: Touch) -> None:
            if event.event == "end":
                touched.discard(event.id)
            else:
                touched.add(event.id)
            put_touch(event)

        publisher.put_contact = note_contact  # type: ignore[method-assign]
        publisher.put_touch = note_touch  # type: ignore[method-assign]
        for _ in range(40):
            clock.advance(0.31)
            await clock.sleep(0.06)
        assert ("ON", True) in said
        assert ("ON", False) not in said


@stepped
async def test_a_board_has_its_time_before_it_is_called_absent(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[float, str, str]] = []
    put = Publisher.put_health
    began_s = clock.monotonic_s()

    def note(self: Publisher, part: str, record: Mapping[str, Any]) -> None:
        at_s = clock.monotonic_s() - began_s
        said.extend((at_s, fault["code"], fault["where"]) for fault in record["faults"])
        put(self, part, record)

    monkeypatch.setattr(Publisher, "put_health", note)
    bus = Bus(interface="virtual", channel="stepped-i")
    # First without a calibration, then with one, and the second time a board stays silent.
    async with living(bus, tmp_path, clock=clock) as live:
        await live.until_well(but=LATELY)
    silent = {"bus_silent", "board_absent", "board_silent", "triangle_missing"}
    assert not {code for _, code, _ in said} & silent
    said.clear()
    began_s = clock.monotonic_s()
    async with living(bus, tmp_path, clock=clock, hung=["hand"]) as live:
        await live.until("board_absent")
        await clock.sleep(5.0)
    absent = [at_s for at_s, code, where in said if (code, where) == ("board_absent", "hand")]
    assert 0.5 < absent[0] < 2.0
    assert max(np.diff(absent)) < 1.5  # it does not come and go
    assert {where for _, code, where in said if code in silent} == {"hand"}


@stepped
async def test_what_comes_late_or_is_well_again_is_no_pad_that_fails(
    clock: SteppedClock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whenever health is made, every taxel that is not valid has a reason that is known."""
    async with well(clock, tmp_path, "stepped-j") as live:
        said: set[str] = set()

        async def watched(seconds: float) -> None:
            for _ in range(round(seconds / 0.02)):
                await clock.sleep(0.02)
                said.update(code for code, _ in live.faults())

        for fault in (
            Fault(name="frame_loss", bus="can0", value=0.002),
            Fault(name="chip_gone", board="hand", triangle=2),
            Fault(name="board_silent", board="forearm_outer"),
        ):
            mend = live.robot.inject(fault)
            await watched(1.0)
            mend()
            await watched(2.0)
        assert "board_silent" in said
        assert "taxel_unproven" not in said


@stepped
async def test_health_that_does_not_change_is_worked_out_once_a_second(
    clock: SteppedClock, tmp_path: Path
) -> None:
    async with well(clock, tmp_path, "stepped-h") as live:
        health = live.daemon.health
        record = health.record
        recorded: list[int] = []

        def noted(part: int, *others: Any) -> Record:
            recorded.append(part)
            return record(part, *others)

        health.record = noted  # type: ignore[method-assign]
        await clock.sleep(10.05)
        # A hundred looks; the absent broker is tried again between them.
        assert 10 <= recorded.count(0) <= 25
        recorded.clear()
        live.robot.inject(Fault(name="board_silent", board="hand"))
        await clock.sleep(1.95)
        # Two of them are those of each second.
        assert recorded.count(0) >= 3


@stepped
async def test_boards_that_are_set_up_one_after_the_other_feel_nothing_new(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """Ten boards on one bus: the last one is zeroed seconds after the command."""
    bus = Bus(interface="virtual", channel="stepped-ten")
    async with living(bus, tmp_path, config=KASPAR, calibrate_s=3.0, clock=clock) as live:
        await live.until_well(but=LATELY)
        said: list[Touch] = []
        live.daemon.publisher.put_touch = said.append  # type: ignore[method-assign]
        await live.daemon.configure()
        await clock.sleep(6.0)
        assert not said
