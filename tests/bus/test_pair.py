"""A bus between two processes: what one end sends the other receives, in whole batches."""

import socket

import numpy as np
import pytest

from skin_host.bus.opening import open_port
from skin_host.bus.pair import LONGEST_LAG_NS, MOST_FRAMES, PAIR, PairBus, hand_over, pair
from skin_host.bus.port import LinkState, Port
from skin_host.bus.wire import FrameBatch
from skin_host.config.settings import Bus, Receive
from skin_host.errors import ConfigurationError


def batch(n: int) -> FrameBatch:
    frames = [(0x300 + i % 16, bytes([i % 256, 1, 2]), 10**18 + i) for i in range(n)]
    return FrameBatch.of(frames)


def opened() -> tuple[PairBus, Port]:
    ours, theirs = pair()
    port = open_port("can0", Bus(interface=PAIR, channel=hand_over(ours)), Receive())
    return PairBus(theirs), port


def test_batches_arrive_in_order_with_their_times() -> None:
    far, port = opened()
    sent = batch(MOST_FRAMES + 7)
    assert far.send_batch(sent, sent.t_ns + 5) == 0
    read = port.read()
    assert len(read) == len(sent)
    np.testing.assert_array_equal(read.id, sent.id)
    np.testing.assert_array_equal(read.data, sent.data)
    np.testing.assert_array_equal(read.dlc, sent.dlc)
    np.testing.assert_array_equal(read.t_ns, sent.t_ns + 5)
    assert port.counters.frames == len(sent)
    assert len(port.read()) == 0
    port.close()
    far.shutdown()


async def test_commands_go_the_other_way() -> None:
    far, port = opened()
    await port.send([(0x20E, b"\x32\x01"), (0x20D, b"\x4d")], gap_s=0)
    seen = [far.recv(0), far.recv(0)]
    assert [(one.arbitration_id, bytes(one.data)) for one in seen if one] == [
        (0x20E, b"\x32\x01"),
        (0x20D, b"\x4d"),
    ]
    assert far.recv(0) is None
    port.close()
    far.shutdown()


def test_what_the_other_side_never_reads_is_lost_and_counted() -> None:
    far, port = opened()
    sent = batch(MOST_FRAMES)
    lost = sum(far.send_batch(sent, sent.t_ns) for _ in range(60))
    assert lost > 0
    read = 0
    while n := len(port.read()):
        read += n
        # What waits goes on with the next batch.
        far.send_batch(batch(0), np.zeros(0, np.int64))
    assert read + lost == 60 * MOST_FRAMES
    port.close()
    far.shutdown()


def test_the_bus_is_read_only_as_far_as_the_other_end_has_lived() -> None:
    far, port = opened()
    start_ns = 10**18
    assert port.read_until_ns(start_ns) == start_ns
    for lived_ns, n in ((0, 0), (2_000_000, 3), (30_000_000, 0), (500_000_000, MOST_FRAMES)):
        sent = batch(n)
        far.send_batch(sent, sent.t_ns, start_ns + lived_ns)
        assert len(port.read()) == n
        assert len(port.read()) == 0
        assert port.read_until_ns(start_ns + 10**9) == start_ns + lived_ns
        assert port.read_until_ns(start_ns + lived_ns - 1) == start_ns + lived_ns - 1
    # It does not hold up time for ever.
    assert port.read_until_ns(start_ns + 3600 * 10**9) == start_ns + 3600 * 10**9 - LONGEST_LAG_NS
    far.shutdown()
    port.read()
    assert port.read_until_ns(start_ns + 10**9) == start_ns + 10**9
    port.close()


def test_a_read_that_left_something_is_at_its_capacity() -> None:
    far, port = opened()
    for _ in range(4):
        sent = batch(700)
        far.send_batch(sent, sent.t_ns, 10**18)
    reads = [len(port.read()) for _ in range(3)]
    assert reads == [2100, 700, 0]
    assert reads[0] >= port.capacity > reads[1]
    port.close()
    far.shutdown()


def test_an_end_that_was_closed_is_gone() -> None:
    far, port = opened()
    far.shutdown()
    assert len(port.read()) == 0
    assert port.state is LinkState.GONE
    port.close()


@pytest.mark.parametrize("channel", ["can0", "0", "9" * 20, "-1", "socket"])
def test_a_configuration_cannot_name_a_descriptor_of_this_process(channel: str) -> None:
    """An event loop's own socket would be read, and closed, as if it were a bus."""
    with socket.socket() as own:
        if channel == "socket":
            channel = str(own.fileno())
        for wait in (False, True):
            with pytest.raises(ConfigurationError, match="of `skin demo` alone"):
                open_port("can0", Bus(interface=PAIR, channel=channel), Receive(), wait=wait)
        assert own.fileno() >= 0


def test_an_end_is_handed_over_once() -> None:
    ours, theirs = pair()
    settings = Bus(interface=PAIR, channel=hand_over(ours))
    open_port("can0", settings, Receive()).close()
    with pytest.raises(ConfigurationError):
        open_port("can0", settings, Receive())
    theirs.close()
