"""`skin command` prints what anybody may have answered: in words, harmless, or refused."""

import asyncio
import json
from collections.abc import Mapping
from typing import Any

import pytest

from skin_host.cli import build_parser, main
from skin_host.cli.operate import patience_s
from skin_host.config.settings import Mqtt
from skin_host.mqtt.publisher import Publisher
from tests.support.broker import Mosquitto
from tests.support.waiting import until

#: A calibration as a daemon answers it.
CALIBRATED = {
    "id": "abc",
    "time": "2026-01-01T00:00:00+00:00",
    "verdicts": {"palm": {"ok": 11, "touched": 1}},
    "triangles": [
        {
            "part": "palm",
            "board": "hand",
            "triangle": 4,
            "pressure_taxels": 12,
            "verdict": "touched",
            "taxels": {"touched": [3]},
        }
    ],
    "touched": {"palm": [3]},
    "unchanged": {},
    "damaged": {},
    "fingertips": {},
    "kept": True,
}


async def answered(broker: Mosquitto, answer: Mapping[str, Any], *words: str) -> int:
    """The exit status of a command that a node answers so."""

    async def handle(name: str, payload: bytes) -> Mapping[str, Any]:
        return answer

    settings = Mqtt(host=broker.host, port=broker.port)
    commands = "skin/robot/nodes/main/cmd/+"
    before = broker.subscriptions(commands)
    async with Publisher(settings, "robot", "main", handler=handle):
        await until(lambda: broker.subscriptions(commands) > before)
        url = f"mqtt://{broker.host}:{broker.port}"
        command = ["command", *words, "--broker", url, "--robot", "robot", "--node", "main"]
        return await asyncio.to_thread(main, command)


async def test_what_a_broker_had_no_room_for_is_named(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    """The answer came without it, though the command was carried out."""
    record = {"state": "ok", "rate_hz": 20.0, "taxels": 12, "valid_taxels": 12}
    assert await answered(mosquitto, {"palm": record, "left_out": ["hand"]}, "status") == 0
    shown = capsys.readouterr()
    assert [line.split()[0] for line in shown.out.splitlines()] == ["part", "palm"]
    (warning,) = shown.err.splitlines()
    assert "without hand: more than the broker takes" in warning
    known = {key: value for key, value in CALIBRATED.items() if key != "triangles"}
    without = known | {"left_out": ["triangles"]}
    assert await answered(mosquitto, without, "calibrate") == 0
    shown = capsys.readouterr()
    assert shown.out.strip() == "calibration abc is in use"
    touched, warning = shown.err.splitlines()
    assert "taxel 3 of palm" in touched
    assert "without triangles: more than the broker takes" in warning
    assert await answered(mosquitto, without, "calibrate", "--json") == 0
    assert json.loads(capsys.readouterr().out) == without


@pytest.mark.parametrize("missing", ["touched", "fingertips"])
async def test_where_it_is_not_known_what_was_touched_a_strict_calibration_fails(
    mosquitto: Mosquitto, missing: str
) -> None:
    known = CALIBRATED | {"touched": {}}
    assert await answered(mosquitto, known, "calibrate", "--strict") == 0
    del known[missing]
    without = known | {"left_out": [missing]}
    assert await answered(mosquitto, without, "calibrate", "--strict") == 1
    assert await answered(mosquitto, without, "calibrate") == 0


async def test_values_are_in_words(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    answer = {
        "yes": True,
        "no": False,
        "unknown": None,
        "none": [],
        "empty": {},
        "list": ["a", 2],
        "mixed": [True],
        "table": {"a": None, "b": {"deep": True}, "c": [], "d": 2.0, "e": 2.5},
    }
    assert await answered(mosquitto, answer, "reload") == 0
    assert capsys.readouterr().out == (
        "yes: yes\nno: no\nunknown: unknown\nnone: none\nempty: none\nlist: a, 2\nmixed: [true]\n"
        'table:\n  a: unknown\n  b: {"deep": true}\n  c: none\n  d: 2\n  e: 2.5\n'
    )


async def test_a_calibration_names_pads_and_fingertips_that_were_touched(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    tips = {"index": "touched", "thumb": "ok", "ring": "absent", "little": "unchanged"}
    more = {"fingertips": tips, "unchanged": {"palm": [7]}, "damaged": {"palm": [8]}}
    assert await answered(mosquitto, CALIBRATED | more, "calibrate", "--strict") == 1
    shown = capsys.readouterr()
    assert shown.out.splitlines() == [
        "part  board  triangles  verdict",
        "palm  hand   4          1 touched: 3",
        "index: zero taken while it was touched",
        "thumb: zero taken",
        "ring: too few samples of its board; no zero",
        "little: too few samples of its board; it keeps its zero",
        "calibration abc is in use",
    ]
    unchanged, damaged, touched = shown.err.splitlines()
    assert unchanged == "warning: taxel 7 of palm: received too rarely; it goes on as before"
    assert damaged == "warning: taxel 8 of palm: calibrated without the bytes that were damaged"
    assert "while it was calibrated: taxel 3 of palm; index; take away" in touched


@pytest.mark.parametrize(
    "words", [["calibrate"], ["disable", "--part", "palm"], ["calibrate", "--json"]]
)
async def test_what_could_not_be_kept_is_a_warning_and_a_failure(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    answer = CALIBRATED | {"touched": {}, "kept": False}
    assert await answered(mosquitto, answer, *words) == 1
    (warning,) = capsys.readouterr().err.splitlines()
    assert "lost when the daemon restarts" in warning


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"touched": None}, "$.touched"),
        ({"touched": {"palm": [-1]}}, "$.touched[...][0]"),
        ({"touched": {"palm": [10**400]}}, "$.touched[...][0]"),
        ({"triangles": [{"part": "palm"}]}, "$.triangles[0]"),
        ({"fingertips": {"index": "fine"}}, "$.fingertips[...]"),
        ({"id": 7}, "$.id"),
    ],
)
@pytest.mark.parametrize("option", [[], ["--json"]])
async def test_what_is_no_calibration_is_refused_in_a_line(
    mosquitto: Mosquitto,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, Any],
    named: str,
    option: list[str],
) -> None:
    assert await answered(mosquitto, CALIBRATED | change, "calibrate", *option) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert named in line


@pytest.mark.parametrize("words", [["reload"], ["calibrate"], ["status"], ["reload", "--json"]])
async def test_no_answer_steers_the_terminal(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    evil = "\x1b]0;title\x07\x1b[2J\u202e\r"
    triangle = {**CALIBRATED["triangles"][0], "part": evil, "board": evil, "taxels": {evil: [3]}}
    answer: dict[str, Any] = {
        evil: evil,
        "list": [evil],
        "table": {evil: evil, "b": [[evil]]},
        **CALIBRATED,
        "id": evil,
        "triangles": [triangle],
        "touched": {evil: [3]},
        "fingertips": {evil: "touched"},
    }
    if words == ["status"]:
        answer = {evil: {"state": evil, "sentences": [evil], "kind": evil}}
    assert await answered(mosquitto, answer, *words) == 0
    shown = capsys.readouterr()
    assert "title" in shown.out
    assert all(one.isprintable() or one == "\n" for one in shown.out + shown.err)


@pytest.mark.parametrize(
    ("words", "least_s", "most_s"),
    [
        (["status"], 20, 30),
        (["record", "--seconds", "86400"], 20, 30),  # it is answered when it begins
        (["raw", "--seconds", "600"], 20, 30),
        (["calibrate", "--seconds", "5"], 4 * 5 + 15, 100),
        (["calibrate", "--seconds", "600"], 4 * 600 + 15, 2600),  # boards may be zeroed meanwhile
        (["calibrate"], 4 * 60 + 15, 400),  # the configuration may name any time
    ],
)
def test_an_answer_is_waited_for_as_long_as_it_may_take(
    words: list[str], least_s: float, most_s: float
) -> None:
    assert least_s <= patience_s(build_parser().read(["command", *words])) <= most_s


async def test_a_record_of_status_that_is_none_is_refused_in_a_line(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    for record in (3, {"rate_hz": "fast"}, {"sentences": [1]}, {"taxels": None}):
        assert await answered(mosquitto, {"palm": record}, "status") == 1
        shown = capsys.readouterr()
        assert shown.out == ""
        assert shown.err.count("\n") == 1
        assert "health" in shown.err


@pytest.mark.parametrize("number", ["nan", "inf", "-inf", "three", ""])
def test_a_threshold_that_is_no_number_is_refused(
    number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """JSON has no such number: the daemon took it for "unchanged"."""
    assert main(["command", "thresholds", "--set", f"margin_units={number}"]) == 2
    assert f"--set margin_units={number}: wanted KEY=NUMBER" in capsys.readouterr().err


async def test_a_calibration_as_a_document_is_the_answer(
    mosquitto: Mosquitto, capsys: pytest.CaptureFixture[str]
) -> None:
    assert await answered(mosquitto, CALIBRATED, "calibrate", "--json") == 0
    assert json.loads(capsys.readouterr().out) == CALIBRATED
