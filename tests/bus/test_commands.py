"""Commands to the boards, against the bytes of the firmware's documents and bench scripts."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus import answers, commands
from skin_host.bus.answers import (
    Discovered,
    DiscoveredBootloader,
    FirmwareVersion,
    PingAnswer,
    TxOverflow,
    parse_answer,
)
from skin_host.bus.commands import (
    AccGyroSetup,
    Discover,
    GetFirmwareVersion,
    Ping,
    SetBoardAddress,
    SetBoardConfig,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    TactileSetup2,
    TxMode,
    command_frame,
    parse_command,
)


@pytest.mark.parametrize(
    ("command", "address", "frame"),
    [
        # The protocol document's own example, board 1.
        (SetBoardConfig(0, 0x32, 0xF5), 1, "201#4D0032F5"),
        (SetTriangleConfig(0, 15, 2, 0, 0x2200), 1, "201#50000F02000022"),
        (SetTriangleConfig(0, 1, 2, 1, 0x2200), 1, "201#50000102010022"),
        (SetTxMode(TxMode.START), 1, "201#0700"),
        # The bench script reset_tax.sh, board 10, with the byte order it really sends.
        (SetBoardConfig(1, 0x64, 0xF0), 10, "20A#4D0164F0"),
        (SetTriangleConfig(0, 15, 2, 1, 0x0022), 10, "20A#50000F02012200"),
        (SetTriangleConfig(0, 15, 0, 1, 0x0000), 10, "20A#50000F00010000"),
        # The obsolete set-ups with the hosts' default payloads.
        (TactileSetup(), 5, "205#4C01010100200000"),
        (TactileSetup(timer_flag=3, timer=0x3500), 5, "205#4C01010300200035"),
        (TactileSetup2(), 5, "205#4E0222F000FFFF0A"),
        (AccGyroSetup(0x0A, 20), 3, "203#4F0A14"),
        (SetBoardAddress(9), 3, "203#3209"),
        (GetFirmwareVersion(2, 0), 3, "203#1C0200"),
        (Discover(), 15, "70F#FF"),
        (Ping(), 4, "704#04"),
    ],
)
def test_a_command_has_the_bytes_of_the_document(command, address, frame):
    can_id, payload = command_frame(command, address)
    assert f"{can_id:03X}#{payload.hex().upper()}" == frame
    assert parse_command(can_id, payload) == (address, command)


@pytest.mark.parametrize(
    ("frame", "answer"),
    [
        ("210#1C0B011900020001", (1, FirmwareVersion(11, 1, 25, 0, 2, 0, 1))),
        ("710#FF0B011900", (1, Discovered(11, 1, 25, 0))),
        ("7E0#FF050102", (14, DiscoveredBootloader(5, 1, 2))),
        ("750#0401", (5, PingAnswer(1))),
        ("755#", (5, TxOverflow())),
    ],
)
def test_an_answer_is_understood(frame, answer):
    can_id, _, payload = frame.partition("#")
    assert parse_answer(int(can_id, 16), bytes.fromhex(payload)) == answer


@pytest.mark.parametrize("frame", ["201#4D00", "410#4D0032F5", "20F#", "200#0700", "101#0700"])
def test_what_is_no_command_is_none(frame):
    can_id, _, payload = frame.partition("#")
    assert parse_command(int(can_id, 16), bytes.fromhex(payload)) is None


def test_a_field_that_does_not_fit_its_byte_is_refused():
    with pytest.raises(ValueError, match="period_ms=300"):
        SetBoardConfig(0, 300, 0xF0).encode()


@given(st.integers(0, 0xFFFFFFFF), st.binary(max_size=8))
def test_garbage_never_breaks_the_parsers(can_id, payload):
    for parse in (parse_command, parse_answer):
        parsed = parse(can_id, payload)
        assert parsed is None or 1 <= parsed[0] <= 15


@pytest.mark.parametrize("kind", commands.COMMANDS + answers.ANSWERS)
def test_every_message_survives_the_wire(kind):
    values = kind.LAYOUT.unpack(bytes(range(1, kind.LAYOUT.size + 1)))
    message = kind(*values)
    assert kind.decode(message.encode()) == message
    assert len(message.encode()) <= 8
    assert len(dataclasses.fields(kind)) == len(values)
