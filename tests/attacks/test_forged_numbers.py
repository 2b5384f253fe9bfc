"""Numbers that somebody forges do not make a node's own numbers unreadable."""

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from skin_host.mqtt.order import Numbers, Stamp, put_stamp, stamp_of


@pytest.mark.parametrize("forged", [10**18 * 8, 10**19 - 1, 10**19 - 2])
def test_a_node_that_met_a_forged_stamp_is_understood(forged: int) -> None:
    numbers = Numbers(lambda: 1_700_000_000_000_000_000, lambda: 0)
    for more in range(3):
        numbers.overtake(Stamp(forged + more, 1))
        numbers.connect()
    properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
    put_stamp(properties, numbers.state())
    assert stamp_of(properties) == Stamp(numbers.connection, 2)


def test_a_run_whose_clock_was_ahead_is_overtaken() -> None:
    numbers = Numbers(lambda: 1_700_000_000_000_000_000, lambda: 0)
    assert numbers.overtake(Stamp(4_000_000_000_000_000_000, 1))
    assert numbers.run > 4_000_000_000_000_000_000
