"""Silence is measured while somebody listens: no pause and no set clock is a board's fault."""

import pytest

from tests.support.fault_bench import FaultBench


@pytest.mark.parametrize("pause_s", [3.0, 3600.0])
def test_a_look_after_a_pause_accuses_nobody_before_anything_is_read(
    bench: FaultBench, pause_s: float
) -> None:
    bench.t_s += pause_s
    bench._look()
    # The computer's own stall is reported; nobody is accused of it.
    assert set(bench.told) <= {("host_stalls", "host")}
    bench.run(0.5)
    assert set(bench.told) <= {("host_stalls", "host")}


@pytest.mark.parametrize("jump_s", [-86_400.0, 0.0, 86_400.0])
def test_a_board_that_died_before_the_clock_was_set_is_told_after_it(
    bench: FaultBench, jump_s: float
) -> None:
    bench.inject("board_silent", board="hand")
    bench.run(0.1)
    bench.t_s += jump_s
    bench.run(1.0)
    assert ("board_silent", "hand") in bench.told
    bench.t_s += jump_s
    bench.run(0.1)
    # It stays silent until it sends.
    assert ("board_silent", "hand") in bench.told


def test_a_board_that_sends_again_is_not_silent_though_its_part_was_disabled_meanwhile(
    bench: FaultBench,
) -> None:
    """No samples of that part are taken, so none shows that the board is back."""
    back = bench.inject("board_silent", board="forearm_outer")
    bench.run(2.0)
    bench.engine.disabled.add([part.name for part in bench.layout.parts].index("left_forearm"))
    bench.run(1.0)
    back()
    bench.robot.bring_up()
    bench.run(8.0)
    assert "board_silent" not in {
        fault["code"] for fault in bench.records["left_forearm"]["faults"]
    }
