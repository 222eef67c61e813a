"""Downloads of model files from the Hugging Face hub."""

from __future__ import annotations

from pathlib import Path

from vla.io.documents import lines_of
from vla.io.errors import UserError

HUB = "hub:"  # before the name of a model
TIMEOUT = 10  # until the hub counts as unreachable [s]


def fetch(name: str, *patterns: str, advice: str = "") -> Path:
    """Return a folder with the files of a model that match the patterns, downloading those that are not cached.

    Args:
        name: OWNER/NAME or OWNER/NAME@REVISION, optionally after "hub:"; a revision is a branch, a tag or a commit.
        patterns: wildcard patterns of file names.
        advice: what the user can do if it fails, for the error message.

    Raises:
        UserError: there is no such model, or the hub is unreachable and the model is not cached.
    """
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, RepositoryNotFoundError, RevisionNotFoundError

    reason, (repository, _, revision) = _connection_problem(), name.removeprefix(HUB).partition("@")
    try:
        options = {"local_files_only": reason is not None}
        return Path(snapshot_download(repository, revision=revision or None, allow_patterns=list(patterns), **options))
    except Exception as error:  # of many types, also for what a proxy answers in place of the hub
        if isinstance(error, HFValidationError):
            reason = "models are called OWNER/NAME there"
        elif isinstance(error, RepositoryNotFoundError | RevisionNotFoundError):
            reason = f"it has no public model {repository}{f' at {revision}' if revision else ''}"
        reason = reason or lines_of(error)[0]
        advice = advice and f"; {advice}"
        raise UserError(f"{name} cannot be fetched from the Hugging Face hub: {reason}{advice}") from error


def _connection_problem() -> str | None:
    """Return why the hub is unreachable, or None; without this check a download would wait without a timeout."""
    from huggingface_hub import constants, get_session

    if constants.HF_HUB_OFFLINE:
        return "HF_HUB_OFFLINE is set"
    try:
        get_session().head(constants.ENDPOINT, timeout=TIMEOUT)  # any status will do
    except Exception as error:  # of many types, also for an HF_ENDPOINT that is no address
        return lines_of(error)[0]
    return None
