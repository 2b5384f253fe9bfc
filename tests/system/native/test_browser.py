"""The browser of the system tests opens pages and runs their scripts."""

from pathlib import Path

from tests.support.browser import page_text, screenshot

_PAGE = """<!doctype html><title>t</title><p id=p>still</p>
<script>setTimeout(() => { p.textContent = "six times seven is " + 6 * 7 }, 300)</script>"""


def test_scripts_run(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_text(_PAGE)
    assert "six times seven is 42" in page_text(page.as_uri(), tmp_path / "profile")


def test_a_picture_of_the_page_is_taken(tmp_path: Path) -> None:
    page, picture = tmp_path / "page.html", tmp_path / "page.png"
    page.write_text(_PAGE)
    screenshot(page.as_uri(), tmp_path / "profile", picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
