"""Every mark and every word of the page can be told from what it lies on, in both themes."""

import re
from pathlib import Path

import pytest

import skin_host.viewer

CSS = (Path(skin_host.viewer.__file__).parent / "page/page.css").read_text()
ROOTS = re.findall(r"^:root[^{]*\{(.*?)\}", CSS, re.MULTILINE | re.DOTALL)
THEMES = {
    name: dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block))
    for name, block in zip(("dark", "light"), ROOTS, strict=True)
}


def contrast(one: str, other: str) -> float:
    """WCAG 2.2, relative luminance."""

    def luminance(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize(
    ("mark", "least"),
    [("rim", 3.0), *((name, 4.5) for name in ("text", "dim", "ok", "warn", "alarm", "accent"))],
)
def test_marks_stand_out(theme: str, mark: str, least: float) -> None:
    colours = THEMES[theme]
    for ground in ("panel", "body"):
        assert contrast(colours[mark], colours[ground]) >= least
    assert contrast(colours["on-accent"], colours["accent"]) >= 4.5
