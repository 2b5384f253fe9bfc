"""The live stack beside the tools that people have: candump, cansend, mosquitto_sub."""

import json
import subprocess

from tests.stack.test_three_presses import SCENE
from tests.support import programs
from tests.support.stack import Stack, wait_for
from tests.support.subscriber import Subscriber

#: Unknown board, wrong header, too short, other class, extended, remote, DLC 0.
GARBAGE = ["490#40F0F0F0F0F0F0F0", "4E0#41F0F0F0F0F0F0F0", "4E0#40F0F0", "0FF#0102"]
GARBAGE += ["14E0EEEE#4000000000000000", "4E0#R", "4E0#", "7FF#0011223344556677"]


def test_candump_shows_the_frames_of_the_protocol(stack: Stack):
    stack.calibrate()
    stack.start("run", str(stack.config))
    candump = [programs.require("candump"), "-L", "-n", "2000", stack.bus.channel]
    shown = subprocess.run(candump, capture_output=True, text=True, timeout=90, check=True).stdout
    frames = [line.split()[2].split("#") for line in shown.splitlines()]
    skin = [(int(can_id, 16), data) for can_id, data in frames if can_id.startswith("4")]
    assert skin
    for can_id, data in skin:
        assert can_id >> 4 & 0xF in {12, 13, 14}
        assert len(data) == 16
        assert data[:2] in {"40", "C0"}
    # At the start boards may doubt their values; the last sweeps are of settled ones.
    assert {data[12:] for _, data in skin[-132:] if data[:2] == "C0"} == {"0000"}
    stack.stop()


def test_mosquitto_sub_receives_the_touches_of_a_press(stack: Stack):
    stack.calibrate()
    listen = [programs.require("mosquitto_sub"), "-V", "5", "-p", str(stack.broker.port)]
    listen += ["-t", "skin/demo/+/touch", "-C", "30", "-W", "150"]
    listening = subprocess.Popen(listen, stdout=subprocess.PIPE, text=True)
    stack.start("run", str(stack.config), scene=SCENE)
    out, _ = listening.communicate(timeout=160)
    events = [json.loads(line) for line in out.splitlines()]
    assert {event["event"] for event in events} == {"begin", "move", "end"}
    assert {event["part"] for event in events} == {"left_forearm", "left_hand"}
    stack.stop()


def test_garbage_on_the_bus_is_counted_and_nothing_else(stack: Stack, subscriber: Subscriber):
    stack.calibrate()
    daemon = stack.start("run", str(stack.config))

    def bus_record() -> dict:
        records = subscriber.documents("left_hand/health")
        return records[-1]["buses"][0] if records and records[-1]["frames"] else {}

    before = wait_for(bus_record, "health of a hand that sends")
    cansend = programs.require("cansend")
    for frame in GARBAGE:
        subprocess.run([cansend, stack.bus.channel, frame], check=True)
    expected = {"unknown_board": 1, "wrong_header": 1, "short": 1}

    def counted() -> bool:
        now = bus_record()
        return all(now[name] - before[name] == count for name, count in expected.items())

    wait_for(counted, f"counters {expected}")
    now = bus_record()
    assert now["incomplete"] == before["incomplete"]
    assert not any(subscriber.payloads("/touch"))
    assert daemon.poll() is None
    stack.stop()
