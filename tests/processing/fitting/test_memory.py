"""The foam's memory is fitted only where the course of pressure shows one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skin_host.processing.curves import Memory
from skin_host.processing.fitting.memory import fit_memory, loading_kpa, unloads

Floats = NDArray[np.float64]

DT_S = 0.1
KPA_PER_UNIT = 8.0


def stairs(top_kpa: float, hold_s: float) -> Floats:
    """Levels one after the other, only up [t]."""
    levels = np.linspace(5.0, top_kpa, 25)
    course = np.repeat(levels, round(hold_s / DT_S))
    padded = np.pad(course, 10, mode="edge")
    return np.convolve(padded, np.ones(21) / 21, "valid")


def creeping(pressure: Floats, share: float, tau_s: float) -> Floats:
    """Activations [t] of a pad of which a share follows late, and the same way back as forth."""
    units = pressure / KPA_PER_UNIT
    late = np.empty_like(units)
    state = units[0]
    for row, value in enumerate(units.tolist()):
        state += DT_S / (DT_S + tau_s) * (value - state)
        late[row] = state
    return (1.0 - share) * units + share * late


def fitted(units: Floats, pressure: Floats, seed: int, noise_kpa: float = 0.7) -> Memory:
    rng = np.random.default_rng(seed)
    measured = pressure + noise_kpa * rng.standard_normal(len(pressure))
    read = units + 0.05 * rng.standard_normal(len(units))
    return fit_memory(read, measured, np.full(len(pressure), 0.25))


@settings(max_examples=20)
@given(
    top_kpa=st.floats(40.0, 400.0),
    hold_s=st.floats(2.0, 12.0),
    share=st.floats(0.0, 0.3),
    tau_s=st.floats(1.0, 100.0),
    seed=st.integers(0, 1000),
)
def test_a_course_that_only_rises_shows_no_hysteresis(
    top_kpa: float, hold_s: float, share: float, tau_s: float, seed: int
) -> None:
    pressure = stairs(top_kpa, hold_s)
    assert not unloads(pressure)
    assert fitted(creeping(pressure, share, tau_s), pressure, seed) == Memory()


@pytest.mark.parametrize("tau_s", [3.0, 10.0])
def test_creep_of_a_way_up_and_down_is_a_light_play_or_none(tau_s: float) -> None:
    up = stairs(338.0, 6.0)
    pressure = np.concatenate([up, up[::-1]])
    assert unloads(pressure)
    memory = fitted(creeping(pressure, 0.1, tau_s), pressure, 0)
    assert sum(memory.weight) < 0.4


def test_a_play_that_a_way_up_and_down_shows_is_found() -> None:
    foam = Memory((25.0,), (0.3,))
    up = stairs(338.0, 6.0)
    pressure = np.concatenate([up, up[::-1]])
    found = fitted(loading_kpa(pressure, foam) / KPA_PER_UNIT, pressure, 0)
    width_kpa = sum(r * w for r, w in zip(found.radius_kpa, found.weight, strict=True))
    assert width_kpa == pytest.approx(7.5, rel=0.2)


def test_a_play_narrower_than_the_pressure_is_known_is_none() -> None:
    foam = Memory((4.0,), (0.3,))
    up = stairs(338.0, 6.0)
    pressure = np.concatenate([up, up[::-1]])
    assert fitted(loading_kpa(pressure, foam) / KPA_PER_UNIT, pressure, 0) == Memory()


def test_spikes_of_the_pressure_are_no_unloading() -> None:
    pressure = stairs(338.0, 6.0)
    pressure[5::8] -= 30.0
    assert not unloads(pressure)
    assert fitted(creeping(stairs(338.0, 6.0), 0.1, 10.0), pressure, 0) == Memory()
