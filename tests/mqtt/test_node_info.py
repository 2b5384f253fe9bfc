"""What a node says of itself is enough to draw its skin."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from skin_host.config.settings import changed, load, skin_hash
from skin_host.layout import build_layout
from skin_host.mqtt.info import CalibrationInfo, decode_info, encode_info, node_info
from skin_host.mqtt.payload import MessageError

CONFIG = Path(__file__).parents[2] / "config" / "demo.toml"


def test_info_describes_every_taxel_of_every_part_of_the_node() -> None:
    settings = load(CONFIG)
    layout = build_layout(settings, CONFIG.parent)
    calibration = CalibrationInfo("abc", "2026-01-01T00:00:00+00:00")
    sent = node_info(
        layout,
        "main",
        version="1.2.3",
        configuration=skin_hash(settings),
        calibration=calibration,
    )
    seen = decode_info(encode_info(sent))
    assert seen == sent
    assert list(seen.parts) == [part.name for part in layout.parts]
    for part in layout.parts:
        info = seen.parts[part.name]
        mine = slice(part.start, part.stop)
        assert len(info.pads) == part.n_taxels
        np.testing.assert_allclose(info.position_m, layout.position_m[mine], atol=1e-6)
        np.testing.assert_allclose(info.normal, layout.normal[mine], atol=1e-4)
        assert [triangle.first % 12 for triangle in info.triangles] == [0] * len(info.triangles)
        assert [triangle.first for triangle in info.triangles] == sorted(
            triangle.first for triangle in info.triangles
        )


def test_info_names_the_parts_whose_frames_are_not_published() -> None:
    settings = load(CONFIG)
    settings = changed(settings, {"parts.left_hand.frames": False})
    layout = build_layout(settings, CONFIG.parent)
    payload = encode_info(
        node_info(layout, "main", version="1", configuration="x", parts=settings.parts)
    )
    parts = decode_info(payload).parts
    assert {name: part.frames for name, part in parts.items()} == {
        "left_hand": False,
        "left_forearm": True,
    }
    # Those of earlier versions, which publish frames of all, have no such key.
    assert payload.count(b'"frames":') == 1


def test_a_node_without_parts_says_so() -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    assert node_info(layout, "elsewhere", version="1", configuration="x").parts == {}


@pytest.mark.parametrize("payload", [b"", b"{}", b"[]", b"\xff", b"[" * 5000])
def test_nonsense_is_refused(payload: bytes) -> None:
    with pytest.raises(MessageError):
        decode_info(payload)


def test_lists_of_different_lengths_are_refused() -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    payload = encode_info(node_info(layout, "main", version="1", configuration="x"))
    with pytest.raises(MessageError, match="differ in length"):
        decode_info(payload.replace(b'"pads":["pressure",', b'"pads":[', 1))


@pytest.mark.parametrize("name", ["N" * 65_000, "a" * 65, "<script>", "\u202eh", "a\n", "a/b", ""])
def test_a_part_of_a_name_that_no_configuration_has_is_refused(name: str) -> None:
    layout = build_layout(load(CONFIG), CONFIG.parent)
    info = node_info(layout, "main", version="1", configuration="x")
    parts = {name: info.parts["left_hand"]}
    with pytest.raises(MessageError, match="info: "):
        decode_info(encode_info(replace(info, parts=parts)))
    assert decode_info(encode_info(info)) == info
