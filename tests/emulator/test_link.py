"""The emulator's side of a bus that python-can reads frame by frame."""

import can

from emulator.link import BoardLink


def message(identifier: int, data: bytes = b"", **kind: bool) -> can.Message:
    kind.setdefault("is_extended_id", False)
    return can.Message(arbitration_id=identifier, data=data, **kind)


def test_a_command_behind_any_number_of_other_frames_is_received_at_once() -> None:
    """As on udp_multicast, which gives a sender its own stream back."""
    with (
        can.Bus(interface="virtual", channel="emulators-link") as boards,
        can.Bus(interface="virtual", channel="emulators-link") as others,
    ):
        link = BoardLink("can0", boards)
        for _ in range(1000):
            others.send(message(0x4E0, bytes(8)))
        for other in (
            message(0x21E, b"\x01"),
            message(0x20E, b"\x01", is_extended_id=True),
            message(0x20E, is_remote_frame=True),
            message(0x20E, bytes(64), is_fd=True),
        ):
            others.send(other)
        others.send(message(0x20E, b"\x07\x00"))
        others.send(message(0x70E, b"\xff"))
        assert list(link.received()) == [(0x20E, b"\x07\x00"), (0x70E, b"\xff")]
