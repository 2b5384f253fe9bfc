"""`skin calibrate --pressure`: where gains and curves are kept that were fitted to a recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skin_host.config.settings import load
from skin_host.daemon.calibrate import calibration_path
from skin_host.daemon.memory import remembered
from skin_host.daemon.state import Zeros, kept_path
from skin_host.daemon.workers import share_name, share_of
from skin_host.files import write_document
from skin_host.layout import build_layout
from skin_host.processing.calibration import Calibration, Verdict, identified
from tests.support.limbs import (
    ARM,
    LEG,
    calibrate,
    keep,
    pressed,
    ramp,
    stored,
    write_config,
    write_log,
)


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A robot whose limbs have a bus each."""
    config = write_config(tmp_path)
    text = config.read_text().replace("[boards.a]", '[buses.can1]\nchannel = "can1"\n[boards.a]')
    config.write_text(text.replace('[boards.b]\nbus = "can0"', '[boards.b]\nbus = "can1"'))
    return config


@pytest.fixture
def recording(bench: Path, tmp_path: Path) -> tuple[Path, Path]:
    """Of the arm under pressure, and its table."""
    units, table = ramp(bench)
    return write_log(tmp_path / "arm.log", pressed(units, ARM), boards=(3,)), table


@pytest.fixture
def untouched(bench: Path, tmp_path: Path, recording: tuple[Path, Path]) -> Calibration:
    """A later calibration of both limbs, with a gain for each pad."""
    other = tmp_path / "fitted.json"
    assert calibrate(bench, *recording, "--output", other) == 0
    found = stored(bench, other)
    return identified(
        replace(
            found,
            curves=None,
            baseline=found.baseline + 2.0,
            gain=np.linspace(0.5, 1.5, len(found.gain)).round(6),
            verdict=np.full_like(found.verdict, Verdict.OK),
            time="2026-01-01T00:00:00+00:00",
        )
    )


def test_workers_use_curves_that_were_fitted_for_their_node(
    bench: Path,
    recording: tuple[Path, Path],
    untouched: Calibration,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """They have newer zeros than the recording, and keep them."""
    settings = load(bench)
    shares = {share_name("main", n): share_of(settings, "main", n, 2) for n in (1, 2)}
    for name, part in zip(shares, ("arm", "leg"), strict=True):
        zeros = Zeros(calibration=untouched.id, written="2026-02-01T00:00:00+00:00", parts=[part])
        write_document(kept_path(settings, name, "zeros"), zeros)
        keep(bench, calibration_path(settings, name), untouched)
    capsys.readouterr()
    assert calibrate(bench, *recording) == 0
    assert capsys.readouterr().out.endswith("gains and curves kept for main-1, main-2, too\n")
    for name, its in {**shares, "main": settings}.items():
        found = remembered(its, build_layout(its, bench.parent), name, "main").calibration
        assert found is not None
        assert found.curves is not None
        assert found.curves.own[ARM].all()
        np.testing.assert_allclose(found.baseline, untouched.baseline, atol=1e-6)
        np.testing.assert_array_equal(found.gain[LEG], untouched.gain[LEG])
        np.testing.assert_array_equal(found.verdict[LEG], untouched.verdict[LEG])


def test_a_node_that_is_only_named_like_a_worker_keeps_its_gains(
    bench: Path, recording: tuple[Path, Path], untouched: Calibration
) -> None:
    bench.write_text(bench.read_text().replace("[parts.leg]", '[parts.leg]\nnode = "main-2"'))
    path = calibration_path(load(bench), "main-2")
    keep(bench, path, untouched)
    before = path.read_bytes()
    assert calibrate(bench, *recording) == 0
    assert path.read_bytes() == before


def test_a_fit_replaces_no_calibration_of_another_configuration_without_a_second_name(
    bench: Path, recording: tuple[Path, Path], untouched: Calibration
) -> None:
    """It may hold curves that are in no other file."""
    path = calibration_path(load(bench), "main")
    keep(bench, path, replace(untouched, configuration="0123456789ab"))
    before = path.read_bytes()
    assert calibrate(bench, *recording) == 0
    (former,) = [one for one in path.parent.iterdir() if ".former-" in one.name]
    assert former.read_bytes() == before
    assert path.read_bytes() != before
