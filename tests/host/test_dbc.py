"""The DBC file says what the wire's own code says: checked against cantools."""

from functools import cache
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus.protocol import encode_sweep, status_word
from skin_host.bus.protocol.answers import ANSWERS, Discovered, FirmwareVersion, answer_frame
from skin_host.bus.protocol.commands import (
    COMMANDS,
    SetBoardConfig,
    SetTriangleConfig,
    TactileSetup,
    command_frame,
)
from skin_host.dbc import dbc_text
from skin_host.errors import RequestError
from skin_host.layout import build_layout
from skin_host.settings import load

CONFIG = Path(__file__).parents[2] / "config"


@cache
def every_board() -> Any:
    return cantools.database.load_string(dbc_text(), "dbc", strict=True)


def layout(name: str) -> Any:
    return build_layout(load(CONFIG / f"{name}.toml"), CONFIG)


def decode(database: Any, can_id: int, payload: bytes) -> dict[str, Any]:
    decoded: dict[str, Any] = database.decode_message(
        can_id, payload, decode_choices=False, allow_truncated=True
    )
    return decoded


@given(
    board=st.integers(1, 14),
    triangle=st.integers(0, 15),
    values=st.lists(st.integers(0, 255), min_size=12, max_size=12),
    mask=st.integers(0, 0xFFF),
    error=st.integers(0, 2),
)
def test_skin_frames_are_decoded_alike(
    board: int, triangle: int, values: list[int], mask: int, error: int
) -> None:
    far = np.array([[mask >> taxel & 1 for taxel in range(12)]], np.bool_)
    status = status_word(far, np.array([error], np.uint8))
    raw = np.array([values], np.uint8)
    can_ids, data = encode_sweep(board, np.array([triangle]), raw, status)
    seen: dict[str, Any] = {}
    for can_id, payload in zip(can_ids.tolist(), data, strict=True):
        seen |= decode(every_board(), can_id, payload.tobytes())
    assert [seen[f"Taxel{taxel}"] for taxel in range(12)] == values
    assert seen["OutOfRange"] == mask
    assert seen["NoAck"] == error & 1
    assert seen["NotConnected"] == error >> 1


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            SetBoardConfig(skin_type=8, period_ms=50, no_load=240),
            {"C4D_skin_type": 8, "C4D_period_ms": 50, "C4D_no_load": 240},
        ),
        (
            SetTriangleConfig(0, 15, 2, 1, 0x2200),
            {
                "C50_first": 0,
                "C50_last": 15,
                "C50_shift": 2,
                "C50_flags": 1,
                "C50_cdc_offset": 0x2200,
            },
        ),
        (TactileSetup(timer=0x3500), {"C4C_cdc_offset": 0x2000, "C4C_timer": 0x3500 * 3.2}),
    ],
)
def test_commands_are_decoded_alike(command: Any, expected: Any) -> None:
    can_id, payload = command_frame(command, 9)
    seen = decode(every_board(), can_id, payload)
    assert seen["Code"] == command.CODE
    assert {name: seen[name] for name in expected} == pytest.approx(expected)
    assert every_board().get_message_by_frame_id(can_id).name == "MTB9_command"


def test_answers_are_decoded_alike() -> None:
    can_id, payload = answer_frame(FirmwareVersion(11, 1, 25, 0, 2, 0, 1), 3)
    seen = decode(every_board(), can_id, payload)
    assert (seen["C1C_board_type"], seen["C1C_firmware_minor"]) == (11, 25)
    can_id, payload = answer_frame(Discovered(11, 1, 25, 7), 3)
    seen = decode(every_board(), can_id, payload)
    assert (seen["CFF_board_type"], seen["CFF_firmware_build"]) == (11, 7)


def test_every_command_and_answer_is_named() -> None:
    for kinds, frame in ((COMMANDS, command_frame), (ANSWERS, answer_frame)):
        for kind in kinds:
            if kind.__name__ == "DiscoveredBootloader":
                continue  # shares its code and first fields with Discovered
            fields = kind.LAYOUT.unpack(bytes(kind.LAYOUT.size))
            can_id, payload = frame(kind(*fields), 5)
            message = every_board().decode_message(can_id, payload, allow_truncated=True)
            assert str(message["Code"]) == kind.__name__


def test_a_configuration_gives_its_own_boards_and_triangles() -> None:
    database = cantools.database.load_string(dbc_text(layout("demo")), "dbc", strict=True)
    message = database.get_message_by_frame_id(0x4E0 | 9)
    assert message.name == "hand_T09"
    assert message.comment == "left_hand, taxels 72 to 83"
    assert message.senders == ["hand"]
    with pytest.raises(KeyError):
        database.get_message_by_frame_id(0x4E0 | 5)  # no such triangle in the hand
    with pytest.raises(KeyError):
        database.get_message_by_frame_id(0x410)  # no such board


def test_of_several_buses_one_must_be_named() -> None:
    icub = layout("icub")
    with pytest.raises(RequestError, match="several buses; say which: left_arm, right_arm"):
        dbc_text(icub)
    with pytest.raises(RequestError, match='no bus "can9"'):
        dbc_text(icub, "can9")
    database = cantools.database.load_string(dbc_text(icub, "torso"), "dbc", strict=True)
    assert {node.name for node in database.nodes} >= {"torso_1", "torso_4"}


def test_signal_names_are_short_enough_for_every_reader() -> None:
    for message in every_board().messages:
        assert len(message.name) <= 32
        assert all(len(signal.name) <= 32 for signal in message.signals)
