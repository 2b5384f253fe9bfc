"""Health knows presses beyond the range from torn pads, and forces do not fall there."""

from collections.abc import Sequence

import numpy as np
import pytest

from emulator.probes.scene import Place, Probe, Scene
from skin_host.processing.core import Output
from skin_host.processing.events import Touch
from tests.support.fault_bench import FaultBench

PART = "left_forearm"
#: On the clock of the robot, which is up to a second ahead of the bench's.
BEGINS_S = 13.0
ACCUSED = {"taxel_out_of_range", "triangle_out_of_range", "taxel_unproven", "taxel_stuck"}


class Pressed(FaultBench):
    """A robot one part of which is pressed."""

    def __init__(self, kpa: Sequence[tuple[float, float]], taxel: int, diameter_mm: float) -> None:
        self.contacts: dict[int, Touch] = {}
        self.ended: list[Touch] = []
        keyframes = [(float(t_s), float(at_kpa)) for t_s, at_kpa in kpa]
        probe = Probe(
            part=PART,
            at=Place(taxel=taxel),
            diameter_mm=diameter_mm,
            pressure_kpa=keyframes,
            start_s=BEGINS_S,
        )
        super().__init__(scene=Scene(quiet=True, probe=[probe]))

    def _note(self, output: Output) -> None:
        super()._note(output)
        for event in output.events:
            if isinstance(event, Touch) and event.part == PART:
                self.contacts[event.id] = event
                if event.event == "end":
                    self.ended.append(self.contacts.pop(event.id))

    @property
    def beyond(self) -> bool:
        return any(contact.beyond for contact in self.contacts.values())

    @property
    def force_n(self) -> float:
        return sum(contact.force_n for contact in self.contacts.values())

    def accused(self) -> set[str]:
        """Codes of what part and triangles are accused of since the press began."""
        return {code for code, _ in self.first_told} & ACCUSED

    def run_to(self, seconds: float) -> None:
        """Go on until so long after the press begins."""
        self.run(BEGINS_S + seconds - self.t_s)


@pytest.mark.parametrize(("taxel", "diameter_mm"), [(41, 5.0), (41, 20.0)])
def test_a_press_that_grows_beyond_the_range_is_felt_to_its_end(
    taxel: int, diameter_mm: float
) -> None:
    bench = Pressed([(0, 0), (10, 400), (20, 400), (20.2, 0)], taxel, diameter_mm)
    before_n = 0.0
    bench.run_to(0.8)
    assert not bench.beyond
    for seconds in np.arange(1.0, 10.5, 0.5):
        bench.run_to(seconds)
        assert bench.force_n > 0.93 * before_n
        before_n = max(before_n, bench.force_n)
    assert bench.beyond
    bench.run_to(18.0)
    assert bench.beyond
    assert bench.force_n > 0.9 * before_n
    assert bench.status("forearm_outer").any()
    assert not bench.ended
    assert not bench.accused()
    assert bench.records[PART]["state"] == "ok"
    assert taxel in bench.records[PART]["beyond_range"]
    bench.run_to(25.0)
    assert not bench.records[PART]["beyond_range"]
    assert not bench.beyond
    assert bench.force_n < 0.3 * before_n


def test_a_pad_that_breaks_in_a_press_is_named_when_it_is_over() -> None:
    bench = Pressed([(0, 0), (1, 100), (20, 100), (20.2, 0)], 41, 12.0)
    bench.run_to(5.0)
    assert bench.touched[PART][41]
    bench.inject("stuck_taxel", board="forearm_outer", triangle=3, taxel=5, value=2000.0)
    bench.run_to(19.0)
    assert bench.touched[PART][41]
    bench.run_to(45.0)
    assert bench.status("forearm_outer")[3]
    assert not bench.touched[PART][41]
    assert not bench.valid[PART][41]
    assert "taxel_out_of_range" in bench.accused()
    assert 41 in bench.records[PART]["taxel_faults"]["out_of_range"]


def test_a_pad_that_breaks_at_rest_is_named_at_once_and_never_touched() -> None:
    bench = Pressed([(0, 0), (1, 100), (10, 100), (10.2, 0)], 43, 12.0)
    bench.run_to(-2.0)
    bench.inject("stuck_taxel", board="forearm_outer", triangle=3, taxel=5, value=2000.0)
    for seconds in np.arange(-1.5, 15.0, 0.5):
        bench.run_to(seconds)
        assert "taxel_out_of_range" in {code for code, _ in bench.told}
        assert not bench.touched[PART][41]
        assert not bench.valid[PART][41]
