"""What `make docs` does to the pages: README is the front page, and an API reference is made.

The pages are written to be read in the repository. Links out of `docs/` lead to files that a site
does not have; there they are words.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
#: What programs of others import, in the order in which they need it.
MODULES = (
    "skin_host.client",
    "skin_host.errors",
    "skin_host.recording.replay",
    "skin_host.recording.export",
    "skin_host.config.settings",
    "skin_host.layout",
    "skin_host.processing.relaxation.base",
    "emulator.robot",
    "emulator.probes.scene",
    "emulator.faults",
)
_OUTWARD = re.compile(r"\[([^\]]+)\]\(\.\./[^)]*\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not in `docs/`."""
    front = _on_site((ROOT / "README.md").read_text())
    for name in ("CHANGELOG", "CONTRIBUTING", "SECURITY"):
        front = front.replace(f"]({name}.md)", f"]({name.lower()}.md)")
        text = _on_site((ROOT / f"{name}.md").read_text())
        files.append(File.generated(config, f"{name.lower()}.md", content=text))
    files.append(File.generated(config, "index.md", content=front))
    reference = "# Python\n\n" + "\n\n".join(f"::: {module}" for module in MODULES) + "\n"
    files.append(File.generated(config, "python.md", content=reference))
    return files


def _on_site(text: str) -> str:
    """A page of the repository's own folder, with the links that it has on the site."""
    text = text.replace("](docs/", "](")
    return re.sub(r"\[([^\]]+)\]\((?:config|examples|systemd)[^)]*\)", r"\1", text)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Turn links out of the site into words."""
    return _OUTWARD.sub(r"\1", markdown)
