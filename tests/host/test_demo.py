"""The demo, as somebody runs it who has just cloned the project and has no mosquitto."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from skin_host import demo
from skin_host.errors import SkinError
from skin_host.viewer.server import Viewer
from tests.support.broker import free_port

ROOT = Path(__file__).parents[2]


def test_the_demo_ends_by_itself_with_a_summary_of_touches(tmp_path):
    script = "import sys, skin_host.publish.broker as broker; broker._MORE_PLACES = (); "
    script += "from skin_host.cli import main; sys.exit(main())"
    result = subprocess.run(
        [sys.executable, "-c", script, "demo", "--duration", "9.5", "--page-port", "0"],
        cwd=ROOT,
        env=os.environ | {"PATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert "Traceback" not in result.stderr
    # While the first calibration is being taken, that there is none is no news.
    assert "not calibrated" not in result.stderr
    summary = json.loads(result.stdout.splitlines()[-1])
    assert summary["broker"] == "amqtt"
    assert summary["sweeps"] > 100
    assert summary["frames_published"] > 50
    # On a busy machine the emulated robot is held up between two frames of a triangle; how often,
    # only the machine knows.
    assert 0 <= summary["frames_lost"] < summary["sweeps"]
    assert summary["touches_begun"] >= 1
    assert summary["touches_ended"] == summary["touches_begun"]
    assert summary["bus"] in {"virtual", "socketcan"}


async def test_where_the_usual_port_is_taken_the_page_is_at_another(monkeypatch):
    viewer = Viewer(f"mqtt://127.0.0.1:{free_port()}", robot="demo")
    async with demo.served(viewer, 0) as taken:
        port = int(taken.rstrip("/").rpartition(":")[2])
        monkeypatch.setattr(demo, "PAGE_PORT", port)
        async with demo.served(viewer, None) as elsewhere:
            assert elsewhere != taken
        with pytest.raises(SkinError, match="Address already in use; choose another port"):
            async with demo.served(viewer, port):
                pass
