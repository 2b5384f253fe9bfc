"""What docs/mqtt.md shows is what the code reads and writes."""

import re
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np

from skin_host.fingertip.events import Over, Slip
from skin_host.mqtt import frames, messages
from skin_host.mqtt.commands import Cause, decode_result
from skin_host.mqtt.info import FingertipInfo, NodeInfo, PartInfo, TriangleInfo
from skin_host.mqtt.outbox import PublisherCounters
from skin_host.processing.events import Load, Touch

DOCUMENT = (Path(__file__).parents[2] / "docs" / "mqtt.md").read_text()
EXAMPLES = {
    msgspec.json.decode(text)["schema"]: text.encode()
    for text in re.findall(r"```json\n(.*?)```", DOCUMENT, re.DOTALL)
}


def test_the_frame_of_the_document_is_a_frame() -> None:
    frame = frames.decode_frame("palm", EXAMPLES["skin.frame/1"])
    np.testing.assert_allclose(frame.pressure_kpa[2:4], [3.12, 12.07])
    assert np.flatnonzero(~frame.valid).tolist() == [11]


def test_the_touch_of_the_document_has_exactly_the_keys_of_a_touch() -> None:
    touch = messages.decode_touch(EXAMPLES["skin.touch/1"])
    assert touch.count == 52
    keys = list(msgspec.json.decode(EXAMPLES["skin.touch/1"]))
    whole = ["schema", *Touch.__struct_fields__]
    assert [*keys, "partial", "beyond", "reason", "load", "missed"] == whole


def test_slips_and_excess_of_the_document_have_exactly_their_keys() -> None:
    slip = messages.decode_slip(EXAMPLES["skin.slip/1"])
    assert slip.cause == "fall"
    keys = list(msgspec.json.decode(EXAMPLES["skin.slip/1"]))
    assert [*keys, "missed"] == ["schema", *Slip.__struct_fields__]
    assert messages.decode_over(EXAMPLES["skin.over/1"]).force_n == 10.4
    keys = list(msgspec.json.decode(EXAMPLES["skin.over/1"]))
    assert [*keys, "missed"] == ["schema", *Over.__struct_fields__]


def test_the_result_of_the_document_is_a_result() -> None:
    assert decode_result(EXAMPLES["skin.result/1"]).ok


def test_the_document_names_every_cause_of_a_refusal() -> None:
    (commands,) = re.findall(r"\n## Commands\n(.*?)\n## ", DOCUMENT, re.DOTALL)
    named = re.findall(r"^\| `(\w+)` \|", commands, re.MULTILINE)
    assert named == ["cause", *get_args(Cause)]


def test_the_document_names_every_key() -> None:
    keys = {
        *Touch.__struct_fields__,
        *Load.__struct_fields__,
        *frames._FrameFields.__struct_fields__,
        *NodeInfo.__struct_fields__,
        *PartInfo.__struct_fields__,
        *TriangleInfo.__struct_fields__,
        *FingertipInfo.__struct_fields__,
    } - {"missed"}  # never sent
    missing = {key for key in keys if not re.search(rf"[`\"]{key}[`\"]", DOCUMENT)}
    assert not missing
    assert "touches_dropped" in DOCUMENT
    assert "touches_dropped" in PublisherCounters.__slots__


def test_the_programs_of_the_document_are_python() -> None:
    programs = re.findall(r"```python\n(.*?)```", DOCUMENT, re.DOTALL)
    assert len(programs) == 2
    for program in programs:
        compile(program, "docs/mqtt.md", "exec")
