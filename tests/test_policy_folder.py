"""A policy in a folder: what is written is read, and what somebody else made of it ends in one sentence."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_batch import make_bc
from huggingface_hub import constants
from safetensors.torch import load_file, save_file
from saved_policies import change_json, save_policy
from toy import SPEC

from vla.api import load_policy
from vla.io.errors import UserError
from vla.models.policy_folder import TensorBudget, policy_folder, read_policy, require_unseen
from vla.models.trunk_folder import open_safetensors

CONFIG: dict[str, Any] = {"task": {}, "tokenizer": {}, "model": {}}  # as much as a policy has at the least
FILES = ["README.md", "config.json", "model.safetensors", "spec.json", "training.json"]


def saved(folder: Path, **further: Any) -> Path:
    """The policy of a small model."""
    return save_policy(folder, CONFIG, state=make_bc().state_dict(), **further)


def test_a_policy_is_read_as_it_was_written(tmp_path: Path) -> None:
    config = CONFIG | {"validate": {"seed": 7, "episodes": 3}, "seed": 5, "output": "mine", "logger": {}}
    model = make_bc()
    figures = {"val/success": 0.5, "val/loss": float("nan")}
    further: dict[str, Any] = {"global_step": 9, "OwnDataModule": {"windows": "ab"}, "figures": figures}
    save_policy(tmp_path, config, state=model.state_dict(), **further)
    found = read_policy(tmp_path)
    assert found.spec == SPEC and found.config == {name: config[name] for name in (*CONFIG, "validate", "seed")}
    made = found.training
    assert (made.steps, made.windows, made.seed, made.validation) == (9, "ab", 5, (7, 3))
    assert made.figures == {"val/success": 0.5} and made.versions["torch"] in torch.__version__
    again = make_bc()
    found.restore(again)
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in model.state_dict().items())
    assert sorted(path.name for path in tmp_path.iterdir()) == FILES
    card = (tmp_path / "README.md").read_text()
    assert "| actions | " + ", ".join(SPEC.action) in card and "| val/success | 0.5 |" in card
    with pytest.raises(ValueError, match=r"episodes 7 to 9 selected the weights in .*set evaluate\.seed=10 or another"):
        require_unseen(tmp_path, "evaluate.seed", range(12))


def test_a_policy_replaces_the_one_before_it_and_leaves_nothing_beside(tmp_path: Path) -> None:
    folder = tmp_path / "run/policy"
    for steps in (1, 2):
        saved(folder, global_step=steps)
        assert read_policy(tmp_path / "run").training.steps == steps
        assert [path.name for path in folder.parent.iterdir()] == ["policy"]
    with pytest.raises(ValueError, match="Out of range float"):
        save_policy(folder, CONFIG | {"seed": float("nan")})
    assert read_policy(folder).training.steps == 2 and len(list(folder.parent.iterdir())) == 1


def test_what_modules_keep_besides_weights_is_in_the_file_of_the_weights(tmp_path: Path) -> None:
    within = {"_extra_state": {"name": "x"}, "a.b": torch.ones(2)[:1]}
    save_policy(tmp_path, CONFIG, state=within)
    assert read_policy(tmp_path).state == within


def test_equal_policies_have_the_same_digest(tmp_path: Path) -> None:
    further = {f"{part}._extra_state": {"name": f'"ä" {part}'} for part in ("text", "tokenizer", "ähnlich", "x")}
    folders = [save_policy(tmp_path / str(number), CONFIG, state=further | {"x": torch.ones(1)}) for number in range(6)]
    assert len({read_policy(folder).training.weights for folder in folders}) == 1
    assert read_policy(folders[0]).state == further | {"x": torch.ones(1)}


def test_weights_that_a_policy_names_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def model(trunk: object, file: object) -> dict[str, Any]:
        image = {"name": "trunk", "pretrained": str(file)}
        return {"trunk": str(trunk), "text": {"name": str(trunk)}, "image": image, "network": {"image": image}}

    monkeypatch.chdir(tmp_path)
    Path("trunk").mkdir()
    Path("blob").touch()
    Path("encoder.pth").symlink_to("blob")  # as in the hub's cache
    for given, stored in {
        ("trunk", "encoder.pth"): (tmp_path / "trunk", tmp_path / "encoder.pth"),
        ("hub:a/b", "auto"): ("hub:a/b", "auto"),
    }.items():
        found = read_policy(save_policy(Path("policy"), {**CONFIG, "model": model(*given)})).config
        assert found["model"] == model(*stored)


def test_what_is_no_policy_is_said_with_what_would_be_one(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints/last.ckpt").touch()
    for name, says in {
        "nowhere": "there is no policy '.*nowhere': name a run",
        "run": r"run is neither a policy nor a run with one, there is no .*run/policy/spec\.json$",
        "run/checkpoints/last.ckpt": r"last\.ckpt serves only to resume its own training: .*folder of the run, .*run$",
    }.items():
        with pytest.raises(ValueError, match=says):
            policy_folder(tmp_path / name)
    saved(run / "policy_best")
    with pytest.raises(ValueError, match=r"run/policy/spec\.json; the best so far is .*run/policy_best$"):
        policy_folder(run)
    saved(run / "policy")
    assert policy_folder(run) == policy_folder(run / "policy") == run / "policy"
    with pytest.raises(ValueError, match=rf"last\.ckpt serves only to resume .*, {run}$"):
        policy_folder(run / "checkpoints/last.ckpt")


def test_a_policy_of_the_hub_is_read_from_its_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder as the hub's client leaves it, whose files are links to its blobs, stands in for the hub."""
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    repository, commit = tmp_path / "models--somebody--lifter", "a" * 40
    whole, snapshot = saved(tmp_path / "whole"), repository / "snapshots" / commit
    for path in (repository / "blobs", repository / "refs", snapshot):
        path.mkdir(parents=True)
    (repository / "refs/v1").write_text(commit)
    for name in FILES:
        shutil.copy(whole / name, repository / "blobs" / name)
        (snapshot / name).symlink_to(f"../../blobs/{name}")
    found = read_policy("hub:somebody/lifter@v1")
    assert found.folder == snapshot
    found.restore(make_bc())
    assert found.training == read_policy(whole).training
    link("config.json", "../../refs/v1")(snapshot)
    with pytest.raises(ValueError, match="is a link that leaves the folder"):
        read_policy(snapshot)
    for name, says in {
        "hub:somebody/lifter": "write hub:OWNER/NAME@REVISION",
        "hub:somebody/lifter@v2": "cannot be fetched from the Hugging Face hub: ",
        "hub:../../lifter@v1": "write hub:OWNER/NAME@REVISION",
    }.items():
        with pytest.raises(ValueError, match=says):
            load_policy(name)


def link(name: str, target: str) -> Callable[[Path], object]:
    """What replaces a file by a link."""

    def change(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to(target)

    return change


def resized(change: Callable[[dict[str, Any]], object]) -> Callable[[Path], None]:
    """What changes the header of the weights, and the hash beside them."""

    def rewrite(folder: Path) -> None:
        path = folder / "model.safetensors"
        content = path.read_bytes()
        end = 8 + int.from_bytes(content[:8], "little")
        header = json.loads(content[8:end])
        change(header)
        text = json.dumps(header).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + content[end:])
        _sign(folder)

    return rewrite


def weights(change: Callable[[dict[str, torch.Tensor]], dict[str, torch.Tensor]]) -> Callable[[Path], None]:
    """What writes other weights, and the hash of these."""

    def rewrite(folder: Path) -> None:
        save_file(change(load_file(folder / "model.safetensors")), folder / "model.safetensors")
        _sign(folder)

    return rewrite


def _sign(folder: Path) -> None:
    import hashlib

    digest = hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()
    change_json(folder / "training.json", lambda made: made | {"weights": digest})


def text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def key(name: str, **values: Any) -> Callable[[Path], object]:
    return lambda folder: change_json(folder / name, lambda content: {**content, **values})


def first(header: dict[str, Any]) -> dict[str, Any]:
    return next(value for name, value in header.items() if name != "__metadata__")


DEEP = '{"task": ' + '{"a": ' * 10**5
# What somebody changed in a folder → the sentence.
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "no spec": (lambda folder: (folder / "spec.json").unlink(), "is neither a policy nor a run"),
    "no weights": (lambda folder: (folder / "model.safetensors").unlink(), r"has no model\.safetensors"),
    "a link to the outside": (link("config.json", "/etc/passwd"), "is a link that leaves the folder"),
    "a link to nothing": (link("training.json", "nothing"), r"has no training\.json"),
    "a list": (
        text("config.json", "[]"),
        r"config\.json is of no policy of this project: it needs task, tokenizer, mo",
    ),
    "no JSON": (text("config.json", "{"), r"config\.json is damaged or of another kind"),
    "a deep key twice": (text("training.json", '{"figures": {"a": 1, "a": 2}}'), "a mapping has one key twice"),
    "deep JSON": (text("config.json", DEEP), r"config\.json is damaged or of another kind: .*recursion"),
    "many levels": (key("config.json", task=json.loads('{"a":' * 99 + "1" + "}" * 99)), "more than 64 levels"),
    "many values": (key("config.json", task={"a": [0] * 10**5}), r"more than \d+ values"),
    "not a number": (text("config.json", '{"task": {"a": NaN}}'), r"config\.json is damaged .*NaN"),
    "an endless number": (text("config.json", '{"task": {"a": ' + "9" * 5000 + "}}"), r"config\.json is damaged"),
    "a reference": (
        key("config.json", model={"width": "${oc.env:HOME}"}),
        "holds the reference .*only resolved values",
    ),
    "a node that is a list": (key("config.json", model=[]), "is of no policy of this project"),
    "a spec of another kind": (key("spec.json", cameras=5), r"spec\.json"),
    "a training of another kind": (
        key("training.json", steps=-1),
        r"training\.json is damaged or of another kind: steps",
    ),
    "a hash that is a path": (key("training.json", weights="../weights"), r"training\.json is damaged .*weights"),
    "other weights": (key("training.json", weights="0" * 64), r"model\.safetensors is damaged, or not the file"),
    "weights that are no numbers": (
        weights(lambda state: {name: value * float("nan") for name, value in state.items()}),
        "has numbers that are not finite",
    ),
    "a number beyond all others": (text("config.json", '{"task": {"a": 1e999}}'), "holds inf, which is not finite"),
    "a large configuration": (text("config.json", "[" + "0," * (2 << 20) + "0]"), r"bytes, more than the \d+ that"),
    "truncated": (
        lambda folder: os.truncate(folder / "model.safetensors", 1000) or _sign(folder),
        r"model\.safetensors is damaged: ",
    ),
    "a huge shape": (resized(lambda header: first(header).update(shape=[2**40, 2**20])), "is damaged: "),
    "numbers that overlap": (resized(lambda header: header.update(more=first(header))), "is damaged: "),
    "a pickle": (
        lambda folder: torch.save({"a": 1}, folder / "model.safetensors") or _sign(folder),
        r"model\.safetensors is damaged: ",
    ),
    "half precision": (
        weights(lambda state: {name: value.half() for name, value in state.items()}),
        r"does not fit the model .* numbers of torch\.float16, not torch\.float32",
    ),
    "a header beyond the file": (
        lambda folder: (folder / "model.safetensors").write_bytes(b"\xff" * 8 + bytes(99)) and _sign(folder),
        r"model\.safetensors is damaged: ",
    ),
    "a shape that overflows": (resized(lambda header: first(header).update(shape=[2**63, 2**63])), "is damaged: "),
    "an unknown kind of number": (resized(lambda header: first(header).update(dtype="X9")), "is damaged: "),
    "a further name": (weights(lambda state: {**state, "..": torch.ones(1)}), "does not fit the model"),
    "a missing name": (weights(lambda state: dict([*state.items()][1:])), "does not fit the model"),
    "another shape": (
        weights(lambda state: {name: value.new_ones(3, 5) for name, value in state.items()}),
        "does not fit the model",
    ),
    "a state of no module": (
        resized(lambda header: header.update(__metadata__={"state": "{"})),
        "is damaged: ",
    ),
}


@pytest.mark.parametrize("attack", HOSTILE)
def test_a_hostile_folder_ends_in_one_sentence(attack: str, tmp_path: Path) -> None:
    (tmp_path / "outside").write_bytes(b"secret")
    change, says = HOSTILE[attack]
    folder = saved(tmp_path / "policy")
    change(folder)
    with pytest.raises(ValueError, match=says) as caught:
        read_policy(folder).restore(make_bc())
    assert len(str(caught.value)) < 1000 and "secret" not in str(caught.value)


def test_any_seed_of_validation_can_be_read_again(tmp_path: Path) -> None:
    folder = saved(tmp_path / "policy")
    key("training.json", validation=[2**31, 4])(folder)
    assert read_policy(folder).training.validation == (2**31, 4)


@pytest.mark.parametrize(
    "make",
    [
        lambda: torch.ones(10**12),
        lambda: torch.arange(10**12),
        lambda: torch.empty(10**18, 10**18),
        lambda: torch.eye(10**6),
        lambda: torch.rand(10**11, generator=torch.Generator()),
        lambda: torch.nn.Linear(10**6, 10**6),
        lambda: torch.nn.ModuleList(torch.nn.Linear(1000, 1000) for _ in range(100)),
    ],
)
def test_what_weights_do_not_fill_is_not_allocated(tmp_path: Path, make: Callable[[], object]) -> None:
    refused = pytest.raises(ValueError, match=r"a describes a model that is larger than its weights")
    with refused, TensorBudget(tmp_path / "a", 5):
        make()


def test_parts_that_come_with_the_weights_are_no_larger_than_their_file(tmp_path: Path) -> None:
    class Late(torch.nn.Module):
        def set_extra_state(self, state: object) -> None:
            torch.nn.Linear(10**6, 10**6)

        def get_extra_state(self) -> object:
            return 1

    found = read_policy(save_policy(tmp_path, CONFIG, state=Late().state_dict()))
    with pytest.raises(ValueError, match=r"does not fit .*: .* larger than its weights"):
        found.restore(Late())


def test_a_pipe_in_place_of_published_weights_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "model.safetensors")
    with (
        pytest.raises(UserError, match="is a folder, a pipe or a device"),
        open_safetensors(tmp_path / "model.safetensors"),
    ):
        pass
