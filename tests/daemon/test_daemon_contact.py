"""What the daemon publishes as contact, from its start to its end, over real buses and faults."""

from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from emulator.probes.scene import Fault, Place, Probe, Scene
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus
from skin_host.daemon.daemon import Daemon
from skin_host.mqtt.messages import ContactState
from tests.support.broker import Mosquitto
from tests.support.live import FINGER_N, Live, living
from tests.support.stepped import stepped
from tests.support.subscriber import Subscriber


@pytest.fixture
async def subscriber(mosquitto: Mosquitto) -> AsyncIterator[Subscriber]:
    listening = Subscriber(mosquitto.host, mosquitto.port, "skin/demo/#")
    yield listening
    listening.close()


async def until_contact(live: Live, subscriber: Subscriber, part: str, state: bytes) -> None:
    await live.wait(lambda: subscriber.payloads(f"{part}/contact")[-1:] == [state])


async def test_a_board_that_dies_during_a_touch_never_looks_untouched(
    can_bus_settings: Bus, tmp_path: Path, mosquitto: Mosquitto, subscriber: Subscriber
) -> None:
    async with living(can_bus_settings, tmp_path, port=mosquitto.port) as live:
        live.finger().press(FINGER_N)
        await until_contact(live, subscriber, "left_hand", b"ON")
        live.robot.inject(Fault(name="board_silent", board="hand"))
        await until_contact(live, subscriber, "left_hand", b"UNKNOWN")
        await live.wait(lambda: subscriber.documents("left_hand/touch")[-1]["event"] == "end")
        assert subscriber.documents("left_hand/touch")[-1]["reason"] == "lost"
        assert subscriber.payloads("left_forearm/contact")[-1] == b"OFF"
    subscriber.catch_up()
    assert b"OFF" not in subscriber.payloads("left_hand/contact")[3:]


def press_of_the_hand(until_s: float) -> Scene:
    """A press that begins after eight seconds and lasts for so long."""
    course = [(0, 0), (0.1, 60), (until_s, 60), (until_s + 0.1, 0), (1000, 0)]
    place = Place(triangle=4)
    press = Probe(part="left_hand", at=place, diameter_mm=10, pressure_kpa=course, start_s=8.0)
    return Scene(quiet=True, probe=[press])


def states_of_the_hand(daemon: Daemon) -> list[str]:
    """Return a list of what is published as contact of the hand from now on."""
    states: list[str] = []

    def note(part: str, state: ContactState) -> None:
        if part == "left_hand":
            states.append(state)

    daemon.publisher.put_contact = note  # type: ignore[method-assign]
    return states


@stepped
async def test_a_part_that_is_enabled_again_may_be_touched_where_it_failed_meanwhile(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """A pad was pressed while nothing of its part was published, and nobody saw it released."""
    bus, scene = Bus(interface="virtual", channel="enabled"), press_of_the_hand(8.0)
    async with living(bus, tmp_path, scene=scene, clock=clock) as live:
        daemon = live.daemon
        await live.until_well(but=frozenset({"board_rezeroed"}))
        said = states_of_the_hand(daemon)
        daemon.disable(0)
        zeros, board = daemon.engine.zeros, daemon.layout.boards[0]
        await live.wait(lambda: bool(zeros.at_risk(touched=True).any()))
        await clock.sleep(1.0)
        taxel = int(np.flatnonzero(zeros.at_risk(touched=True))[0])
        triangle, pad = np.argwhere(board.taxel_index == taxel)[0].tolist()
        mend = live.robot.inject(
            Fault(name="noisy_taxel", board="hand", triangle=triangle, taxel=pad, value=20)
        )
        await clock.sleep(9.0)
        said.clear()
        daemon.enable(0)
        await clock.sleep(2.0)
        assert set(said) == {"UNKNOWN"}
        mend()
        await clock.sleep(5.0)
        assert said[-1] == "OFF"


@stepped
async def test_a_pad_that_stuck_in_a_touch_keeps_its_part_unknown_until_a_calibration(
    clock: SteppedClock, tmp_path: Path
) -> None:
    """Nobody can see it released, and a calibration at rest has nothing new of it either."""
    bus, scene = Bus(interface="virtual", channel="stuck"), press_of_the_hand(4.0)
    async with living(bus, tmp_path, scene=scene, clock=clock) as live:
        daemon = live.daemon
        await live.until_well(but=frozenset({"board_rezeroed"}))
        states = states_of_the_hand(daemon)
        zeros, board = daemon.engine.zeros, daemon.layout.boards[0]
        await live.wait(lambda: bool(zeros.felt.any()))
        taxel = int(np.flatnonzero(zeros.felt)[0])
        triangle, pad = np.argwhere(board.taxel_index == taxel)[0].tolist()
        live.robot.inject(Fault(name="stuck_taxel", board="hand", triangle=triangle, taxel=pad))
        await live.wait(lambda: bool(daemon.engine.stuck()[taxel]))
        await clock.sleep(60.0)
        assert states[-1] == "UNKNOWN"
        await daemon.calibrate(5.0)
        assert daemon.engine.stuck()[taxel]
        await clock.sleep(5.0)
        assert states[-1] == "OFF"


async def test_after_a_restart_a_silent_board_is_unknown_whatever_the_broker_kept(
    can_bus_settings: Bus, tmp_path: Path, mosquitto: Mosquitto
) -> None:
    before = Subscriber(mosquitto.host, mosquitto.port, "skin/demo/+/contact")
    async with living(can_bus_settings, tmp_path, port=mosquitto.port) as live:
        await until_contact(live, before, "left_hand", b"OFF")
        await until_contact(live, before, "left_forearm", b"OFF")
    before.close()
    kept = Subscriber(mosquitto.host, mosquitto.port, "skin/demo/+/contact")
    assert set(kept.wait_for(2).values()) == {b"UNKNOWN"}  # stopped in good order
    kept.close()
    kept = Subscriber(mosquitto.host, mosquitto.port, "skin/demo/+/contact")
    async with living(can_bus_settings, tmp_path, port=mosquitto.port, hung=["hand"]) as live:
        await until_contact(live, kept, "left_forearm", b"OFF")
        await live.until("board_absent")
        assert set(kept.payloads("left_hand/contact")) == {b"UNKNOWN"}
    kept.close()


async def test_a_touch_that_lasts_at_the_end_is_stopped_not_released(
    can_bus_settings: Bus, tmp_path: Path, mosquitto: Mosquitto, subscriber: Subscriber
) -> None:
    async with living(can_bus_settings, tmp_path, port=mosquitto.port) as live:
        live.finger().press(FINGER_N)
        await until_contact(live, subscriber, "left_hand", b"ON")
    await live.wait(lambda: subscriber.payloads("main/status")[-1:] == [b"offline"])
    assert subscriber.documents("left_hand/touch")[-1]["reason"] == "stopped"
    assert subscriber.payloads("left_hand/contact")[-1] == b"UNKNOWN"


async def test_a_part_that_is_disabled_is_unknown(
    can_bus_settings: Bus, tmp_path: Path, mosquitto: Mosquitto, subscriber: Subscriber
) -> None:
    async with living(can_bus_settings, tmp_path, port=mosquitto.port) as live:
        await until_contact(live, subscriber, "left_hand", b"OFF")
        await live.daemon.control.handle("disable", b'{"part":"left_hand"}')
        await until_contact(live, subscriber, "left_hand", b"UNKNOWN")
        await live.daemon.control.handle("enable", b'{"part":"left_hand"}')
        await until_contact(live, subscriber, "left_hand", b"OFF")
