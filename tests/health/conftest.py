"""A calibrated robot in simulated time, for every test a fresh one."""

import copy

import pytest

from tests.support.fault_bench import FaultBench


@pytest.fixture(scope="session")
def calibrated() -> FaultBench:
    """One that is only copied; its calibration takes a while."""
    return FaultBench()


@pytest.fixture
def bench(calibrated: FaultBench) -> FaultBench:
    """One to break."""
    return copy.deepcopy(calibrated)
