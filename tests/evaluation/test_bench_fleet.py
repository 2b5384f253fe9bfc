"""The benchmark of a fleet runs whole, and loses nothing where nothing hinders it."""

import pytest

from skin_host.evaluation.bench_fleet import PHASES, FleetPlan, measure, mosquittos
from tests.support import programs

pytestmark = [pytest.mark.mosquitto, pytest.mark.long]


@pytest.mark.parametrize("plain", [False, True], ids=["publishers", "plain robots"])
def test_robots_publish_through_all_phases(plain: bool, pytestconfig: pytest.Config) -> None:
    if not pytestconfig.getoption("--require-mosquitto") and not programs.find("mosquitto"):
        pytest.skip("mosquitto is not installed")
    with mosquittos() as brokers:
        document = measure(brokers, FleetPlan(20, 2.0, 1.0, 2.0, plain))
    assert [row["phase"] for row in document["phases"]] == list(PHASES)
    assert document["events"] > 0
    assert document["dropped_by_robots"] == 0
    assert document["lost"] == document["passed_on_twice"] == document["out_of_order"] == 0
