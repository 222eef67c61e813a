"""Exported files say the same as the store, and an export can be taken up again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import warm
from exporting import composed, content, exporter, stored
from PIL import Image
from toy import ARM_SPEC

from vla.data.episodes import EpisodeStore
from vla.data.formats.files import UNFINISHED, Files, staging_folder
from vla.io.errors import UserError
from vla.spec import Spec


def test_the_files_say_what_the_episode_was(tmp_path: Path) -> None:
    store, episodes = stored(tmp_path / "store")
    folder = Files(tmp_path / "export").export(store)
    assert sorted(path.name for path in folder.iterdir()) == ["episode_00000", "episode_00001"]
    for number, episode in enumerate(episodes):
        place = folder / f"episode_{number:05d}"
        manifest = json.loads((place / "manifest.json").read_text())
        assert manifest["instruction"] == episode.instruction and manifest["seed"] == number
        assert Spec.from_dict(manifest["spec"]) == ARM_SPEC
        assert len(list(place.glob("step_*"))) == manifest["steps"] == len(episode.observations)
        for step, seen in enumerate(episode.observations):
            files = place / f"step_{step:04d}"
            for camera in ARM_SPEC.cameras:
                np.testing.assert_array_equal(Image.open(files / camera / "rgb_image.png"), seen.rgb[camera])
                depth = np.load(files / camera / "depth_image.npy")
                assert depth.dtype == np.float32
                np.testing.assert_allclose(depth, seen.depth[camera] / 1000, rtol=1e-6)  # [mm] to [m]
            state = json.loads((files / "robot_state.json").read_text())
            assert tuple(state) == ARM_SPEC.state
            np.testing.assert_array_equal(np.array([*state.values()], np.float32), seen.state)
            action = json.loads((files / "expert_action.json").read_text())
            np.testing.assert_array_equal(np.float32(action["action"]), episode.actions[step])
            np.testing.assert_array_equal(np.float32(action["executed"]), episode.executed[step])


def test_a_step_of_one_camera_is_four_files(tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store", replace(ARM_SPEC, cameras=("front",), depth=("front",)), range(1))
    folder = Files(tmp_path / "export").export(store)
    names = ["depth_image.npy", "expert_action.json", "rgb_image.png", "robot_state.json"]
    assert sorted(path.name for path in (folder / "episode_00000/step_0000").iterdir()) == names


def test_what_is_there_is_left_alone(tmp_path: Path) -> None:
    stored(tmp_path / "store", seeds=range(3))
    store = EpisodeStore(tmp_path / "store", episodes=2)  # only as many as the store shows are exported
    folder = Files(tmp_path / "export").export(store)
    untouched, whole = (folder / "episode_00000/manifest.json").stat().st_mtime_ns, content(folder)
    shutil.rmtree(folder / "episode_00001")
    Files(folder).export(store)
    assert content(folder) == whole
    assert {path.name for path in folder.iterdir()} == {"episode_00000", "episode_00001"}
    assert (folder / "episode_00000/manifest.json").stat().st_mtime_ns == untouched
    with pytest.raises(ValueError, match=r"episode_00000 is not episode 0 of "):
        Files(folder).export(stored(tmp_path / "second", seeds=range(1, 2))[0])
    with (
        staging_folder(folder, folder / UNFINISHED),
        pytest.raises(ValueError, match=r"another export to .*export is under way"),
    ):
        Files(folder).export(store)


@pytest.mark.parametrize("kind", ["files", "lerobot"])
def test_what_a_killed_export_left_beside_the_whole_one_is_removed(kind: str, tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store")
    folder = exporter(kind, tmp_path / "export").export(store)
    before = content(folder)
    left = {"files": folder / UNFINISHED, "lerobot": folder.with_name(f".export{UNFINISHED}")}[kind]
    left.mkdir()
    (left / "lock").touch()
    exporter(kind, folder).export(store)
    assert not left.exists() and content(folder) == before


def test_no_dataset_takes_the_place_of_a_mounted_disk(tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store")
    with pytest.raises(UserError, match=r"^/proc is where a disk is mounted: choose a new folder on it as export\.fol"):
        exporter("lerobot", Path("/proc")).export(store)


def written(folder: Path) -> int:
    """How many files an export to a folder has written so far, while it goes on."""
    places = (folder, folder.with_name(f".{folder.name}.unfinished"))
    return sum(len(files) for place in places for _, _, files in os.walk(place))


@pytest.mark.parametrize("field", ["rgb_front", "rgb_wrist", "depth_wrist", "truth"])
def test_a_damaged_store_becomes_no_dataset_whether_or_not_the_damage_would_be_in_it(
    field: str, tmp_path: Path
) -> None:
    store, _ = stored(tmp_path / "store")
    rows = bytearray((path := store.folder / f"{field}.bin").read_bytes())
    rows[0] ^= 1
    path.write_bytes(rows)
    with pytest.raises(ValueError, match=r"rows of seed 0 in .* were changed on disk"):
        exporter("lerobot", tmp_path / "dataset").export(store)


def test_a_resumed_export_keeps_the_videos_that_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, _ = stored(tmp_path / "store")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("vla.data.formats.lerobot_export.write_rows", Mock(side_effect=KeyboardInterrupt))
        exporter("lerobot", tmp_path / "dataset").export(store)
    begun = {path.parts[-3]: path.stat().st_mtime_ns for path in tmp_path.glob(".dataset.unfinished/**/*.mp4")}
    (tmp_path / ".dataset.unfinished/dataset/meta/.1f.stats.json").write_text("{")  # a process was killed in there
    folder = exporter("lerobot", tmp_path / "dataset").export(store)
    assert begun == {path.parts[-3]: path.stat().st_mtime_ns for path in folder.rglob("*.mp4")} != {}
    assert content(folder) == content(exporter("lerobot", tmp_path / "whole").export(store))


EXPORT = """
if __name__ == "__main__":  # worker processes import this file
    import os, sys
    from pathlib import Path
    from vla.config.build import build
    from vla.data.episodes import EpisodeStore
    from vla.parallel.pool import Cluster
    os.setsid()
    build({config}, "export").export(EpisodeStore(Path({store!r})), Cluster(int(sys.argv[1]), "beside"))
"""


@pytest.mark.parametrize("name", ["files", "lerobot"])
def test_killed_twice_at_random_an_export_goes_on_and_ends_up_the_same(name: str, tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store", seeds=range(20))
    whole, killed = exporter(name, tmp_path / "whole").export(store), tmp_path / "killed"
    (tmp_path / "export.py").write_text(EXPORT.format(config=composed(name, killed), store=str(store.folder)))
    files = written(whole)
    for workers, share in zip("21", sorted(np.random.default_rng(60).uniform(0, 0.8, 2)), strict=True):

        def kill(process: int, share: float = share) -> None:
            with suppress(ProcessLookupError):  # it was faster
                while written(killed) < share * files:
                    os.kill(process, 0)
                    time.sleep(0.01)
                os.killpg(process, signal.SIGKILL)  # with its workers, which would otherwise write on for a moment

        assert warm.run(tmp_path, workers, program="export", meanwhile=kill).returncode <= 0
    exporter(name, killed).export(store)
    assert content(killed) == content(whole)
    assert {path.name for path in tmp_path.iterdir()} - {"__pycache__"} == {"export.py", "killed", "store", "whole"}
