"""Promises judge numbers by the emulator's truth: what a daemon gets wrong alike, they find."""

from collections.abc import Callable
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from skin_host.cli.common import load_skin
from skin_host.config.settings import TouchSettings
from skin_host.demo import configuration
from skin_host.evaluation.simulate.promises.contacts import least_mean
from skin_host.evaluation.simulate.run import simulate
from skin_host.evaluation.simulate.troubles.catalogue import APART, kinds_of
from skin_host.fingertip.events import Over, Slip
from skin_host.fingertip.tip import Tip
from skin_host.processing import rules, touch
from skin_host.processing.contacts import ContactTracker
from skin_host.processing.events import Touch
from skin_host.processing.frame import PressureFrame
from skin_host.processing.pipeline import Pipeline
from skin_host.processing.touch import Floats, Levels, levels

DEMO = configuration("demo.toml")
FINGERTIPS = configuration("fingertips.toml")
SMALL = Path(__file__).with_name("small.toml")
Patch = pytest.MonkeyPatch


def outcome(config: Path, seed: int, until_s: float) -> str:
    """What a seed breaks before a time, or an empty text."""
    settings, layout = load_skin(config)
    return simulate(settings, layout, config, seed, 30.0, until_s=until_s).broken or ""


def of_contacts(change: Callable[[Touch], dict[str, Any]]) -> Callable[[Patch], None]:
    """Events of contacts that have other numbers than were found."""

    def plant(monkeypatch: Patch) -> None:
        step = ContactTracker.step

        def off(tracker: ContactTracker, frame: PressureFrame) -> list[Touch]:
            events = step(tracker, frame)
            return [msgspec.structs.replace(event, **change(event)) for event in events]

        monkeypatch.setattr(ContactTracker, "step", off)

    return plant


def of_pressures(share: float) -> Callable[[Patch], None]:
    """Pressures that are all a share of what was found."""

    def plant(monkeypatch: Patch) -> None:
        step = Pipeline.step

        def off(*args: Any, **options: Any) -> PressureFrame:
            frame = step(*args, **options)
            return changed(frame, pressure_kpa=frame.pressure_kpa * np.float32(share))

        monkeypatch.setattr(Pipeline, "step", off)

    return plant


def of_levels(margin_units: float = 0.0, noise: float = 1.0) -> Callable[[Patch], None]:
    """Touches decided with another margin, or another noise, than there is."""

    def plant(monkeypatch: Patch) -> None:
        def off(above: Floats, spread: Floats, settings: TouchSettings) -> Levels:
            found = levels(above, noise * spread, settings)
            more = found.enter + margin_units, found.leave + margin_units
            return found._replace(enter=more[0], leave=more[1])

        monkeypatch.setattr(rules, "levels", off)

    return plant


def of_tips(change: Callable[[Touch], dict[str, Any]]) -> Callable[[Patch], None]:
    """Contacts of force/torque boards that have other numbers than were found."""

    def plant(monkeypatch: Patch) -> None:
        described = Tip._described

        def off(tip: Tip, *args: Any) -> Touch:
            event = described(tip, *args)
            return msgspec.structs.replace(event, **change(event))

        monkeypatch.setattr(Tip, "_described", off)

    return plant


def of_slips(force: float = 1.0, shear: float = 1.0) -> Callable[[Patch], None]:
    """Slips of forces that are shares of what was found."""

    def plant(monkeypatch: Patch) -> None:
        slip = Tip._slip

        def off(*args: Any) -> Slip:
            event = slip(*args)
            forces = {"force_n": force * event.force_n, "shear_n": shear * event.shear_n}
            return msgspec.structs.replace(event, **forces)

        monkeypatch.setattr(Tip, "_slip", off)

    return plant


def of_excess(monkeypatch: Patch) -> None:
    """Excesses of forces that are greater than was found."""
    over = Tip._over

    def off(*args: Any) -> Over:
        event = over(*args)
        return msgspec.structs.replace(event, force_n=1.3 * event.force_n)

    monkeypatch.setattr(Tip, "_over", off)


def of_loads(**shares: float) -> Callable[[Patch], None]:
    """Loads of fingertips with a force, a torque or a shear that is a share of what was found."""

    def change(event: Touch) -> dict[str, Any]:
        assert event.load is not None
        found = {name: getattr(event.load, name) for name in shares}
        off = {
            name: tuple(shares[name] * value for value in values)
            for name, values in found.items()
            if values is not None
        }
        return {"load": msgspec.structs.replace(event.load, **off)}

    return of_tips(change)


def further(event: Touch) -> dict[str, Any]:
    """A contact that is further from the origin than it was found."""
    if event.centroid_m is None:
        return {}
    x, y, z = event.centroid_m
    return {"centroid_m": (1.3 * x, 1.3 * y, 1.3 * z)}


def odds(monkeypatch: Patch) -> None:
    """Noise alone touches a pad once in 10^4 measurements."""
    monkeypatch.setattr(touch, "ODDS", 1e4)


def flipped(event: Touch) -> dict[str, Any]:
    if event.normal is None:
        return {}
    x, y, z = event.normal
    return {"normal": (-x, -y, -z)}


#: What is wrong, the robot, a seed that finds it, by what time (s), and with what promise.
WRONG: dict[str, tuple[Callable[[Patch], None], Path, int, float, str]] = {
    "a force in mN": (
        of_contacts(lambda event: {"force_n": 1000 * event.force_n}),
        *(SMALL, 5, 9.0, "N, and what presses it gives"),
    ),
    "a tenth of the force": (
        of_contacts(lambda event: {"force_n": 0.1 * event.force_n}),
        *(SMALL, 5, 16.0, "N, and what presses it gives"),
    ),
    "a place elsewhere": (
        of_contacts(lambda _: {"centroid_m": (9.0, 9.0, 9.0)}),
        *(SMALL, 5, 9.0, "from where its pads are pressed"),
    ),
    "a flipped normal": (of_contacts(flipped), SMALL, 5, 9.0, "which no pad of it has"),
    "no area": (of_contacts(lambda _: {"area_mm2": 0.001}), SMALL, 5, 9.0, "covers 0.001 mm2"),
    "a mean": (of_contacts(lambda _: {"mean_kpa": 1e6}), SMALL, 5, 9.0, "has a mean of 1e+06 kPa"),
    "a peak": (of_contacts(lambda _: {"peak_kpa": 1e6}), SMALL, 5, 9.0, "has a peak of 1e+06 kPa"),
    "weak pressures": (of_pressures(0.2), SMALL, 5, 16.0, "kPa while it is pressed with"),
    "strong pressures": (of_pressures(3.0), SMALL, 5, 16.0, "kPa while it is pressed with"),
    "a margin": (of_levels(margin_units=10.0), SMALL, 8, 12.0, "is valid and not touched"),
    "noise": (of_levels(noise=8.0), SMALL, 8, 12.0, "is valid and not touched"),
    "odds": (odds, DEMO, 5, 14.0, "and nothing presses there"),
    "a fingertip's force": (
        of_tips(lambda event: {"force_n": 1.3 * event.force_n}),
        *(FINGERTIPS, 1, 12.0, " presses with "),
    ),
    "a fingertip's vector of force": (
        of_loads(force_n=1.3),
        *(FINGERTIPS, 1, 12.0, " has a force of "),
    ),
    "a fingertip's torque": (
        of_loads(torque_nm=1.3),
        *(FINGERTIPS, 1, 12.0, " has a torque of "),
    ),
    "a fingertip's shear": (of_loads(shear_n=1.3), FINGERTIPS, 1, 12.0, "N off its force"),
    "a fingertip's place": (of_tips(further), FINGERTIPS, 1, 12.0, "mm from what presses it"),
    "a fingertip's normal": (of_tips(flipped), FINGERTIPS, 1, 12.0, "N off its force"),
    "the force in a slip": (of_slips(force=1.3), FINGERTIPS, 3, 10.0, "slip 1 presses with"),
    "the pull in a slip": (of_slips(shear=2.0), FINGERTIPS, 3, 10.0, "slip 1 is pulled with"),
    "the force of an excess": (of_excess, FINGERTIPS, 1, 17.0, "over 1 presses with"),
}


@pytest.mark.long
@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_in_all_numbers_alike_breaks_a_promise(name: str, monkeypatch: Patch) -> None:
    plant, config, seed, until_s, promise = WRONG[name]
    plant(monkeypatch)
    assert promise in outcome(config, seed, until_s)


@pytest.mark.long
@pytest.mark.parametrize(
    ("config", "seed", "until_s"), sorted({one[1:4] for one in WRONG.values()})
)
def test_without_a_fault_the_same_seeds_break_none(config: Path, seed: int, until_s: float) -> None:
    assert outcome(config, seed, until_s) == ""


@given(
    arrays(np.float64, (5, 3), elements=st.floats(-1, 1)),
    arrays(np.float64, (2, 5), elements=st.floats(0.01, 10)),
    arrays(np.float64, 5, elements=st.floats(0, 1)),
)
def test_no_weights_between_their_bounds_have_a_lower_mean(
    place_m: Floats, bounds: Floats, share: Floats
) -> None:
    low, high = bounds.min(axis=0), bounds.max(axis=0)
    weight = low + share * (high - low)
    least_m = least_mean(place_m, low, high)
    assert (least_m <= weight @ place_m / weight.sum() + 1e-9).all()
    # Some weights do have it.
    for axis in range(3):
        means = [
            np.average(place_m[:, axis], weights=np.where(place_m[:, axis] <= at, high, low))
            for at in [-2.0, *place_m[:, axis]]
        ]
        assert min(means) == pytest.approx(least_m[axis], abs=1e-9)


def test_a_contact_without_weight_may_be_anywhere_among_its_pads() -> None:
    place_m = np.array([[0.0, 1.0, 2.0], [3.0, 0.0, 1.0]])
    assert least_mean(place_m, np.zeros(2), np.zeros(2)).tolist() == [0.0, 0.0, 1.0]


@pytest.mark.long
def test_light_loss_and_another_host_break_no_promise() -> None:
    """The loss lasts for minutes and is named."""
    settings, layout = load_skin(SMALL)
    result = simulate(settings, layout, SMALL, 4, 30.0)
    assert result.broken is None, "\n".join([*result.last, result.broken])
    assert APART.keys() <= set(result.kinds)
    assert {result.troubles[name] for name in APART} == {1}
    assert "light_loss" in result.named


def test_storms_and_drills_draw_nothing_that_has_a_time_of_its_own() -> None:
    settings, _ = load_skin(SMALL)
    assert not APART.keys() & kinds_of(settings).keys()
