"""JSON schemas of recorded messages, in the plain form that Foxglove's plots understand."""

from typing import Any

_INTEGER = {"type": "integer"}
_NUMBER = {"type": "number"}
_STRING = {"type": "string"}
_NUMBERS = {"type": "array", "items": _NUMBER}
_INTEGERS = {"type": "array", "items": _INTEGER}
_STRINGS = {"type": "array", "items": _STRING}


def _object(title: str, about: str, **keys: Any) -> dict[str, Any]:
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "description": about,
        "type": "object",
        "properties": keys,
    }


def _about(kind: dict[str, Any], text: str) -> dict[str, Any]:
    return kind | {"description": text}


#: By kind of message: the schema's name, and the schema.
SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    "frame": (
        "skin.frame/1",
        _object(
            "skin.frame/1",
            "Pressure of a part at one instant, one value a taxel",
            schema=_STRING,
            seq=_INTEGER,
            t_ns=_about(_INTEGER, "time of the sweep's last CAN frame, ns since 1970"),
            unit=_STRING,
            scale=_about(_NUMBER, "one unit of the values, in `unit`"),
            values=_INTEGERS,
            valid=_about(_STRING, "hexadecimal mask, bit i is taxel i"),
            beyond_range=_about(_STRING, "hexadecimal mask, bit i is taxel i"),
            raw={"type": "string", "contentEncoding": "base64"},
        ),
    ),
    "touch": (
        "skin.touch/1",
        _object(
            "skin.touch/1",
            "A contact begins, moves or ends",
            schema=_STRING,
            event=_STRING,
            id=_INTEGER,
            seq=_INTEGER,
            t_ns=_INTEGER,
            count=_INTEGER,
            part=_STRING,
            taxels=_INTEGERS,
            centroid_m=_NUMBERS,
            normal=_NUMBERS,
            area_mm2=_NUMBER,
            peak_kpa=_NUMBER,
            mean_kpa=_NUMBER,
            force_n=_NUMBER,
            sigma_m=_NUMBER,
            load={"type": "object"},
            reason=_about(_STRING, "of an end: released, lost or stopped"),
        ),
    ),
    "mark": (
        "skin.mark/1",
        _object(
            "skin.mark/1",
            "A moment that somebody marked",
            schema=_STRING,
            t_ns=_INTEGER,
            text=_STRING,
        ),
    ),
    "slip": (
        "skin.slip/1",
        _object(
            "skin.slip/1",
            "A fingertip begins or ends to slip",
            schema=_STRING,
            event=_STRING,
            id=_INTEGER,
            t_ns=_INTEGER,
            count=_INTEGER,
            part=_STRING,
            cause=_STRING,
            force_n=_NUMBER,
            shear_n=_NUMBER,
            shear_rate_n_s=_NUMBER,
        ),
    ),
    "over": (
        "skin.over/1",
        _object(
            "skin.over/1",
            "A fingertip begins or ends to press too hard",
            schema=_STRING,
            event=_STRING,
            id=_INTEGER,
            t_ns=_INTEGER,
            count=_INTEGER,
            part=_STRING,
            force_n=_NUMBER,
        ),
    ),
    "health": (
        "skin.health/1",
        _object(
            "skin.health/1",
            "Health of a part",
            schema=_STRING,
            part=_STRING,
            state=_STRING,
            rate_hz=_NUMBER,
            taxels=_INTEGER,
            valid_taxels=_INTEGER,
            sentences=_STRINGS,
        ),
    ),
    "info": (
        "skin.info/1",
        _object(
            "skin.info/1",
            "Description of a node: its parts, the order and places of their taxels",
            schema=_STRING,
            robot=_STRING,
            node=_STRING,
            version=_STRING,
            parts={"type": "object"},
        ),
    ),
    "contact": (
        "skin.contact",
        _object(
            "skin.contact", "Whether anything touches a part: ON, OFF or UNKNOWN", text=_STRING
        ),
    ),
    "status": (
        "skin.status",
        _object("skin.status", "Whether a node is connected: online or offline", text=_STRING),
    ),
    "can": (
        "skin.can/1",
        _object(
            "skin.can/1",
            "CAN frames of one channel: times, identifiers (flags as SocketCAN's), data in hex",
            t_ns=_INTEGERS,
            id=_INTEGERS,
            data=_STRINGS,
            dropped=_INTEGER,
        ),
    ),
}
