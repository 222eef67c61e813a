"""Exported files say the same as the store, and an export can be taken up again."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from toy import SPEC, ToyEnvironment, ToyExpert

from vla.data.episodes import EpisodeStore
from vla.data.export import Files
from vla.rollout import rollout
from vla.spec import Episode, Spec


def stored(folder: Path, spec: Spec = SPEC, seeds: range = range(2)) -> tuple[EpisodeStore, list[Episode]]:
    episodes = [rollout(ToyEnvironment(), ToyExpert(), seed) for seed in seeds]
    store = EpisodeStore.create_or_open(folder, spec, {})
    with store.writing():
        for episode in episodes:
            store.append(episode)
    return store, episodes


def test_the_files_say_what_the_episode_was(tmp_path: Path) -> None:
    store, episodes = stored(tmp_path / "store")
    folder = Files(tmp_path / "export").export(store)
    assert sorted(path.name for path in folder.iterdir()) == ["episode_00000", "episode_00001"]
    for number, episode in enumerate(episodes):
        place = folder / f"episode_{number:05d}"
        manifest = json.loads((place / "manifest.json").read_text())
        assert manifest["instruction"] == episode.instruction and manifest["seed"] == number
        assert Spec.from_dict(manifest["spec"]) == SPEC
        assert len(list(place.glob("step_*"))) == manifest["steps"] == len(episode.observations)
        for step, seen in enumerate(episode.observations):
            files = place / f"step_{step:04d}"
            for camera in SPEC.cameras:
                np.testing.assert_array_equal(Image.open(files / camera / "rgb_image.png"), seen.rgb[camera])
                depth = np.load(files / camera / "depth_image.npy")
                assert depth.dtype == np.float32
                np.testing.assert_allclose(depth, seen.depth[camera] / 1000, rtol=1e-6)  # [mm] to [m]
            state = json.loads((files / "robot_state.json").read_text())
            np.testing.assert_array_equal(np.float32(state["joint_positions"]), seen.joints)
            np.testing.assert_array_equal(np.float32(state["joint_velocities"]), seen.velocities)
            assert np.float32(state["gripper_opening"]) == np.float32(seen.gripper)
            action = json.loads((files / "expert_action.json").read_text())
            np.testing.assert_array_equal(np.float32(action["action"]), episode.actions[step])
            np.testing.assert_array_equal(np.float32(action["executed"]), episode.executed[step])


def test_one_camera_needs_no_folder_of_its_own(tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store", replace(SPEC, cameras=("front",)), range(1))
    folder = Files(tmp_path / "export").export(store)
    assert sorted(path.name for path in (folder / "episode_00000" / "step_0000").iterdir()) == [
        "depth_image.npy",
        "expert_action.json",
        "rgb_image.png",
        "robot_state.json",
    ]


def test_an_export_cut_short_is_completed(tmp_path: Path) -> None:
    store, _ = stored(tmp_path / "store")
    folder = Files(tmp_path / "export").export(store)
    untouched = (folder / "episode_00000" / "manifest.json").stat().st_mtime_ns
    (folder / "episode_00001").rename(folder / ".episode_00001")
    shutil.rmtree(folder / ".episode_00001" / "step_0003")
    Files(folder).export(store)
    assert (folder / "episode_00001" / "step_0003" / "front" / "rgb_image.png").exists()
    assert not (folder / ".episode_00001").exists()
    assert (folder / "episode_00000" / "manifest.json").stat().st_mtime_ns == untouched


def test_a_folder_with_other_episodes_is_refused(tmp_path: Path) -> None:
    folder = Files(tmp_path / "export").export(stored(tmp_path / "first")[0])
    with pytest.raises(
        ValueError, match=r"episode_00000 was exported from other episodes: choose another export\.folder"
    ):
        Files(folder).export(stored(tmp_path / "second", seeds=range(1, 2))[0])
