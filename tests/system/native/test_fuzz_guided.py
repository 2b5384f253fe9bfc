"""Coverage-guided fuzzing of everything that strangers can send. FUZZ_SECONDS sets its length."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
SECONDS = float(os.environ.get("FUZZ_SECONDS", "15"))


def test_guided_fuzzing_finds_no_crash(tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris is not installed")
    fuzz = [sys.executable, "-m", "tests.fuzz.guided", f"{SECONDS:.0f}"]
    done = subprocess.run(
        fuzz,
        check=False,
        capture_output=True,
        text=True,
        timeout=SECONDS + 120,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr[-3000:]
