"""Make the pictures of the README and of the pages anew: python docs/pictures.py RUN_FOLDER

RUN_FOLDER is what an evaluation left, `outputs/runs/<time>`. Pictures of sweeps and suites are the `sweep.png` and
`suite.png` of the commands beside them. The viewer is photographed without a display, for which it needs Vulkan: on
Debian the packages libvulkan1 and mesa-vulkan-drivers. Pages are photographed by chromium.
"""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rerun.experimental import ViewerClient

from vla.config.compose import compose_task
from vla.config.experiment import make_environment, make_policy
from vla.models.policy_folder import read_policy
from vla.rollouts.recorder import VIEWER
from vla.spec import FIRST_SEED, Array

DOCS = Path(__file__).parent
RESULTS = DOCS / "results"
HEIGHT = 2012  # of the page, as far as it is shown [px]
STEP = 12  # at which the rollout is shown: about to grasp
FILM_SIZE, FILM_EPISODES, FILM_PAUSE = 320, 5, 8  # of the moving picture: pixels, episodes, frames after each
ARM_VIEW, ARM_TARGET, ARM_STEPS = (1.1, -0.75, 0.6), (0.3, 0.0, 0.2), (4, 11, 16, 20)  # of the pictures of arms [m]
LEROBOT_STEP = 24  # at which the images of Meta-World are shown: the hand is near the object
SCENES, SCENE_SIZE = 3, 200  # of the picture of both renderers: scenes, edge of an image [px]
# Of the picture of the parts: x, y, colour, title and what it holds; then which follows which. Middle tones without a
# background read on a light and on a dark page.
BLUE, GREEN, ORANGE, GREY = "#3b6fb5", "#2f855a", "#b7621b", "#808890"
PARTS = (
    (0, 3, BLUE, "world", "task=tabletop, libero,\nmetaworld, gymnasium"),
    (0, 1, BLUE, "recordings", "task=recorded: LeRobot\ndatasets, ROS 2 bags"),
    (1, 3, BLUE, "expert", "expert=waypoint: a script\nthat acts and labels"),
    (1, 1, GREEN, "demonstrations", "job=collect: verified,\nshared by all runs"),
    (2, 1, GREEN, "training", "job=train: model, text,\nimage, learner, trainer"),
    (3, 1, GREEN, "policy", "checkpoint=RUN"),
    (2, 3, ORANGE, "evaluation", "job=evaluate: intervals,\nreport, recording"),
    (3, 3, ORANGE, "robot", "job=deploy: ROS 2 node,\npolicy server"),
)
PART_ARROWS = ((0, 2), (2, 3), (1, 3), (3, 4), (4, 5), (5, 6), (5, 7))


def vla(*arguments: str) -> None:
    """Run the command line."""
    subprocess.run([sys.executable, "-m", "vla.run", *arguments], check=True)


def screenshot(recording: Path, picture: Path, step: int) -> None:
    """Save what the viewer shows of a recording at a step as PNG.

    Raises:
        ValueError: the viewer does not start, or one of its views reports a problem.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # The viewer would listen on all interfaces unless told otherwise.
    options = ["--bind", "127.0.0.1", "--port", str(port), "--headless", "--window-size", "1600x900"]
    viewer = subprocess.Popen([VIEWER, *options, str(recording)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        time.sleep(10.0)  # until it has started, everything is loaded and the greeting has gone
        if viewer.poll() is not None:
            raise ValueError("the viewer does not start; without a display it needs libvulkan1, mesa-vulkan-drivers")
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        client.set_time("step", sequence=step, play_state="paused")
        time.sleep(2.0)  # until everything is painted
        problems = [(view.name, view.reports) for view in client.get_state().views if view.reports]
        if problems:
            raise ValueError(f"the viewer cannot show all of {recording}: {problems}")
        picture.write_bytes(client.take_screenshot())
    finally:
        viewer.terminate()
        viewer.wait(timeout=10)


def photograph(page: Path, picture: Path, height: int) -> None:
    """Save the top of a page as PNG, 1200 pixels wide and so high."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size=1200,{height}"]
    subprocess.run(
        ["chromium", *options, f"--screenshot={picture}", page.resolve().as_uri()], check=True, capture_output=True
    )


def film(run: Path, picture: Path) -> None:
    """Save rollouts of a run's policy as an animated WebP: both cameras, rendered larger, above the instruction."""
    checkpoint = run / "policy"
    config = read_policy(checkpoint).config
    environment = make_environment(config["task"])
    renderer = {**config["task"]["renderer"], "samples": 4, "soft": 2, "faces": None}
    finer = {"image_size": [FILM_SIZE, FILM_SIZE], "meshes": "full", "renderer": renderer}
    larger = make_environment({**config["task"], **finer})
    policy = make_policy(config["policy"], checkpoint, environment)
    frames: list[Image.Image] = []
    for seed in range(FIRST_SEED, FIRST_SEED + FILM_EPISODES):
        observation, view = environment.reset(seed), larger.reset(seed)
        policy.reset(observation.instruction, seed)
        while not environment.done:
            frames.append(captioned(list(view.rgb.values()), observation.instruction))
            action = policy.act(observation)
            observation, view = environment.step(action), larger.step(action)
        frames += [captioned(list(view.rgb.values()), observation.instruction)] * FILM_PAUSE
    period = round(1000 / environment.spec.control_hz)
    frames[0].save(picture, save_all=True, append_images=frames[1:], duration=period, loop=0, quality=60, method=6)


def fifty_tasks(picture: Path) -> None:
    """Save the first picture of every task of Meta-World, ten in a row, as WebP."""
    options = {"image_size": (120, 120), "window": (0.1, 0.14, 1.0, 1.0), "renderer.samples": 4}
    environment: Any = make_environment(compose_task("metaworld", **options))
    tasks = sorted(range(len(environment.tasks)), key=lambda seed: environment.tasks[seed])
    images = [environment.reset(seed).rgb["corner2"] for seed in tasks]
    rows = [np.concatenate(images[start : start + 10], axis=1) for start in range(0, len(images), 10)]
    Image.fromarray(np.concatenate(rows)).save(picture, quality=80, method=6)


def lerobots_images(picture: Path) -> None:
    """Save scenes of Meta-World as `experiment=metaworld` and as LeRobot show them, above what chooses them."""
    from vla.tasks.metaworld.expert import Scripted

    own = {
        "image_size": (96, 96),
        "cameras": ["corner2", "hand"],
        "window": (0.25, 0.29, 0.95, 0.99),
        "tasks": ["drawer-open", "soccer", "pick-place"],
    }
    lerobots = {"renderer": "mujoco", "drawn": 480, "shadows": 4096}
    sheets = []
    for options in ({"renderer": "smooth", "shadows": 512}, lerobots):
        environment: Any = make_environment(compose_task("metaworld", **own, **options))
        images: list[Array] = []
        for seed in range(3):
            expert, observation = Scripted(spec=environment.spec), environment.reset(seed)
            for _ in range(LEROBOT_STEP):
                observation = environment.step(expert.act(observation))
            images += observation.rgb.values()
        sheets.append(np.concatenate(images, axis=1).repeat(2, axis=0).repeat(2, axis=1))
        environment.close()
    captions = "experiment=metaworld", "evaluate=lerobot"
    parts = [captioned([sheet], text) for sheet, text in zip(sheets, captions, strict=True)]
    whole = Image.new("RGB", (parts[0].width, sum(part.height for part in parts)), "white")
    for index, part in enumerate(parts):
        whole.paste(part, (0, index * part.height))
    whole.save(picture, quality=85, method=6)


def captioned(images: list[Array], text: str) -> Image.Image:
    """Images side by side, above a line of text."""
    height, width = images[0].shape[0], sum(image.shape[1] for image in images)
    frame = Image.new("RGB", (width, height + 36), "white")
    for index, image in enumerate(images):
        frame.paste(Image.fromarray(image), (index * width // len(images), 0))
    font = ImageFont.load_default(size=20)
    ImageDraw.Draw(frame).text((width / 2, height + 18), text, "black", font, anchor="mm")
    return frame


def renderers(picture: Path) -> None:
    """Save scenes as both renderers draw them, a row for each, above their names; both cameras, without noise."""
    rows: list[list[Array]] = [[] for _ in range(SCENES)]
    for name in ("fast", "mujoco"):
        options = {"randomize": "wide", "randomize.sensor": None, "image_size": (SCENE_SIZE, SCENE_SIZE)}
        environment = make_environment(compose_task("tabletop", renderer=name, **options))
        for seed, row in enumerate(rows, FIRST_SEED):
            row += environment.reset(seed).rgb.values()
        environment.close()
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    captioned([sheet], "task/renderer=fast" + 40 * " " + "task/renderer=mujoco").save(picture, quality=85, method=6)


def arm(option: str, picture: Path) -> None:
    """Save four moments of an episode of the expert with the arm of `task/robot=OPTION`, from the side, as WebP."""
    from vla.tasks.tabletop.expert import Waypoint
    from vla.tasks.tabletop.robot import look_at
    from vla.tasks.tabletop.robot_spec import quaternion

    options = {
        "image_size": (240, 240),
        "cameras": ["front"],
        "meshes": "full",
        "renderer.soft": 1,
        "renderer.faces": None,
    }
    environment: Any = make_environment(compose_task("tabletop", robot=option, renderer="smooth", **options))
    expert, observation = Waypoint(environment.spec), environment.reset(FIRST_SEED)
    compiled = environment.simulation.compiled
    camera = compiled.cameras["front"]
    compiled.model.cam_pos[camera] = ARM_VIEW
    compiled.model.cam_quat[camera] = quaternion(look_at(ARM_VIEW, ARM_TARGET, (0, 0, 1)))
    images = []
    while not environment.done:
        observation = environment.step(expert.act(observation))
        images.append(observation.rgb["front"])
    Image.fromarray(np.concatenate([images[step] for step in ARM_STEPS], axis=1)).save(picture, quality=80, method=6)
    environment.close()


def parts(picture: Path) -> None:
    """Save the parts of an experiment and what flows between them."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.patches import FancyBboxPatch

    figure = Figure(figsize=(10, 3.4))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(-0.5, 3.5), ylim=(0.1, 4.2))
    axes.axis("off")
    middle = [(column, row) for column, row, *_ in PARTS]
    for (x, y), (_, _, colour, title, content) in zip(middle, PARTS, strict=True):
        axes.add_patch(FancyBboxPatch((x - 0.4, y - 0.6), 0.8, 1.2, "round,pad=0.02", mutation_aspect=2, color=colour))
        axes.text(x, y + 0.3, title, color="white", ha="center", va="center", weight="bold", size=12)
        axes.text(x, y - 0.2, content, color="white", ha="center", va="center", size=10)
    for start, end in PART_ARROWS:
        (x, y), (to_x, to_y) = middle[start], middle[end]
        beside = 0.43 * np.sign(to_x - x)
        upward = 0.66 * np.sign(to_y - y)
        tail, head = ((x, y + upward), (to_x, to_y - upward)) if to_y != y else ((x + beside, y), (to_x - beside, to_y))
        axes.annotate(
            "", head, tail, arrowprops={"arrowstyle": "-|>", "color": GREY, "lw": 2, "shrinkA": 0, "shrinkB": 0}
        )
    with rc_context({"svg.hashsalt": "parts"}):  # else every picture would have other names in it
        figure.savefig(picture, transparent=True, metadata={"Date": None})


def main(run: Path) -> None:
    """Previews, one rollout in the viewer, the card of a small store, the report of `run` and its page."""
    film(run, DOCS / "rollouts.webp")
    parts(DOCS / "parts.svg")
    renderers(RESULTS / "renderers.webp")
    fifty_tasks(DOCS / "metaworld.webp")
    lerobots_images(RESULTS / "metaworld_images.webp")
    arm("jaco", DOCS / "jaco.webp")  # and so ur5e.webp, with the option that worlds.md describes
    with tempfile.TemporaryDirectory() as folder:
        vla("job=preview", "task/goal=mixed", "task/randomize=wide", "preview.seed=1000000", f"output={folder}")
        shutil.copy(Path(folder) / "preview.png", DOCS / "wide.png")
        vla(f"checkpoint={run}", "evaluate.episodes=1", "cluster.workers=1", f"output={folder}")
        screenshot(Path(folder) / "rollouts.rrd", DOCS / "rollout.png", STEP)
        store = f"collect.folder={folder}/episodes"
        vla("job=collect", "collect.episodes=60", store)
        vla("job=inspect", store)
        shutil.copy(Path(folder) / "episodes/card.png", DOCS / "card.png")
    shutil.copy(run / "report.png", DOCS / "report.png")
    photograph(run / "report.html", DOCS / "page.png", HEIGHT)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
