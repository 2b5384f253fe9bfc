"""Strangers' bytes: a few thousand of each kind in every test run, millions by `bulk.py`."""

import json

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz import targets

quick = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=12), inner),
    max_leaves=12,
)
KEYS = st.sampled_from(
    ["id", "part", "board", "seconds", "file", "max_bytes", "set", "reset", "other"]
)


@given(st.lists(st.binary(min_size=14, max_size=1400), min_size=1, max_size=5))
@quick
def test_any_frames_at_all_are_survived_and_counted(batches: list[bytes]) -> None:
    buses = targets.Buses()
    for data in batches:
        buses.feed(data)
    buses.look()


@given(st.binary(max_size=400))
@quick
def test_any_bytes_as_a_configuration_are_refused_in_words(data: bytes) -> None:
    targets.configuration(data)


@given(st.data())
@quick
def test_a_configuration_with_a_line_changed_is_taken_or_refused_in_words(data: st.DataObject):
    lines = targets.CONFIG.read_text().splitlines()
    row = data.draw(st.integers(0, len(lines) - 1))
    lines[row] = data.draw(st.sampled_from(["", "x = 1", "[x]", lines[row][:-1], lines[row] + '"']))
    targets.configuration("\n".join(lines).encode())


@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
@quick
def test_any_calibration_and_state_file_is_survived(data: bytes) -> None:
    targets.calibration_file(data)
    targets.state_file(data)


@given(
    st.sampled_from(targets.COMMANDS),
    st.binary(max_size=100)
    | JSON.map(lambda value: json.dumps(value).encode())
    | st.dictionaries(KEYS, JSON).map(lambda value: json.dumps(value).encode()),
)
@quick
async def test_any_command_is_answered(name: str, payload: bytes) -> None:
    await targets.Commands().take(name, payload)


@pytest.mark.parametrize(
    "name", ["../x", "a/b", "/etc/passwd", "..", ".hidden", "x" * 65, "", "a\nb", "a b", "é"]
)
async def test_a_recording_cannot_leave_its_folder(name: str) -> None:
    commands = targets.Commands()
    with pytest.raises(targets.RequestError, match="file"):
        await commands.control.handle("record", json.dumps({"file": name}).encode())
