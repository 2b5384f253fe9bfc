import json

import numpy as np
import pytest

from skin_host.evaluation.localization_trials import (
    METHODS,
    Case,
    PressedSkin,
    errors,
    localizer_for,
    separation,
)
from skin_host.evaluation.papers.contacts_report import (
    SCHEMA,
    ContactsPlan,
    describe,
    measure,
    write_page,
)

pytestmark = pytest.mark.long


@pytest.mark.parametrize(("probe_mm", "limit_mm"), [(10.0, 0.3), (6.0, 0.8)])
def test_on_the_emulated_skin_the_template_reaches_its_goal(probe_mm, limit_mm):
    localizers = {str(method): localizer_for(method, probe_mm) for method in METHODS}
    found = errors(Case(probe_mm), localizers, np.random.default_rng(1), 300, timed=False)
    best = min(found[method].rms_mm for method in METHODS if method != "template")
    assert found["template"].rms_mm < min(limit_mm, best)


def test_a_skin_that_is_drawn_down_around_the_probe_does_not_break_the_template():
    localizers = {"template": localizer_for("template", 10.0)}
    case = Case(10.0, membrane_mm=0.25)
    found = errors(case, localizers, np.random.default_rng(2), 200, timed=False)
    assert found["template"].rms_mm < 0.3


def test_a_covered_pad_reads_what_the_case_asks_for():
    skin = PressedSkin(np.random.default_rng(3))
    units = skin.read([(skin.centre_mm[3], 10.0, 57.0)], noise_units=0.0)
    assert units[3] == 57.0
    assert units.max() == 57.0


def test_probes_farther_apart_are_told_apart_more_often():
    near, _ = separation(np.random.default_rng(4), 10.0, 40)
    far, alone = separation(np.random.default_rng(4), 18.0, 40)
    assert far > max(near, 0.95)
    assert alone == 0.0


@pytest.fixture(scope="module")
def report():
    return measure(ContactsPlan(2, 2_000, 1, 1.0, 5, 0.01))


def test_the_report_has_every_table_and_numbers_in_all_of_them(report):
    assert set(report) == {
        "localization",
        "separation",
        "intrinsic",
        "bounds",
        "tasks",
        "calibrations",
        "slip",
        "placements",
    }
    for rows in report.values():
        for row in rows:
            assert row.keys() == rows[0].keys()
            assert all(np.isfinite(v) for v in row.values() if isinstance(v, float))
    shown = describe({"schema": SCHEMA, "quick": True, "seconds": 1.0, "tables": report})
    for case in ("pin rotation off centre", "template, any size", "ratio drop", "LRT"):
        assert case in shown


def test_intrinsic_errors_fall_as_the_force_grows_and_are_foreseen(report):
    rows = report["intrinsic"]
    error = [row["rms_mm"] for row in rows]
    assert error == sorted(error, reverse=True)
    for row in rows[1:]:
        assert row["rms_mm"] == pytest.approx(row["first_order_mm"], rel=0.1)


def test_page_pictures_and_numbers_are_written(report, tmp_path):
    folder = tmp_path / "new"
    document = {"schema": SCHEMA, "quick": True, "seconds": 1.0, "tables": report}
    write_page(document, folder)
    assert json.loads((folder / "contacts.json").read_bytes()) == document
    page = (folder / "contacts.html").read_text()
    pictures = sorted(folder.glob("*.png"))
    assert len(pictures) == 3
    for picture in pictures:
        assert f'src="{picture.name}"' in page
        assert picture.stat().st_size > 10_000
