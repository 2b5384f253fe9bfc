"""What passed over a bus is known, however the frames come."""

import numpy as np
import pytest

from skin_host.bus.wire import FrameBatch, encode_sweep
from skin_host.evaluation.simulate.cables import Sent, _rows

MS = 1_000_000


def traffic(seed: int) -> list[FrameBatch]:
    """Sweeps of two boards, whole, cut, with frames missing, twice, damaged or out of order."""
    rng = np.random.default_rng(seed)
    batches = []
    t_ns = 0
    for _ in range(60):
        t_ns += int(rng.choice([2, 11, 13, 17, 50])) * MS
        triangles = np.sort(rng.choice(16, int(rng.integers(1, 6)), replace=False))
        values = rng.integers(0, 3, (len(triangles), 12)).astype(np.uint8)
        status = rng.integers(0, 3, len(triangles)).astype(np.uint16)
        ids, data = encode_sweep(int(rng.integers(2, 4)), triangles, values, status)
        n = len(ids)
        step_ns = int(rng.choice([120_000, 4 * MS]))
        times_ns = t_ns + step_ns * np.arange(n)
        batch = FrameBatch(ids, np.full(n, 8, np.uint8), data, times_ns)
        match rng.integers(8):
            case 0:
                batch = _rows(batch, rng.random(n) < 0.7)
            case 1:
                batch = _rows(batch, np.sort(rng.integers(0, n, n)))
            case 2:
                batch = _rows(batch, rng.permutation(n))
            case 3:
                batch.data[rng.integers(n), 0] ^= 0x80
            case 4:
                batch.dlc[rng.integers(n)] = 6
            case 5:
                batch.id[rng.integers(n)] ^= 0x100
        cut = int(rng.integers(0, n)) if rng.random() < 0.3 else 0
        batches += [_rows(batch, slice(0, cut)), _rows(batch, slice(cut, None))]
    return [batch for batch in batches if len(batch)]


@pytest.mark.parametrize("seed", range(20))
def test_a_sweep_that_comes_whole_is_noted_as_its_frames_are(seed: int) -> None:
    at_once, by_frames = Sent(), Sent()
    for batch in traffic(seed):
        at_once.note(batch)
        by_frames._note_frames(batch)
        assert at_once.bursts == by_frames.bursts
        for keys, sweeps in at_once._sweeps.values():
            for sweep in sweeps:
                raw = sweep.values[:24]
                answered = any(one.answered and one.values[:24] == raw for one in sweeps)
                assert (at_once.find_together(keys[:2], raw) is not None) is answered
    for address in range(16):
        at_once._spread(address)
    assert at_once._whole == by_frames._whole
    assert at_once._half == by_frames._half
    assert any(by_frames._whole.values())


def test_what_two_boards_at_one_address_send_in_the_longest_stall_is_known() -> None:
    """It waits to be read all that time, and may then be reported as valid."""
    sent = Sent()
    rng = np.random.default_rng(1)
    values = rng.integers(0, 256, (200, 1, 12)).astype(np.uint8)
    for number, raw in enumerate(values):
        ids, data = encode_sweep(1, np.array([0]), raw, np.zeros(1, np.uint16))
        sent.note(FrameBatch(ids, np.full(2, 8, np.uint8), data, np.full(2, 25 * MS * number)))
    assert list(sent.find(1, 0, values[0].tobytes()))


def test_an_irregular_board_shows_by_when_its_sweeps_begin() -> None:
    """Not one whose sweeps all wait until the bus is free, nor what was before."""
    sent = Sent()
    rng = np.random.default_rng(1)
    ids, data = encode_sweep(1, np.array([0]), np.zeros((1, 12), np.uint8), np.zeros(1, np.uint16))
    for number in range(100):
        late_ns = round(abs(rng.normal(0.0, 6.0 * MS))) * (number < 50)
        begins_ns = 50 * MS * number + max(late_ns, 0 if number < 25 else 20 * MS)
        times_ns = np.array([begins_ns, begins_ns + MS // 8])
        sent.note(FrameBatch(ids, np.full(2, 8, np.uint8), data, times_ns))
        if number == 24:
            assert 3.0 < sent.scatter_ms(1, 0) < 7.0
    assert sent.scatter_ms(1, 25 * 50 * MS) < 0.1
    assert sent.scatter_ms(1, 95 * 50 * MS) == 0.0
    assert sent.scatter_ms(2, 0) == 0.0


@pytest.mark.parametrize(("apart_ms", "crowded"), [(1, True), (50, False)])
def test_sweeps_that_a_full_bus_passes_close_together_are_known(
    apart_ms: int, crowded: bool
) -> None:
    sent = Sent()
    triangles, status = np.arange(2), np.zeros(2, np.uint16)
    for k in range(4):
        ids, data = encode_sweep(3, triangles, np.full((2, 12), k, np.uint8), status)
        times_ns = (1000 + k * apart_ms) * MS + 120_000 * np.arange(len(ids))
        sent.note(FrameBatch(ids, np.full(len(ids), 8, np.uint8), data, times_ns))
    assert (sent.crowded_ns > 0) is crowded


@pytest.mark.parametrize("is_stack", [True, False])
def test_a_pair_that_a_full_bus_held_up_is_of_one_sweep_where_its_second_frame_is_sent_first(
    is_stack: bool,
) -> None:
    """`kaspar.toml`, seed 4: any other board sends that frame first only of the next sweep."""
    sent = Sent(frozenset({1} if is_stack else ()))
    ids, data = encode_sweep(
        1, np.array([4]), np.full((1, 12), 7, np.uint8), np.zeros(1, np.uint16)
    )
    times_ns = np.array([0, 18 * MS])
    sent.note(FrameBatch(ids, np.full(2, 8, np.uint8), data[::-1].copy(), times_ns))
    assert bool(list(sent.find(1, 4, bytes([7] * 12)))) is is_stack
