"""What a node remembers of parts that another node of the same skin had before."""

import asyncio
import errno
import json
import logging
import os
from collections.abc import Iterable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from emulator.probes.scene import Place, Probe, Scene
from skin_host.cli import main
from skin_host.clock import SteppedClock
from skin_host.config.settings import Bus, Settings, changed, load, skin_hash
from skin_host.daemon.alone import alone
from skin_host.daemon.calibrate import calibration_path
from skin_host.daemon.daemon import Daemon
from skin_host.daemon.joining import NodeMemory
from skin_host.daemon.memory import hand_over, known_of, remembered
from skin_host.daemon.state import (
    NodeState,
    Thresholds,
    Zeros,
    kept_path,
    load_kept,
    written_after,
)
from skin_host.daemon.workers import share_name, share_of
from skin_host.errors import OtherRobotError, OtherSkinError
from skin_host.files import set_aside, write_document
from skin_host.layout import Layout, PadKind, build_layout
from skin_host.processing.calibration import Calibration, Verdict, Zero, identified
from skin_host.processing.calibration.file import save_calibration
from tests.daemon.test_workers import body
from tests.support.live import CONFIG, living
from tests.support.stepped import stepped

PARTS = ("a", "b", "c")
TIP = "tip4-1"
#: What `known_of_all` keeps of each part, and of all.
KEPT = {part: [number] for number, part in enumerate(PARTS)}
THRESHOLDS = Thresholds(margin_units=5.0)
BEGIN = datetime(2026, 1, 1, tzinfo=UTC)


def after(seconds: float) -> str:
    return (BEGIN + timedelta(seconds=seconds)).isoformat(timespec="seconds")


class Skin:
    """A robot of three parts and a fingertip, each on a bus, and what its nodes keep."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        path = body(folder / "body.toml", [("a", [0]), ("b", [1]), ("c", [2])], tips={4: 1})
        path.write_text(path.read_text().replace('"0-15"', '"0"'))
        self.settings = load(path)
        self.layout = build_layout(self.settings, folder)

    def of(self, number: int, n: int) -> tuple[Settings, Layout, str]:
        """Return settings, layout and name of a share; of the whole node if `n` is 0."""
        if not n:
            return self.settings, self.layout, "main"
        settings = share_of(self.settings, "main", number, n)
        return settings, build_layout(settings, Path()), share_name("main", number)

    def shares(self, n: int) -> dict[str, Settings]:
        """Return the settings of all shares by their names."""
        of = [self.of(number, n) for number in shares(n)]
        return {name: settings for settings, _, name in of}

    def start(self, number: int = 0, n: int = 0, **keys: Any) -> NodeMemory:
        settings, layout, node = self.of(number, n)
        return remembered(settings, layout, node, "main", **keys)

    def path(self, node: str, what: str) -> Path:
        return kept_path(self.settings, node, what)

    def calibration(self, level: float, time_s: float, parts: Iterable[str] = PARTS) -> Calibration:
        """Return a calibration in which these parts rest at a level, in units, and others are
        absent."""
        n = self.layout.n_taxels
        verdict = np.full(n, Verdict.ABSENT, np.uint8)
        for part in map(self.layout.part, parts):
            verdict[part.start : part.stop] = Verdict.OK
        ones = np.ones(n)
        return identified(
            Calibration(
                skin_hash(self.settings),
                "",
                after(time_s),
                baseline=level * ones,
                percentile=level * ones,
                noise=0.5 * ones,
                spread=0.5 * ones,
                gain=ones,
                bend=ones,
                verdict=verdict,
                zeros={TIP: Zero(np.full(6, level), np.full(6, 0.1))},
            )
        )

    def keep(
        self,
        node: str,
        calibration: Calibration | None = None,
        zeros: Zeros | None = None,
        state: NodeState | None = None,
    ) -> None:
        if calibration is not None:
            save_calibration(self.path(node, "calibration"), calibration, self.layout)
        if zeros is not None:
            write_document(self.path(node, "zeros"), zeros)
        if state is not None:
            write_document(self.path(node, "state"), state)

    def level(self, memory: NodeMemory, part: str) -> float:
        """Return where a part rests by the calibration; NaN if it is not calibrated."""
        if memory.calibration is None:
            return float("nan")
        first = self.layout.part(part).start
        if memory.calibration.verdict[first] == Verdict.ABSENT:
            return float("nan")
        return float(memory.calibration.baseline[first])

    def pads(self, part: str) -> list[int]:
        """Return the numbers of the pressure taxels of a part."""
        mine = self.layout.part(part)
        kinds = self.layout.pad_kind[mine.start : mine.stop]
        return np.flatnonzero(kinds == PadKind.PRESSURE).tolist()

    def baselines(self, level: float, *parts: str) -> dict[str, list[float]]:
        return {part: [level] * self.layout.part(part).n_taxels for part in parts}


@pytest.fixture
def skin(tmp_path: Path) -> Skin:
    return Skin(tmp_path)


def shares(n: int) -> range:
    return range(1, n + 1)


def known_of_all(skin: Skin, written_s: float, disabled: str = "a") -> Calibration:
    """Let `main` have had all parts, each with something that is known of its zeros."""
    calibration = skin.calibration(3.0, 0)
    zeros = Zeros(
        calibration=calibration.id,
        unknown=KEPT,
        stuck=KEPT,
        touched=KEPT,
        baselines=skin.baselines(4.0, *PARTS),
        parts=[*PARTS, TIP],
        written=after(written_s),
    )
    skin.keep("main", calibration, zeros, NodeState(disabled=[disabled], thresholds=THRESHOLDS))
    return calibration


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_share_takes_over_all_that_the_whole_node_knows(skin: Skin, n: int) -> None:
    calibration = known_of_all(skin, 10, disabled="b")
    seen = set()
    for number in shares(n):
        memory = skin.start(number, n)
        assert memory.from_others
        assert memory.calibration is not None
        assert memory.calibration.id == calibration.id
        mine = [part for part in PARTS if part in (memory.zeros.parts or [])]
        seen.update(mine)
        for found in (memory.zeros.unknown, memory.zeros.stuck, memory.zeros.touched):
            assert found == {part: KEPT[part] for part in mine}
        assert memory.zeros.baselines == skin.baselines(4.0, *mine)
        assert memory.state.disabled == ["b"] * ("b" in mine)
        assert memory.state.thresholds == THRESHOLDS
    assert seen == set(PARTS)


def test_the_whole_node_takes_over_what_each_share_knows_of_its_parts(skin: Skin) -> None:
    skin.keep("main", skin.calibration(1.0, 0), Zeros(calibration="x", written=after(1)))
    of_share = {}
    for number, part in enumerate(PARTS, 1):
        tips = [TIP] * (number == 2)
        calibration = skin.calibration(10.0 * number, number)  # of others it has copies
        zeros = Zeros(
            calibration=calibration.id,
            unknown={part: [number]},
            stuck={part: [number + 1]},
            baselines=skin.baselines(10.0 * number + 1, part),
            parts=[part, *tips],
            written=after(20 + number),
        )
        state = NodeState(disabled=[part] * (number == 3))
        skin.keep(share_name("main", number), calibration, zeros, state)
        of_share[part] = calibration
    memory = skin.start()
    assert memory.from_others
    calibration = memory.calibration
    assert calibration is not None
    assert [skin.level(memory, part) for part in PARTS] == [10.0, 20.0, 30.0]
    assert calibration.zeros[TIP].offset[0] == 20.0
    assert calibration.time == after(1)
    assert memory.zeros.calibration == calibration.id
    assert memory.zeros.unknown == {"a": [1], "b": [2], "c": [3]}
    assert memory.zeros.stuck == {"a": [2], "b": [3], "c": [4]}
    assert memory.zeros.baselines == {
        part: [10.0 * number + 1] * skin.layout.part(part).n_taxels
        for number, part in enumerate(PARTS, 1)
    }
    assert memory.state.disabled == ["c"]


class Moved:
    """The same robot, of which part `a` is another node's."""

    def __init__(self, skin: Skin, node: str) -> None:
        self.skin = skin
        self.settings = changed(skin.settings, {"parts.a.node": node})
        self.layout = build_layout(self.settings, Path())

    def start(self, node: str) -> NodeMemory:
        return remembered(self.settings, self.layout, node)


def test_a_node_knows_what_the_node_that_had_its_part_before_has_kept(skin: Skin) -> None:
    """Without that it would take a new zero, whatever presses the part."""
    calibration = known_of_all(skin, 10)
    moved = Moved(skin, "arm")
    memory = moved.start("arm")
    assert memory.from_others
    assert memory.calibration is not None
    assert memory.calibration.id == calibration.id
    for found in (memory.zeros.unknown, memory.zeros.stuck, memory.zeros.touched):
        assert found == {"a": [0]}
    assert memory.zeros.baselines == skin.baselines(4.0, "a")
    assert (memory.state.disabled, memory.state.thresholds.margin_units) == (["a"], 5.0)
    # It has files of its own from now on.
    assert not moved.start("arm").from_others
    assert moved.start("arm").zeros == memory.zeros
    assert moved.start("main").zeros.touched == {"b": [1], "c": [2]}


def test_a_node_that_gets_a_part_back_knows_what_became_of_it_meanwhile(skin: Skin) -> None:
    known_of_all(skin, 10)
    arm = skin.calibration(6.0, 20, ["a"])
    zeros = Zeros(calibration=arm.id, touched={"a": [5]}, parts=["a"], written=after(25))
    skin.keep("arm", arm, zeros)
    memory = skin.start()
    assert (skin.level(memory, "a"), memory.zeros.touched["a"]) == (6.0, [5])
    assert memory.zeros.touched["b"] == [1]
    # A calibration of its other parts, with what it had known of that one.
    later = skin.calibration(9.0, 30)
    zeros = Zeros(calibration=later.id, parts=["b", "c", TIP], written=after(31))
    skin.keep("main", later, zeros)
    memory = skin.start()
    assert (skin.level(memory, "a"), memory.zeros.touched) == (6.0, {"a": [5]})
    assert skin.level(memory, "b") == 9.0
    # One of all that was taken without a daemon since.
    skin.keep("main", skin.calibration(12.0, 40))
    memory = skin.start()
    assert (skin.level(memory, "a"), memory.zeros.touched) == (12.0, {})


def test_a_part_of_which_only_a_calibration_of_another_node_is_left_is_in_doubt(skin: Skin) -> None:
    calibration = known_of_all(skin, 10)
    moved = Moved(skin, "arm")
    zeros = Zeros(calibration=calibration.id, parts=["b", "c", TIP], written=after(12))
    skin.keep("main", zeros=zeros)
    memory = moved.start("arm")
    assert skin.level(memory, "a") == 3.0
    assert memory.zeros.unknown == {"a": skin.pads("a")}


def test_files_of_other_nodes_change_nothing_of_a_node_that_has_its_own(
    skin: Skin, caplog: pytest.LogCaptureFixture
) -> None:
    known_of_all(skin, 10)
    before = skin.start()
    # Another node's, damaged; one's of earlier; and another robot's node of the same file name.
    skin.path("arm", "zeros").write_text("{")
    skin.keep("arm", skin.calibration(9.0, 90))
    early = skin.calibration(8.0, -20)
    zeros = Zeros(calibration=early.id, touched={"a": [7]}, parts=["a"], written=after(-10))
    skin.keep("leg", early, zeros)
    skin.keep("x-main", zeros=Zeros(robot="body-x", parts=["a"], written=after(99)))
    memory = skin.start()
    assert memory.calibration is not None
    assert before.calibration is not None
    assert memory.calibration.id == before.calibration.id
    assert (memory.zeros, memory.state) == (before.zeros, before.state)
    assert not memory.from_others
    assert "damaged" not in caplog.text
    assert not [
        path for path in skin.path("arm", "zeros").parent.iterdir() if "damaged" in path.name
    ]


def test_files_of_an_older_version_are_handed_over_too(skin: Skin) -> None:
    """They do not name their parts; the baselines that every end keeps do."""
    calibration = skin.calibration(3.0, 0)
    older = {
        "schema": "skin.zeros/1",
        "calibration": calibration.id,
        "unknown": {"a": [5]},
        "baselines": skin.baselines(4.0, *PARTS),
        "written": after(5),
    }
    skin.keep("main", calibration)
    skin.path("main", "zeros").write_text(json.dumps(older))
    assert skin.start(1, 1).zeros.unknown == {"a": [5]}
    share = older | {
        "unknown": {"b": [6]},
        "baselines": skin.baselines(4.0, "b"),
        "written": after(9),
    }
    skin.path("main-2", "zeros").write_text(json.dumps(share))
    assert skin.start().zeros.unknown == {"a": [5], "b": [6]}


def test_what_others_knew_does_not_replace_a_calibration_of_another_configuration(
    skin: Skin, caplog: pytest.LogCaptureFixture
) -> None:
    """The curves that were fitted for that one are in no other file."""
    skin.keep("main", skin.calibration(1.0, 0))
    path = skin.path("main", "calibration")
    before = path.read_text().replace(skin_hash(skin.settings), "0123456789ab")
    path.write_text(before)
    share = skin.calibration(10.0, 10)
    skin.keep("main-1", share, Zeros(calibration=share.id, parts=[*PARTS, TIP], written=after(20)))
    memory = skin.start()
    assert memory.from_others
    assert skin.level(memory, "a") == 10.0
    (former,) = [one for one in path.parent.iterdir() if ".former-" in one.name]
    assert former.read_text() == before
    assert "fit them again" in caplog.text


def test_a_calibration_that_was_taken_since_ends_the_doubts_of_a_share(skin: Skin) -> None:
    """By `skin calibrate`, which writes the file of the whole node."""
    first = skin.calibration(3.0, 0)
    zeros = Zeros(
        calibration=first.id, unknown={"a": [1]}, stuck={"a": [2]}, parts=["a"], written=after(10)
    )
    skin.keep("main-1", first, zeros)
    skin.keep("main", skin.calibration(8.0, 20))
    memory = skin.start(1, 3)
    assert skin.level(memory, "a") == 8.0
    assert (memory.zeros.unknown, memory.zeros.stuck) == ({}, {"a": [2]})


def test_an_older_calibration_of_the_whole_node_ends_no_doubt_of_a_share(skin: Skin) -> None:
    first = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=first.id, unknown={"a": [1]}, parts=["a"], written=after(10))
    skin.keep("main-1", first, zeros)
    skin.keep("main", skin.calibration(9.0, 5))
    memory = skin.start(1, 3)
    assert (skin.level(memory, "a"), memory.zeros.unknown) == (3.0, {"a": [1]})
    assert not memory.from_others


def test_a_calibration_without_the_zeros_that_belong_to_it_leaves_everything_in_doubt(
    skin: Skin,
) -> None:
    skin.keep("main", skin.calibration(3.0, 0))
    # Its share had another calibration, which is lost, and nothing shows who had the other parts.
    zeros = Zeros(calibration="lost", unknown={"a": [1]}, parts=["a"], written=after(10))
    skin.keep("main-1", zeros=zeros)
    for number, part in ((2, "b"), (3, "c")):
        assert skin.start(number, 3).zeros.unknown == {part: skin.pads(part)}
    assert skin.start().zeros.unknown == {part: skin.pads(part) for part in PARTS}


@pytest.mark.parametrize("n", [0, 1, 3])
def test_a_skin_that_never_ran_since_its_calibration_has_no_doubts(skin: Skin, n: int) -> None:
    skin.keep("main", skin.calibration(3.0, 0))
    hand_over(skin.settings, skin.layout, "main", skin.shares(n))
    for number in shares(n) if n else [0]:
        memory = skin.start(number, n)
        assert memory.zeros.unknown == {}
        assert memory.calibration is not None


def test_a_share_that_was_killed_before_it_kept_zeros_has_no_doubts(skin: Skin) -> None:
    """Whatever another one has kept since."""
    for number, part in enumerate(PARTS, 1):
        skin.keep(share_name("main", number), skin.calibration(3.0, 0, [part]))
    skin.keep("main-1", zeros=Zeros(calibration="x", parts=["a"], written=after(50)))
    hand_over(skin.settings, skin.layout, "main", skin.shares(3))
    memory = skin.start(2, 3)
    assert (skin.level(memory, "b"), memory.zeros.unknown) == (3.0, {})
    assert not memory.from_others


def test_zeros_of_another_share_that_cannot_be_read_leave_everything_in_doubt(skin: Skin) -> None:
    first = skin.calibration(3.0, 0)
    skin.keep("main", first, Zeros(calibration=first.id, parts=[*PARTS, TIP], written=after(5)))
    damaged = skin.path("main-2", "zeros")
    damaged.write_text("{")
    # What the node has written since is later knowledge.
    os.utime(damaged, (BEGIN.timestamp(), BEGIN.timestamp()))
    assert skin.start().zeros.unknown == {}
    os.utime(damaged)
    for _ in range(2):
        assert skin.start().zeros.unknown == {part: skin.pads(part) for part in PARTS}


@pytest.mark.parametrize("take_new", [False, True])
def test_what_could_not_be_taken_over_is_reported_and_used(
    skin: Skin, monkeypatch: pytest.MonkeyPatch, take_new: bool
) -> None:
    known = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=known.id, unknown={"a": [1]}, parts=[*PARTS, TIP], written=after(5))
    skin.keep("main", known, zeros, NodeState(disabled=["a"]))

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as context:
        context.setattr("skin_host.daemon.memory.write_document", refuse)
        context.setattr("skin_host.daemon.memory.save_calibration", refuse)
        memory = skin.start(1, 1, take_new=take_new)
    assert memory.unkept == {
        what: f"{skin.path('main-1', what)}: No space left on device"
        for what in ("calibration", "state", "zeros")
    }
    assert (memory.state.disabled, memory.zeros.unknown) == (["a"], {"a": [1]})
    settings, layout, node = skin.of(1, 1)
    daemon = Daemon(settings, layout, node, memory=memory)
    assert "state_not_kept" in {fault["code"] for fault in daemon.records()["a"]["faults"]}
    # The next start finds it where it is.
    assert skin.start(1, 1).zeros.unknown == {"a": [1]}
    assert skin.start(1, 1).unkept == {}


def test_a_calibration_that_somebody_removed_does_not_come_back_from_an_old_share(
    skin: Skin,
) -> None:
    old, new = skin.calibration(3.0, 0), skin.calibration(5.0, 50)
    skin.keep("main-1", old, Zeros(calibration=old.id, parts=[*PARTS, TIP], written=after(10)))
    skin.keep("main", new, Zeros(calibration=new.id, parts=[*PARTS, TIP], written=after(60)))
    assert skin.level(skin.start(), "a") == 5.0
    skin.path("main", "calibration").unlink()
    assert skin.start().calibration is None


def test_a_part_that_its_node_did_not_have_last_time_is_in_doubt(skin: Skin) -> None:
    """It was another node's by the configuration meanwhile; the calibration has a copy."""
    known = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=known.id, unknown={"a": [3]}, parts=["a", "b", TIP], written=after(9))
    skin.keep("main", known, zeros)
    assert skin.start().zeros.unknown == {"a": [3], "c": skin.pads("c")}
    skin.keep("main", skin.calibration(4.0, 20))
    assert skin.start().zeros.unknown == {}


def test_a_node_that_is_only_named_like_a_share_hands_over_nothing(skin: Skin) -> None:
    own = skin.calibration(3.0, 0, ["a", "b"])
    skin.keep("main", own, Zeros(calibration=own.id, parts=["a", "b"], written=after(5)))
    others = skin.calibration(9.0, 50, ["c"])
    state = NodeState(disabled=["c"], thresholds=Thresholds(margin_units=9.0))
    zeros = Zeros(calibration=others.id, unknown={"c": [1]}, parts=["c"], written=after(60))
    skin.keep("main-1", others, zeros, state)
    changes = {"parts.c.node": "main-1", f"fingertips.{TIP}.node": "main-1"}
    settings = changed(skin.settings, changes)
    memory = remembered(settings, build_layout(settings, Path()), "main")
    assert memory.calibration is not None
    assert memory.calibration.id == own.id
    assert (memory.zeros.unknown, memory.state.thresholds) == ({}, Thresholds())
    assert not memory.from_others


def test_different_thresholds_of_shares_are_reported(
    skin: Skin, caplog: pytest.LogCaptureFixture
) -> None:
    known = skin.calibration(3.0, 0)
    for number, part in enumerate(PARTS, 1):
        state = NodeState(thresholds=Thresholds(margin_units=float(number)))
        zeros = Zeros(calibration=known.id, parts=[part], written=after(number))
        skin.keep(share_name("main", number), known, zeros, state)
    assert skin.start().state.thresholds.margin_units == 1.0
    said = [record.getMessage() for record in caplog.records]
    assert said == [
        f"the thresholds of {part} are those of main-1 from now on, not of main-{number}"
        for number, part in ((2, "b"), (3, "c"))
    ]


def test_a_new_calibration_needs_none_but_what_operators_changed(skin: Skin) -> None:
    known = replace(skin.calibration(3.0, 0), configuration="another")
    zeros = Zeros(calibration=known.id, stuck={"a": [1]}, parts=[*PARTS, TIP], written=after(1))
    skin.keep("main", known, zeros, NodeState(disabled=["a"]))
    with pytest.raises(OtherSkinError, match="skin calibrate"):
        skin.start(1, 1)
    memory = skin.start(1, 1, take_new=True)
    assert memory.calibration is None
    assert (memory.state.disabled, memory.zeros.stuck) == (["a"], {"a": [1]})


@pytest.mark.parametrize("clock_s", [-1.7e9, 0.0])
def test_who_took_over_stays_the_last_one_whatever_the_clock_shows(
    skin: Skin, clock_s: float
) -> None:
    """A computer without a clock of its own begins in 1970 until the network has given it the time;
    and one that was wrong once had a share end in a year that is yet to come.
    """
    of_share = skin.calibration(50.0, 0)
    for number, part in enumerate(PARTS, 1):
        zeros = Zeros(calibration=of_share.id, written=after(1e9), parts=[part])
        skin.keep(share_name("main", number), of_share, zeros)
    memory = skin.start()
    assert memory.from_others
    taken = skin.calibration(3.0, clock_s)
    now_s = (BEGIN + timedelta(seconds=clock_s)).timestamp()
    zeros = Zeros(calibration=taken.id, parts=memory.zeros.parts)
    zeros.written = written_after(now_s, memory.others_s)
    skin.keep("main", taken, zeros)
    again = skin.start()
    assert [skin.level(again, part) for part in PARTS] == [3.0] * len(PARTS)
    assert not again.from_others


def test_a_calibration_that_is_refused_as_the_node_runs_writes_no_files(skin: Skin) -> None:
    """Files of the whole node would be taken for newer ones than those of the shares that run."""
    for number, part in enumerate(PARTS, 1):
        calibration = skin.calibration(50.0, number)
        zeros = Zeros(calibration=calibration.id, written=after(10), parts=[part])
        skin.keep(share_name("main", number), calibration, zeros)
    folder = skin.path("main", "zeros").parent
    before = {path.name for path in folder.iterdir()}
    with alone(skin.settings, "main"):
        assert main(["calibrate", str(folder / "body.toml")]) == 1
    assert {path.name for path in folder.iterdir()} - before == {"body-main.lock"}


async def test_a_daemon_dates_its_zeros_after_those_that_it_has_taken_over(skin: Skin) -> None:
    of_share = skin.calibration(50.0, 0)
    zeros = Zeros(calibration=of_share.id, written=after(1e9), parts=[*PARTS, TIP])
    skin.keep("main-1", of_share, zeros)
    daemon = Daemon(skin.settings, skin.layout, memory=skin.start())
    await daemon.keeper.end()
    assert load_kept(skin.path("main", "zeros"), Zeros).written == after(1e9 + 1)


class Truth:
    """What is so of each part, whoever has it."""

    def __init__(self) -> None:
        self.level = dict.fromkeys((*PARTS, TIP), float("nan"))
        self.unknown: dict[str, list[int]] = {part: [] for part in PARTS}
        self.disabled: set[str] = set()


RUNS = st.lists(
    st.tuples(
        st.integers(0, 3),  # shares; 0 is the whole node
        st.lists(
            st.tuples(
                st.sampled_from(["calibrate", "press", "disable", "enable"]),
                st.sampled_from(PARTS),
                st.integers(0, 9),
            ),
            max_size=4,
        ),
    ),
    min_size=2,
    max_size=6,
)


@given(runs=RUNS)
@settings(
    max_examples=settings().max_examples // 2,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
def test_whichever_nodes_had_the_parts_each_is_known_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, runs: list[tuple[int, list[tuple[str, str, int]]]]
) -> None:
    """Nodes come and go, calibrate, are pressed as they end, and keep what they know."""
    skin, truth, now_s = Skin(tmp_path_factory.mktemp("skin")), Truth(), 0
    for n, actions in runs:
        hand_over(skin.settings, skin.layout, "main", skin.shares(n))
        for number in shares(n) if n else [0]:
            now_s += 10
            memory = skin.start(number, n)
            node = skin.of(number, n)[2]
            names = memory.zeros.parts
            assert names is not None
            mine = [part for part in PARTS if part in names]
            calibration = memory.calibration
            for part in mine:
                assert skin.level(memory, part) == pytest.approx(truth.level[part], nan_ok=True)
                assert memory.zeros.unknown.get(part, []) == truth.unknown[part]
                assert (part in memory.state.disabled) == (part in truth.disabled)
            if TIP in names and calibration is not None:
                assert calibration.zeros[TIP].offset[0] == truth.level[TIP]
            zeros = memory.zeros
            wanted = [(*one, False) for one in actions if one[1] in mine]
            if calibration is None:  # it takes one by itself
                wanted.insert(0, ("calibrate", mine[0], 5, True))
            for action, part, value, _ in wanted:
                if action == "calibrate":
                    now_s += 10
                    taken = skin.calibration(now_s % 200 + value / 100, now_s, mine)
                    if calibration is not None:  # with copies of the others' parts
                        verdict = np.where(taken.verdict == 0, taken.verdict, calibration.verdict)
                        level = np.where(taken.verdict == 0, taken.baseline, calibration.baseline)
                        zeros_of_tips = taken.zeros if TIP in names else calibration.zeros
                        taken = identified(
                            replace(taken, verdict=verdict, baseline=level, zeros=zeros_of_tips)
                        )
                    elif TIP not in names:
                        taken = identified(replace(taken, zeros={}))
                    calibration = taken
                    for one in mine:
                        first = skin.layout.part(one).start
                        truth.level[one] = round(float(taken.baseline[first]), 6)
                        truth.unknown[one] = []
                    if TIP in names:
                        truth.level[TIP] = float(taken.zeros[TIP].offset[0])
                elif action == "press":
                    truth.unknown[part] = [value]
                elif action == "disable":
                    truth.disabled.add(part)
                else:
                    truth.disabled.discard(part)
            now_s += 10
            assert calibration is not None
            zeros = Zeros(
                calibration=calibration.id,
                unknown={part: truth.unknown[part] for part in mine if truth.unknown[part]},
                baselines=skin.baselines(1.0, *mine),
                written=after(now_s),
                robot=skin.layout.robot,
                parts=names,
            )
            state = NodeState(disabled=[part for part in mine if part in truth.disabled])
            skin.keep(node, calibration, zeros, state)


def pressed_hand() -> Scene:
    course = [(0.0, 0.0), (0.1, 60.0), (1000.0, 60.0)]
    place = Place(triangle=4)
    return Scene(
        quiet=True,
        probe=[Probe(part="left_hand", at=place, diameter_mm=10, pressure_kpa=course, start_s=4.0)],
    )


def in_shares(settings: Settings) -> Settings:
    """The demo's robot, whose only bus is one share."""
    return share_of(settings, "main", 1, 1)


@stepped
async def test_what_was_pressed_when_the_node_ended_is_in_doubt_in_its_share_and_back(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    async with living(can_bus_settings, tmp_path, scene=pressed_hand(), clock=clock) as live:
        engine = live.daemon.engine
        await live.wait(lambda: bool(engine.zeros.at_risk(touched=True).any()))
        await clock.sleep(1.0)
        whole = live.daemon.settings
    pressed = load_kept(tmp_path / "demo-main.zeros.json", Zeros).unknown["left_hand"]
    share = in_shares(whole)
    layout = build_layout(share, CONFIG.parent)
    memory = remembered(share, layout, "main-1", "main")
    daemon = Daemon(share, layout, "main-1", memory=memory)
    assert np.flatnonzero(daemon.engine.zeros.at_risk(touched=False)).tolist() == pressed
    # All of it is under its own name now, so that it is what the next start finds.
    assert load_kept(tmp_path / "demo-main-1.zeros.json", Zeros).unknown["left_hand"] == pressed
    for what in ("calibration", "state"):
        assert (tmp_path / f"demo-main-1.{what}.json").exists()
    again = remembered(share, layout, "main-1", "main")
    assert not again.from_others
    assert again.zeros.unknown == {"left_hand": pressed}
    (tmp_path / "demo-main.zeros.json").unlink()
    back = remembered(whole, build_layout(whole, CONFIG.parent), "main")
    assert back.zeros.unknown == {"left_hand": pressed}


def test_run_hands_what_is_remembered_to_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    skin = Skin(tmp_path)
    known = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=known.id, unknown={"a": [7]}, parts=[*PARTS, TIP], written=after(1))
    skin.keep("main", known, zeros, NodeState(disabled=["a"]))
    seen = []

    def make(*_: object, memory: NodeMemory, **__: object) -> None:
        seen.append(memory)
        raise OtherSkinError("enough")

    monkeypatch.setattr("skin_host.daemon.daemon.Daemon", make)
    monkeypatch.setattr("skin_host.processes.end_with_parent", lambda _: None)
    for words in ([], ["--share", "1/1"], ["--share", "1/1", "--calibrate"]):
        assert main(["run", str(tmp_path / "body.toml"), *words]) == 2
    assert [one.zeros.unknown for one in seen] == [{"a": [7]}] * 3
    assert [one.state.disabled for one in seen] == [["a"]] * 3
    assert [one.calibration is None for one in seen] == [False, False, True]


@stepped
async def test_a_bus_of_fingertips_alone_is_brought_up_with_a_calibration_too(
    clock: SteppedClock, skin: Skin
) -> None:
    """No skin streams there, which a start with a calibration listens to first."""
    skin.keep("main", skin.calibration(3.0, 0))
    settings = changed(skin.settings, {"mqtt.port": 1})
    memory = remembered(settings, skin.layout, "main")
    daemon = Daemon(settings, skin.layout, memory=memory, clock=clock)
    stop = asyncio.Event()
    running = asyncio.create_task(daemon.run(stop))
    await clock.sleep(2.0)
    assert not running.done()
    stop.set()
    await running


@pytest.fixture
def collision(skin: Skin) -> tuple[Settings, dict[str, bytes]]:
    """Settings of robot `body-a` with node `b`, in the folder where robot `body` has `a-b`."""
    known = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=known.id, unknown={"a": [1]}, robot="body", written=after(1))
    skin.keep("a-b", known, zeros, NodeState(robot="body", disabled=["a"]))
    nodes = {f"parts.{part}.node": "b" for part in PARTS} | {f"fingertips.{TIP}.node": "b"}
    settings = changed(skin.settings, {"robot": "body-a", **nodes})
    folder = skin.path("a-b", "zeros").parent
    return settings, {path.name: path.read_bytes() for path in folder.glob("body-a-b.*")}


@pytest.mark.parametrize("what", ["calibration", "state", "zeros"])
def test_files_of_another_robot_are_refused_and_left_as_they_are(
    collision: tuple[Settings, dict[str, bytes]], what: str
) -> None:
    settings, files = collision
    layout = build_layout(settings, Path())
    for other in {"calibration", "state", "zeros"} - {what}:
        kept_path(settings, "b", other).unlink()
    path = kept_path(settings, "b", what)
    for take_new in (False, True):
        with pytest.raises(OtherRobotError) as refused:
            remembered(settings, layout, "b", take_new=take_new)
        told = str(refused.value)
        assert told.startswith(f'{path}: the {what} file of robot "body", this is robot "body-a"')
        assert "service.state_directory" in told
        assert "skin calibrate" not in told
    assert path.read_bytes() == files[path.name]


def test_no_command_overwrites_a_calibration_of_another_robot(
    collision: tuple[Settings, dict[str, bytes]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, files = collision
    config = tmp_path / "body.toml"
    text = config.read_text().replace('robot = "body"', 'robot = "body-a"')
    text = text.replace(f"[fingertips.{TIP}]", f'[fingertips.{TIP}]\nnode = "b"')
    for part in PARTS:
        text = text.replace(f"[[parts.{part}.", f'[parts.{part}]\nnode = "b"\n[[parts.{part}.', 1)
    config.write_text(text)
    (tmp_path / "log.log").write_text("(1.0) can0 123#00\n")
    pressure = ["--pressure", str(tmp_path / "log.log"), "--levels", "3"]
    commands = (["run"], ["run", "--calibrate"], ["calibrate"], ["calibrate", *pressure])
    for command, *options in commands:
        assert main([command, str(config), "--node", "b", *options]) == 2
        assert 'of robot "body", this is robot "body-a"' in capsys.readouterr().err
    for name, content in files.items():
        assert (tmp_path / name).read_bytes() == content


@stepped
async def test_a_running_node_takes_no_calibration_over_that_of_another_robot(
    clock: SteppedClock, can_bus_settings: Bus, tmp_path: Path
) -> None:
    """It came while both were running."""
    async with living(can_bus_settings, tmp_path, clock=clock) as live:
        path = calibration_path(live.daemon.settings, "main")
        content = path.read_text().replace('"robot": "demo"', '"robot": "demo-main"')
        path.write_text(content)
        with pytest.raises(OtherRobotError):
            await live.daemon.calibrate(0.1)
        assert path.read_text() == content
        for what, kind in (("state", NodeState), ("zeros", Zeros)):
            await live.daemon.control.handle("disable", b'{"part":"left_hand"}')
            await live.daemon.keeper.end()
            assert load_kept(kept_path(live.daemon.settings, "main", what), kind).robot == "demo"


def test_files_without_a_robot_are_taken(skin: Skin) -> None:
    """Those of older versions."""
    known = skin.calibration(3.0, 0)
    zeros = Zeros(calibration=known.id, unknown={"a": [1]}, written=after(1))
    skin.keep("main", known, zeros, NodeState(disabled=["a"]))
    memory = skin.start()
    assert (memory.zeros.unknown, memory.state.disabled) == ({"a": [1]}, ["a"])
    assert not memory.from_others


def test_damaged_zeros_are_damaged_until_they_are_replaced(skin: Skin) -> None:
    """The first start after the damage may fail, be killed, or find the disk full."""
    known = skin.calibration(3.0, 0)
    skin.keep("main", known)
    skin.path("main", "zeros").write_text('{"unknown"')
    doubted = {part: skin.pads(part) for part in PARTS}
    for _ in range(3):
        memory = skin.start()
        assert memory.zeros.unknown == doubted
    skin.keep("main", zeros=Zeros(calibration=known.id, parts=[*PARTS, TIP], written=after(1)))
    assert skin.start().zeros.unknown == {}


def test_what_cannot_be_linked_is_copied_aside_and_a_folder_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "zeros.json"
    path.write_text("damaged")
    for _ in range(2):
        set_aside(path)
    first, aside = sorted(tmp_path.iterdir())
    assert (first, aside.read_text()) == (path, "damaged")
    path.unlink()
    path.mkdir()
    set_aside(path)
    assert path.is_dir()
    path.rmdir()
    path.write_text("more damage")
    caplog.set_level(logging.ERROR)
    monkeypatch.setattr("skin_host.files.read_whole", refuse)
    set_aside(path)
    assert "cannot be set aside: Operation not permitted" in caplog.text
    assert path.read_text() == "more damage"


def test_damaged_files_of_one_second_are_all_set_aside(tmp_path: Path) -> None:
    """A computer without a clock of its own has the same time at each start."""
    path = tmp_path / "zeros.json"
    damages = ["damaged", "damaged otherwise", "and again", "damaged"]
    for damage in damages:
        path.unlink(missing_ok=True)
        path.write_text(damage)
        set_aside(path)
    aside = {one.read_text() for one in tmp_path.iterdir() if one != path}
    assert aside == set(damages)
    assert len(list(tmp_path.iterdir())) == 1 + len(aside)


def test_a_zero_that_is_in_doubt_is_none_to_go_on_with(skin: Skin) -> None:
    layout, kept = skin.layout, skin.calibration(10.0, 0.0)
    first = layout.parts[1].start
    zeros = Zeros(
        calibration=kept.id,
        unknown={"b": [3]},
        touched={"b": [4]},
        baselines=skin.baselines(7.0, "b"),
    )
    known = known_of(kept, zeros, layout)
    assert np.flatnonzero(~known.zeroed).tolist() == [first + 3, first + 4]
    assert known.baseline[first] == 7.0
    assert known.baseline[:first] == pytest.approx(kept.baseline[:first])
    other = known_of(replace(kept, id="other"), zeros, layout)
    assert other.baseline == pytest.approx(kept.baseline)
