"""What python-can sends over multicast."""

#: A frame, before it is packed with msgpack.
FRAME: dict[str, object] = {
    "timestamp": 0.0,
    "arbitration_id": 0x4E0,
    "is_extended_id": False,
    "is_remote_frame": False,
    "is_error_frame": False,
    "channel": None,
    "dlc": 8,
    "data": bytes(8),
    "is_fd": False,
    "bitrate_switch": False,
    "error_state_indicator": False,
}
