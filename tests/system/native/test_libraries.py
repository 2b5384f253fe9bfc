"""The page's libraries from the registries themselves."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def test_a_machine_without_npm_gets_it_from_pypi(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    monkeypatch.setenv("PATH", str(tmp_path))
    hook.fetch(ROOT / "skin_host/viewer/npm", tmp_path)
    for name in hook.FILES:
        assert (tmp_path / "node_modules" / name).stat().st_size > 1000
