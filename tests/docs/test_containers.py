"""The container files name what there is. tests/system/containers builds and runs them, as root."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from skin_host.cli import build_parser
from tests.support.pages import ROOT

FOLDER = ROOT / "containers"
CONTAINERFILE = (FOLDER / "Containerfile").read_text()


def test_what_is_copied_into_the_image_is_there_and_enough_for_a_wheel() -> None:
    copied = {
        name
        for line in re.findall(r"^COPY (?!--from)(.*)$", CONTAINERFILE, re.MULTILINE)
        for name in line.split()[:-1]
    }
    assert all((ROOT / name).exists() for name in copied)
    assert {"skin_host", "emulator", "config", "pyproject.toml", "README.md", "LICENSE"} <= copied


def test_the_linter_finds_nothing() -> None:
    hadolint = shutil.which("hadolint", path=str(Path(sys.executable).parent))
    if hadolint is None:
        pytest.skip("hadolint is not installed (extra `dev`, on x86-64)")
    subprocess.run([hadolint, FOLDER / "Containerfile"], check=True)


def test_the_services_follow_the_compose_specification() -> None:
    """By the schema that it publishes."""
    schema = ["--builtin-schema", "vendor.compose-spec"]
    program = shutil.which("check-jsonschema", path=str(Path(sys.executable).parent))
    if program is None:
        pytest.skip("check-jsonschema is not installed (extra `dev`)")
    subprocess.run([program, *schema, FOLDER / "compose.yaml"], check=True)


def test_the_commands_of_the_services_are_ours() -> None:
    services = yaml.safe_load((FOLDER / "compose.yaml").read_text())["services"]
    for name in ("daemon", "page"):
        build_parser().parse_args(shlex.split(services[name]["command"]))
        assert services[name]["network_mode"] == "host"
    (default,) = re.findall(r'^CMD \["(\w+)"\]$', CONTAINERFILE, re.MULTILINE)
    build_parser().parse_args([default])
    extras = re.findall(r"'\.\[([\w,]+)\]'", CONTAINERFILE)[0].split(",")
    known = re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert set(extras) <= set(known)
