"""Whoever reaches a bus over multicast may send what no board sends; boards are received on.

The robot and its daemon are two processes that meet in a multicast group, and a third one sends
there. After each attack: the same process, its watchdog fed, memory as before, frames as before,
the bus never given up, and the attack reported in a few lines.
"""

import random
import time

import can
import msgpack
import pytest

from skin_host.config.settings import Bus
from tests.support.datagrams import FRAME
from tests.support.stack import Stack, wait_for
from tests.support.subscriber import Subscriber
from tests.support.watchdog import Watchdog, computed_s, memory_kb

GROWTH_KB = 20_000
#: Of the daemon's own computing: a busy machine only makes it wait.
GAP_S = 1.0
LOG_BYTES = 5_000
TIMES = 200


def frame(**changes: object) -> bytes:
    packed: bytes = msgpack.packb(FRAME | changes)
    return packed


#: A class that no board uses, every address: frames of no bytes, requests, of CAN FD and errors.
RESERVED = [
    frame(arbitration_id=message_class << 8 | number, dlc=0, data=b"")
    for message_class in (1, 5, 6)
    for number in range(256)
]
ATTACKS = {
    "noise": [random.Random(1).randbytes(200) for _ in range(TIMES)],
    "nothing": [b"", b"\x80", b"\xc0"] * TIMES,
    "bomb": [b"\xdd\xff\xff\xff\xff", b"\x81\xc6\xff\xff\xff\xff", b"\x91" * 4000] * TIMES,
    "broken number": [frame(arbitration_id=1248.5), frame(arbitration_id=1e300)] * TIMES,
    "no number": [frame(arbitration_id=float("nan")), frame(arbitration_id="x")] * TIMES,
    "text as a flag": [frame(is_extended_id="x"), frame(is_error_frame="x")] * TIMES,
    "list as a flag": [frame(is_extended_id=[0] * 100), frame(is_remote_frame=[0])] * TIMES,
    "too long": [frame(data=bytes(60_000), dlc=60_000)] * 20,
    "another length": [frame(dlc=3), frame(data=[1] * 8), frame(data="12345678")] * TIMES,
    "a number as data": [frame(data=n) for n in (200_000_000, 2**31, 2**63, -1)] * 20,
    "remote frames": [frame(is_remote_frame=True, data=b"", dlc=n) for n in range(9)] * TIMES,
    "CAN FD": [frame(is_fd=True, data=bytes(64), dlc=64)] * TIMES,
    "reserved addresses": RESERVED * 20,
    "bus off": [frame(is_error_frame=True, arbitration_id=0x40)] * TIMES,
}


@pytest.fixture
def can_bus_settings() -> Bus:
    """A group of its own."""
    settings = Bus(interface="udp_multicast", channel=f"239.74.{random.randrange(64, 128)}.9")
    try:
        with can.Bus(interface="udp_multicast", channel=settings.channel) as bus:
            bus.send(can.Message(arbitration_id=0x7FF))
    except can.CanError:
        pytest.skip("this machine has no network for multicast")
    return settings


@pytest.fixture
def bus_kind() -> str:
    """Robot and daemon are processes of their own."""
    return "multicast"


def test_whoever_reaches_the_bus_stops_nothing(
    stack: Stack, subscriber: Subscriber, watchdog: Watchdog
) -> None:
    daemon = stack.start("run", str(stack.config), "--calibrate")
    watchdog.pid = daemon.pid
    log = stack._said[-1]

    def frames() -> int:
        return len(subscriber.payloads("left_hand/frame"))

    def health() -> dict[str, object]:
        found: dict[str, object] = subscriber.documents("left_hand/health")[-1]
        return found

    wait_for(lambda: frames() > 20, "frames", log.read_text)
    with can.Bus(interface="udp_multicast", channel=stack.bus.channel) as bus:
        for name, datagrams in ATTACKS.items():
            before_kb, since_s = memory_kb(daemon.pid), computed_s(daemon.pid)
            log_bytes = log.stat().st_size
            for number, datagram in enumerate(datagrams):
                bus._multicast.send(datagram)  # type: ignore[attr-defined]
                if number % 20 == 0:
                    time.sleep(0.002)
            seen = frames()
            wait_for(lambda seen=seen: frames() > seen + 20, f"frames after {name}", log.read_text)
            assert daemon.poll() is None, name
            assert watchdog.longest_gap_s(since_s) < GAP_S, name
            assert memory_kb(daemon.pid) - before_kb < GROWTH_KB, name
            assert log.stat().st_size - log_bytes < LOG_BYTES, name
    wait_for(lambda: health()["buses"][0]["state"] == "up", "a bus that is up", health)  # type: ignore[index]
    (port,) = [one["port"] for one in health()["buses"]]  # type: ignore[attr-defined]
    assert port["removals"] == 0
    assert port["damaged"] > 5 * TIMES
    assert any(
        "unreadable" in sentence
        for record in subscriber.documents("left_hand/health")
        for sentence in record["sentences"]
    )
    assert "Traceback" not in log.read_text()
    assert set(stack.stop()) <= {0}
