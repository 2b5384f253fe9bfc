import numpy as np
import pytest

from tests.support.calibrated import calibrated, noisy


@pytest.fixture
def untouched():
    """A calibration of untouched skin with noise."""
    return calibrated(noisy(np.random.default_rng(0)))
