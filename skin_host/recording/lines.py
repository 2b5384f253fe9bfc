"""Lines of `skin replay`: published messages, one JSON object per line with its type. Pure."""

from collections import Counter
from typing import Any

import msgspec
import numpy as np

from skin_host.fingertip.events import FingertipEvent, SlipEvent
from skin_host.mqtt.grasping import grasp_message
from skin_host.mqtt.messages import KPA_DECIMALS, health_keys, touch_message
from skin_host.processing.events import TouchEvent
from skin_host.processing.pipeline import PressureFrame

_encoder = msgspec.json.Encoder()


def frame_line(frame: PressureFrame) -> bytes:
    """Write a frame as a line: arrays of all taxels, kPa with three decimals."""
    # Adding 0 turns a rounded -0.0 into 0.0.
    pressure = np.round(frame.pressure_kpa.astype(np.float64), KPA_DECIMALS) + 0.0
    return _line(
        "frame",
        {
            "part": frame.part,
            "seq": frame.seq,
            "t_ns": frame.t_ns,
            "raw": frame.raw.tolist(),
            "pressure_kpa": pressure.tolist(),
            "touched": frame.touched.tolist(),
            "valid": frame.valid.tolist(),
        },
    )


def health_line(record: Any) -> bytes:
    """Write a health record as a line: the payload as published, and its type."""
    return _line("health", health_keys(record))


class EventLines:
    """Events as lines: the payload as published, and its type; numbered."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, type]] = Counter()

    def line(self, event: FingertipEvent) -> bytes:
        """A touch, slip, or excess as a line."""
        key = event.part, type(event)
        self._counts[key] += 1
        count = self._counts[key]
        if isinstance(event, TouchEvent):
            return _line("touch", msgspec.to_builtins(touch_message(event, count)))
        kind = "slip" if isinstance(event, SlipEvent) else "over"
        return _line(kind, msgspec.to_builtins(grasp_message(event, count)))


def _line(kind: str, keys: dict[str, Any]) -> bytes:
    return _encoder.encode({"type": kind} | keys) + b"\n"
