"""Frames on their way over one bus."""

import numpy as np
import pytest

from emulator.wire import Wire, _rows
from skin_host.bus.wire import FrameBatch

MS = 1_000_000


def burst(address: int, n: int, ready_ns: int) -> FrameBatch:
    return FrameBatch.of(
        [(0x400 | address << 4 | i % 16, bytes([i] * 8), ready_ns) for i in range(n)]
    )


def wire_of(bitrate: int = 1_000_000) -> Wire:
    return Wire(bitrate, lambda address: 20 if address % 2 else None, np.random.default_rng(1))


def test_frames_that_become_ready_later_wait() -> None:
    wire = wire_of()
    wire.put(burst(1, 2, 10 * MS))
    wire.put(burst(2, 2, 20 * MS))
    assert len(wire.until(5 * MS)) == 0
    assert len(wire.until(15 * MS)) == 2
    assert len(wire.until(25 * MS)) == 2


def test_an_urgent_frame_overtakes_those_that_wait() -> None:
    wire = wire_of()
    wire.put(burst(4, 10, 0))
    wire.put(burst(2, 1, MS // 2))
    senders = (wire.until(10 * MS).id >> 4 & 0xF).tolist()
    # 116 us a frame: four have passed by then, and the fifth is not interrupted.
    assert senders == [4] * 5 + [2] + [4] * 5


def test_a_node_that_leaves_a_tenth_of_the_bus_leaves_it_to_the_others() -> None:
    """Its next frame waits for the end of theirs, which takes nine times as long as the gap."""
    wire = wire_of()
    wire.babble(0.9, 0)
    wire.put(burst(4, 40, 0))
    # 40 frames of 116 us take ten times as long, and as long again is for their share to begin.
    sent = wire.until(round(40 * 0.116 * 11 * MS))
    assert np.count_nonzero(sent.id != 0) == 40
    assert (np.diff(sent.t_ns) >= 116_000).all()


def test_a_node_that_leaves_no_gap_keeps_all_others_from_the_bus() -> None:
    wire = wire_of()
    wire.babble(1.0, 0)
    wire.put(burst(4, 40, MS))
    assert not wire.until(100 * MS).id.any()
    wire.babble(0.0, 100 * MS)
    assert np.count_nonzero(wire.until(110 * MS).id) == 40


def test_an_answer_does_not_overflow_the_stack_of_its_board() -> None:
    """The main loop of an MTB3 answers after it has handed its burst over, when there is room."""
    wire = wire_of()
    wire.put(burst(1, 32, 0))
    assert len(wire.until(MS)) == 8
    wire.put(FrameBatch.of([(0x210, b"\x1c" + bytes(7), MS)]))
    sent = wire.until(10 * MS)
    assert len(sent) == 24 + 1
    assert wire.lost == 0


@pytest.mark.parametrize(("n", "kept"), [(4, 8), (16, 20), (17, 18)])
def test_a_stack_overflows_only_beyond_its_size(n: int, kept: int) -> None:
    """Four frames still wait for the bus when a board with a stack of 20 has the next burst."""
    wire = wire_of()
    wire.put(burst(0, 30, 0))
    wire.put(burst(1, 4, 0))
    assert not (wire.until(2 * MS).id >> 4 & 0xF).any()
    wire.put(burst(1, n, 2 * MS))
    own = [can_id for can_id in wire.until(20 * MS).id.tolist() if can_id >> 4 & 0xF == 1]
    assert len(own) == kept  # with the notice of the overflow
    assert (0x715 in own) == (wire.lost == 4) == (n == 17)


def test_a_wrong_bit_is_one_that_its_frame_has() -> None:
    """Frames of force/torque boards have six bytes, a notice of an MTB3 none."""
    wire = wire_of()
    wire.error_share = 1.0
    frames = [(0x32A, bytes(6), i * MS) for i in range(200)]
    wire.put(FrameBatch.of([*frames, (0x715, b"", 200 * MS)]))
    sent = wire.until(300 * MS)
    assert (np.unpackbits(sent.data, axis=1).sum(axis=1) == (sent.dlc > 0)).all()
    assert not sent.data[:, 6:].any()


@pytest.mark.parametrize("bitrate", [125_000, 500_000, 1_000_000])
def test_how_often_one_looks_changes_no_frame(bitrate: int) -> None:
    """Also where boards send more than the bus can carry."""
    sent = []
    for every_ms in (1, 2, 5, 50):
        wire = wire_of(bitrate)
        batches = []
        for t_ms in range(400):
            if t_ms % 7 == 0:
                wire.put(burst(1 + t_ms % 5, 30, t_ms * MS))
            if (t_ms + 1) % every_ms == 0:
                batches.append(wire.until((t_ms + 1) * MS))
        frames = [
            (int(can_id), data.tobytes(), int(t_ns))
            for batch in batches
            for can_id, data, t_ns in zip(batch.id, batch.data, batch.t_ns, strict=True)
        ]
        sent.append((frames, wire.lost))
    assert all(one == sent[0] for one in sent)
    assert (sent[0][1] > 0) == (bitrate == 125_000)


class FrameByFrame(Wire):
    """Arbitrates for each frame of a babbling node, as for all others."""

    def _let_first(self, urgent: FrameBatch) -> None:
        for row in range(len(urgent)):
            self._arbitrate(_rows(urgent, slice(row, row + 1)), int(urgent.t_ns[row]))


@pytest.mark.parametrize("seed", range(10))
def test_frames_of_a_babbling_node_pass_as_if_arbitrated_one_by_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bitrate, share = int(rng.choice([125_000, 500_000, 1_000_000])), float(rng.uniform(0.3, 1.0))

    def stack_size(address: int) -> int | None:
        return 16 if address == 3 else None

    wires = [kind(bitrate, stack_size, np.random.default_rng(1)) for kind in (Wire, FrameByFrame)]
    for wire in wires:
        wire.babble(share, 0)
    t_ns = 0
    for _ in range(40):
        t_ns += int(rng.integers(1, 30 * MS))
        for _ in range(int(rng.integers(0, 3))):
            address, n = int(rng.integers(1, 5)), int(rng.integers(1, 33))
            ready_ns = int(rng.integers(max(0, t_ns - 20 * MS), t_ns + 5 * MS))
            frames = [(0x400 | address << 4 | i // 2, bytes([i] * 8), ready_ns) for i in range(n)]
            for wire in wires:
                wire.put(FrameBatch.of(frames))
        at_once, one_by_one = (list(wire.until(t_ns).frames()) for wire in wires)
        assert at_once == one_by_one
    assert wires[0].lost == wires[1].lost


@pytest.mark.parametrize("share", [1e-300, 5e-324])
def test_a_node_that_babbles_next_to_nothing_sends_one_frame(share: float) -> None:
    """No number of its time holds how long the next one would be awaited."""
    wire = wire_of()
    wire.babble(share, 0)
    assert wire.until(10 * MS).id.tolist() == [0]
    assert len(wire.until(1000 * MS)) == 0


@pytest.mark.parametrize("apart_us", [60, 99, 100, 130])
def test_frames_that_are_handed_over_together_pass_as_one_by_one(apart_us: int) -> None:
    """Those of a force/torque board become ready one after the other; 6 bytes take 100 us."""
    frames = [(0x320 | kind, bytes([kind] * 6), kind * apart_us * 1000) for kind in (10, 11, 12)]
    together, single = wire_of(), wire_of()
    together.put(FrameBatch.of(frames))
    for frame in frames:
        single.put(FrameBatch.of([frame]))
        single.until(frame[2])
    sent, wanted = together.until(10 * MS), single.until(10 * MS)
    # What has ended meanwhile was given before.
    n = len(wanted)
    assert len(sent) == 3 and n > 0
    assert sent.t_ns[-n:].tolist() == wanted.t_ns.tolist()
    assert sent.id[-n:].tolist() == wanted.id.tolist()
    if apart_us >= 100:
        assert sent.t_ns.tolist() == [t_ns + 100_000 for *_, t_ns in frames]
