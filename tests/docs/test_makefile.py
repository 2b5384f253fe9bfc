"""The Makefile installs what its targets need."""

import re
import tomllib

from tests.support.pages import ROOT


def test_every_stamp_that_a_target_needs_installs_an_extra_of_the_package() -> None:
    makefile = (ROOT / "Makefile").read_text()
    needed = set(re.findall(r"\.venv/(\w+)\.stamp", makefile)) - {"demo"}
    installed = dict(re.findall(r"^\.venv/(\w+)\.stamp: EXTRAS := \[(\w+)\]", makefile, re.M))
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert needed == installed.keys()
    assert set(installed.values()) <= extras["optional-dependencies"].keys()
