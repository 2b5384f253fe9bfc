"""docs/operations.md explains every key of the health record and every fault."""

import re
from pathlib import Path

import pytest

from skin_host.bus.port import PortCounters
from skin_host.health import diagnosis
from skin_host.health.record import BoardHealth, BusHealth, LastSecond, Record
from skin_host.mqtt.outbox import PublisherCounters

PAGE = (Path(__file__).parents[2] / "docs/operations.md").read_text()
WORDS = set(re.findall("[a-z_]+", " ".join(re.findall("`([^`\n]+)`", PAGE.replace("```", "")))))
#: What needs no explanation where it stands.
PLAIN = {"part", "name", "bus", "address", "interface", "channel", "skin_type"}


@pytest.mark.parametrize("kind", [Record, BusHealth, BoardHealth])
def test_every_key_is_explained(kind: type) -> None:
    assert set(kind.__annotations__) - PLAIN <= WORDS


@pytest.mark.parametrize("kind", [PortCounters, PublisherCounters])
def test_every_counter_is_explained(kind: type) -> None:
    assert set(kind.__slots__) <= WORDS


def test_every_gain_of_the_last_second_is_explained() -> None:
    merged = {"frames_hz", "wrong", "unknown", "dropped", "error_frames"}
    assert set(LastSecond.__annotations__) - merged <= WORDS


def test_every_fault_is_explained() -> None:
    source = Path(diagnosis.__file__).read_text()
    codes = set(re.findall(r'"((?:bus|board|line|triangle|taxel|part)s?_[a-z_]+)"', source))
    codes |= {"triangle_" + fault.replace(" ", "_") for fault in diagnosis._TRIANGLE_SENTENCES}
    codes |= {f"taxel_{kind}" for kind in diagnosis._TAXEL_FAULTS}
    keys = set(BoardHealth.__annotations__) | set(BusHealth.__annotations__)
    codes -= keys | {"taxel_faults", "taxel_verdicts", "board_", "triangle_"}
    assert len(codes) > 30
    assert codes <= WORDS
