"""The DBC file says what the wire's own code says: checked against cantools."""

from functools import cache
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skin_host.bus.answers import ANSWERS, Discovered, FirmwareVersion, answer_frame
from skin_host.bus.commands import (
    COMMANDS,
    SetBoardConfig,
    SetTransmissionPeriod,
    SetTriangleConfig,
    SetTxMode,
    TactileSetup,
    command_frame,
)
from skin_host.bus.dbc import dbc_text
from skin_host.bus.strain import (
    FullScale,
    GetFullScale,
    StrainMode,
    StrainType,
    start_frames,
)
from skin_host.bus.wire import encode_sweep, status_word
from skin_host.config.settings import changed, load
from skin_host.errors import RequestError
from skin_host.layout import build_layout
from tests.support.strain import encode_strain

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


WORDS = st.lists(st.integers(-0x8000, 0x7FFF), min_size=3, max_size=3)


@given(board=st.integers(1, 14), kind=st.sampled_from(StrainType), values=WORDS)
def test_force_and_torque_are_decoded_alike(
    board: int, kind: StrainType, values: list[int]
) -> None:
    can_id, payload = encode_strain(board, kind, values)
    seen = decode(every_board(), can_id, payload)
    quantity = "torque" if kind in (StrainType.TORQUE, StrainType.RAW_TORQUE) else "force"
    assert seen == {f"{quantity}_{axis}": value for axis, value in zip("xyz", values, strict=True)}
    can_id, payload = encode_strain(board, kind, values, overflow=5)
    assert decode(every_board(), can_id, payload) == seen | {"saturated": 5}


@cache
def fingers() -> Any:
    settings = load(CONFIG / "fingertips.toml")
    scale = (33.3, 40.0, 50.0, 0.5, 0.75, 1.0)
    settings = changed(settings, {"fingertips.thumb.full_scale": scale})
    text = dbc_text(build_layout(settings, CONFIG), fingertips=settings.fingertips)
    return cantools.database.load_string(text, "dbc", strict=True)


@given(values=WORDS)
def test_with_the_full_scales_force_and_torque_have_units(values: list[int]) -> None:
    for kind, quantity, unit, scales in (
        (StrainType.FORCE, "force", "N", (33.3, 40.0, 50.0)),
        (StrainType.TORQUE, "torque", "Nm", (0.5, 0.75, 1.0)),
    ):
        can_id, payload = encode_strain(2, kind, values)
        message = fingers().get_message_by_frame_id(can_id)
        assert message.name == f"thumb_{quantity}"
        assert message.senders == ["thumb"]
        assert message.get_signal_by_name(f"{quantity}_x").unit == unit
        seen = decode(fingers(), can_id, payload)
        wanted = [value * scale / 0x8000 for value, scale in zip(values, scales, strict=True)]
        assert list(seen.values()) == pytest.approx(wanted, abs=1e-9)


def test_where_a_full_scale_is_not_known_no_unit_is_claimed() -> None:
    message = fingers().get_message_by_frame_id(encode_strain(1, StrainType.FORCE, [0, 0, 0])[0])
    assert message.name == "index_force"
    assert message.comment == "in 1/32768 of the full scale of each channel"
    assert {signal.unit for signal in message.signals} == {None}


@pytest.mark.parametrize("database", [every_board, fingers])
def test_commands_to_a_force_torque_board_are_decoded_alike(database: Any) -> None:
    seen = [decode(database(), can_id, payload) for can_id, payload in start_frames(2, 10)]
    codes = [GetFullScale.CODE] * 12 + [SetTransmissionPeriod.CODE, SetTxMode.CODE]
    assert [one["Code"] for one in seen] == codes
    assert [one["C18_channel"] for one in seen[:12]] == 2 * list(range(6))
    assert seen[12]["C08_period_ms"] == 10
    assert seen[13]["C07_mode"] == StrainMode.CALIBRATED
    # The one number with its high byte first.
    can_id, payload = answer_frame(FullScale(4, 0x1234), 2)
    seen_answer = decode(database(), can_id, payload)
    assert (seen_answer["C18_channel"], seen_answer["C18_value"]) == (4, 0x1234)


def test_a_sensor_with_the_name_of_a_board_gets_one_of_its_own() -> None:
    settings = load(CONFIG / "fingertips.toml")
    settings = changed(settings, {"fingertips": {"hand": settings.fingertips["thumb"]}})
    text = dbc_text(build_layout(settings, CONFIG), fingertips=settings.fingertips)
    database = cantools.database.load_string(text, "dbc", strict=True)
    assert {node.name for node in database.nodes} == {"host", "hand", "hand_ft"}


def test_each_board_has_a_name_of_its_own_though_a_dbc_file_has_fewer_letters() -> None:
    """`arm-1` and `arm_1` both were `arm_1`, so that who looks a frame up by its name got the other
    board's.
    """
    settings = load(CONFIG / "demo.toml")
    names = dict(zip(settings.boards, ("arm-1", "arm_1", "1"), strict=True))
    parts = {
        name: replace(
            part, patches=[replace(patch, board=names[patch.board]) for patch in part.patches]
        )
        for name, part in settings.parts.items()
    }
    boards = {names[name]: board for name, board in settings.boards.items()}
    settings = changed(settings, {"boards": boards, "parts": parts})
    database = cantools.database.load_string(
        dbc_text(build_layout(settings, CONFIG)), "dbc", strict=True
    )
    assert [node.name for node in database.nodes] == ["host", "arm_1", "arm_1_", "board_1"]
    messages = [message.name for message in database.messages]
    assert len(set(messages)) == len(messages)


def test_of_several_buses_one_must_be_named() -> None:
    icub = layout("icub")
    with pytest.raises(RequestError, match="several buses; choose one: left_arm, right_arm"):
        dbc_text(icub)
    with pytest.raises(RequestError, match='no bus "can9"'):
        dbc_text(icub, "can9")
    database = cantools.database.load_string(dbc_text(icub, "torso"), "dbc", strict=True)
    assert {node.name for node in database.nodes} >= {"torso_1", "torso_4"}


def test_signal_names_are_short_enough_for_every_reader() -> None:
    for message in every_board().messages:
        assert len(message.name) <= 32
        assert all(len(signal.name) <= 32 for signal in message.signals)
