"""The benchmark of the receive path measures what it says."""

import pytest

from skin_host.evaluation.bench_receive import measure
from skin_host.evaluation.can_stream import StreamWire

pytestmark = pytest.mark.long


@pytest.mark.parametrize("path", ["batch", "kernel"])
def test_a_path_reads_the_whole_stream(path: str) -> None:
    row = measure(StreamWire.here(), path, 2000, 2.0)
    assert row["path"] == path
    assert row["lost"] == 0
    assert row["received_per_s"] > 0
    assert row["ns_per_frame"] > 0
