"""Downloads of model files from the Hugging Face hub."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

TIMEOUT = 10  # until the hub counts as unreachable [s]


def fetch(repository: str, *patterns: str, revision: str | None = None) -> Path:
    """Return a folder with the files of a model that match the patterns, downloading those that are not cached.

    Args:
        repository: OWNER/NAME.
        patterns: of the names of the files.
        revision: a branch, a tag or a commit; None: the newest.

    Raises:
        OSError: there is no such model, or the hub is unreachable and the model is not cached; the text is one line.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    reason, name = _unreachable(), f"{repository} at {revision}" if revision else repository
    try:
        cached = {"local_files_only": reason is not None}
        return Path(snapshot_download(repository, revision=revision, allow_patterns=list(patterns), **cached))
    except (HfHubHTTPError, HFValidationError) as error:
        raise OSError(f"it has no public model {name}") from error
    except OSError as error:
        raise OSError(reason or str(error).partition("\n")[0]) from error


def _unreachable() -> str | None:
    """Return why the hub is unreachable, or None; without this check a download retries for most of a minute."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "HF_HUB_OFFLINE is set"
    try:
        with suppress(HTTPError):  # also a response
            urlopen(constants.ENDPOINT, timeout=TIMEOUT).close()
    except OSError as error:
        return str(error)
    return None
