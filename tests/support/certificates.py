"""Certificates for tests, by openssl."""

import subprocess
from pathlib import Path

from tests.support.programs import require


def openssl(folder: Path, *arguments: str) -> None:
    subprocess.run([require("openssl"), *arguments], cwd=folder, check=True, capture_output=True)


def authority(folder: Path, name: str) -> None:
    """NAME.key and NAME.crt of an authority of our own."""
    openssl(
        folder, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2",
        "-keyout", f"{name}.key", "-out", f"{name}.crt", "-subj", f"/CN=test {name}",
    )  # fmt: skip


def certificate(folder: Path, name: str, address: str, days: int = 2) -> None:
    """NAME.key and NAME.crt for an address such as IP:127.0.0.1, signed by the authority `ca`."""
    openssl(
        folder, "req", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key",
        "-out", f"{name}.csr", "-subj", "/CN=broker", "-addext", f"subjectAltName={address}",
    )  # fmt: skip
    openssl(
        folder, "x509", "-req", "-in", f"{name}.csr", "-CA", "ca.crt", "-CAkey", "ca.key",
        "-days", str(days), "-copy_extensions", "copy", "-out", f"{name}.crt",
    )  # fmt: skip
