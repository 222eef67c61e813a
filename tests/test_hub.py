"""Files from a hub that runs on this machine."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from huggingface_hub import constants

from vla.io.errors import UserError
from vla.models.hub import fetch

FILES = {"config.json": "{}", "model.safetensors": "weights", "pytorch_model.bin": "pickle"}
COMMIT = "0" * 40
ENTRIES = [{"type": "file", "path": name, "size": len(content), "oid": name} for name, content in FILES.items()]
ANSWERS = {  # of as much of the hub as a download needs, with one model, `somebody/model`
    "/api/models/somebody/model/revision/main": json.dumps({"id": "somebody/model", "sha": COMMIT, "siblings": []}),
    f"/api/models/somebody/model/tree/{COMMIT}": json.dumps(ENTRIES),
    "/api/models/somebody/portal/revision/main": "<html>Log in to use this network</html>",
    **{f"/somebody/model/resolve/{COMMIT}/{name}": content for name, content in FILES.items()},
}


class Hub(BaseHTTPRequestHandler):
    """Answers, and remembers the names of files that are downloaded."""

    downloads: list[str]

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        body, name = ANSWERS.get(path, "").encode(), path.rpartition("/")[2]
        headers = {"ETag": f'"{name}"', "X-Repo-Commit": COMMIT, "Content-Length": str(len(body))}
        self.send_response(200 if body else 404)
        for key, value in (headers if body else {"X-Error-Code": "RepoNotFound"}).items():
            self.send_header(key, value)
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)
            self.downloads += [name] if "/resolve/" in path else []

    do_HEAD = do_GET

    def log_message(self, format: str, *arguments: object) -> None:
        """Nothing."""


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[list[str]]:
    """The names of the files that were downloaded from the hub while it runs."""
    Hub.downloads = []
    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        here = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setattr(constants, "ENDPOINT", here)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", here + "/{repo_id}/resolve/{revision}/{filename}")
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
        yield Hub.downloads
        server.shutdown()
        thread.join()


def test_what_matches_is_downloaded_once_and_is_there_without_the_hub(
    downloads: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fetch("somebody/model", "*.json", "model*.safetensors")
    assert (folder / "model.safetensors").read_bytes() == b"weights"
    assert sorted(path.name for path in folder.iterdir()) == sorted(downloads) == ["config.json", "model.safetensors"]
    assert fetch("somebody/model", "*.json", "model*.safetensors") == folder
    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    assert fetch("somebody/model", "*.json", "model*.safetensors") == folder
    assert len(downloads) == 2


def test_a_model_that_the_hub_has_not_is_named(downloads: list[str]) -> None:
    with pytest.raises(UserError, match="it has no public model nobody/model"):
        fetch("nobody/model", "*")
    with pytest.raises(UserError, match=r"no/name/at/all cannot be fetched .*: models are called OWNER/NAME there"):
        fetch("no/name/at/all", "*")


def test_what_answers_in_place_of_the_hub_is_an_error_of_one_line(downloads: list[str]) -> None:
    with pytest.raises(UserError, match=r"somebody/portal cannot be fetched from the Hugging Face hub: .+") as caught:
        fetch("somebody/portal", "*")
    assert "\n" not in str(caught.value)


def test_without_the_hub_the_reason_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    hubs = {"here": "protocol", "http://a:b": "port", "http://127.0.0.1:9": "refused", "": "OFFLINE"}
    for endpoint, reason in hubs.items():
        monkeypatch.setattr(constants, "ENDPOINT", endpoint)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", not endpoint)
        with pytest.raises(UserError, match=reason) as caught:
            fetch("somebody/model", "*")
        assert "\n" not in str(caught.value)
