"""Files of models on the Hugging Face hub."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import urlopen

PATIENCE = 10  # [s] until the hub counts as out of reach


def fetch(repository: str, *patterns: str) -> Path:
    """The folder with those files of a model that match the patterns; what was downloaded before is not again.

    Raises:
        OSError: there is no such model, or the hub cannot be reached and the model was never downloaded; in one line.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    reason = _unreachable()
    try:
        return Path(snapshot_download(repository, allow_patterns=list(patterns), local_files_only=reason is not None))
    except (HfHubHTTPError, HFValidationError) as error:
        raise OSError(f"it has no model {repository} for everybody") from error
    except OSError as error:
        raise OSError(reason or str(error).partition("\n")[0]) from error


def _unreachable() -> str | None:
    """Why the hub cannot be reached, if so: a download would try again for most of a minute before it gives up."""
    from huggingface_hub import constants

    if constants.HF_HUB_OFFLINE:
        return "HF_HUB_OFFLINE is set"
    try:
        with suppress(HTTPError):  # an answer
            urlopen(constants.ENDPOINT, timeout=PATIENCE).close()
    except OSError as error:
        return str(error)
    return None
