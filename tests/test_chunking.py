"""Real-time chunking: plans that continue the one which is executed while they are computed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_pi
import tiny_vla
import torch
from composing import check, composed
from defaults import defaults_of
from fake_batch import as_policy, make_act, make_batch, make_denoising, with_text
from observing import observations
from tiny_pi import make_policy
from tiny_vla import make_smolvla
from torch import Tensor
from toy import SPEC, ToyEnvironment, make_environment

from vla.config.build import build
from vla.config.experiment import Experiment
from vla.jobs.evaluate import require_possible
from vla.models.chunking import Chunking, Guided, RunningPlans, TrainedPrefix, Velocity, require_fit
from vla.models.flow import Flow
from vla.models.vlm.policy import VisionLanguageAction
from vla.rollouts.realtime import Network, NetworkedAgent
from vla.rollouts.rollout import AgentFactory, rollout
from vla.rollouts.shared_policy import shared_policy
from vla.schedule import Delays, Schedule
from vla.spec import FIRST_SEED, Array, Observation, Spec
from vla.spec import RunningPlan as RunningPlan

METHODS: dict[str, Callable[[], Chunking]] = {
    "guided": lambda: Guided(**defaults_of("policy/chunking/guided")),
    "guided_lerobot": lambda: Guided(**defaults_of("policy/chunking/guided_lerobot")),
    "trained": TrainedPrefix,
}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())
NETWORK = Network(latency=0.3, jitter=0.0, loss=0.0, ensemble=None)  # three steps


def make_flow(**options: Any) -> Flow:
    """A small flow that plans eight actions, of which two are executed."""
    return make_denoising(Flow, **{"chunk": 8, "execute": 2, "prefix": 4, **options})  # type: ignore[return-value]


def running_of(actions: Tensor, remaining: int, delay: int) -> RunningPlans:
    """Running plans, all as long."""
    counts = (torch.full((len(actions),), count) for count in (remaining, delay))
    return RunningPlans(actions, *counts)


def test_lerobot_guides_likewise() -> None:
    """The reference is what LeRobot 0.4.4 computed: tools/parity/rtc.py; its time runs from 1 for noise to 0."""
    with np.load(Path(__file__).with_name("rtc_reference.npz")) as file:
        given = {name: torch.from_numpy(values) for name, values in file.items()}
    for decay in ("linear", "exponential"):
        assert len(given[decay]) == len(given["cases"]) == 12
        for (delay, rest, time, limit), theirs in zip(given["cases"].tolist(), given[decay], strict=True):

            def velocity(noisy: Tensor, mine: Tensor, time: float = time) -> Tensor:
                assert torch.allclose(mine, torch.tensor(1 - time))
                return -(noisy @ given["matrix"] + time).tanh()

            method = Guided(jacobian=False, decay=decay, limit=limit)
            guided = method.continuing_velocity(velocity, running_of(given["previous"], int(rest), int(delay)))
            mine = guided(given["noisy"], torch.full((2,), 1 - time))
            assert (mine + theirs).abs().max() <= 1e-5 * theirs.abs().max()


def test_as_published_the_guidance_goes_back_through_the_network() -> None:
    """For a linear velocity a M the estimate is a (I + (1 - t) M), whose Jacobian is known."""
    noisy, plan, matrix, t = torch.randn(2, 8, 3), torch.randn(2, 8, 3), torch.randn(3, 3), 0.4
    running, time = running_of(plan, 6, 2), torch.full((2,), t)
    guided = Guided(True, "exponential", 100.0).continuing_velocity(lambda noisy, time: noisy @ matrix, running)
    falling = torch.tensor([1, 1, 4 / 5, 3 / 5, 2 / 5, 1 / 5, 0, 0])  # two are certain, four more remain
    weights = falling * (falling.exp() - 1) / (np.e - 1)
    slope = torch.eye(3) + (1 - t) * matrix
    correction = weights[:, None] * (plan - noisy @ slope) @ slope.T
    expected = noisy @ matrix + (0.16 + 0.36) / (0.4 * 0.6) * correction
    assert torch.allclose(guided(noisy, time), expected, atol=1e-5)
    with torch.inference_mode():
        assert torch.allclose(guided(noisy, time), expected, atol=1e-5)
    limited = Guided(True, "exponential", 5.0).continuing_velocity(lambda noisy, time: noisy @ matrix, running)
    start = noisy @ matrix + 5 * weights[:, None] * (plan - noisy @ (slope := torch.eye(3) + matrix)) @ slope.T
    assert torch.allclose(limited(noisy, torch.zeros(2)), start, atol=1e-4)


def test_the_network_is_given_the_certain_actions_as_clean() -> None:
    given: list[tuple[Tensor, Tensor]] = []

    def velocity(noisy: Tensor, time: Tensor) -> Tensor:
        given.append((noisy, time))
        return noisy

    noisy, plan = torch.randn(2, 4, 3), torch.randn(2, 4, 3)
    running = RunningPlans(plan, torch.tensor([3, 0]), torch.tensor([2, 0]))
    TrainedPrefix().continuing_velocity(velocity, running)(noisy, torch.full((2,), 0.25))
    ((seen, times),) = given
    assert torch.equal(seen[0, :2], plan[0, :2]) and torch.equal(seen[0, 2:], noisy[0, 2:])
    assert torch.equal(seen[1], noisy[1])
    assert times.tolist() == [[1.0, 1.0, 0.25, 0.25], [0.25] * 4]


@pytest.mark.parametrize("method", list(METHODS.values())[:2])
def test_without_a_running_plan_the_velocity_stays_as_it_is(method: Callable[[], Chunking]) -> None:
    noisy, time = torch.randn(2, 8, 3), torch.full((2,), 0.3)
    velocity = method().continuing_velocity(lambda noisy, time: noisy.sin(), running_of(torch.randn(2, 8, 3), 0, 0))
    assert torch.equal(velocity(noisy, time), noisy.sin())


@every_method
@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_plan_begins_with_what_is_executed_until_it_arrives(method: Callable[[], Chunking], delay: int) -> None:
    model, (first, second, *_) = make_flow(), observations(2)
    policy = as_policy(model, chunking=method())
    plan = policy.plan(first)
    going = replace(second, running=RunningPlan(plan[3:], delay))
    following = policy.plan(going)
    assert following.shape == (8, 3) and following.dtype == np.float32
    np.testing.assert_array_equal(following[:delay], plan[3 : 3 + delay])
    free = as_policy(model)
    np.testing.assert_allclose(
        free.plan(first), plan, atol=1e-6
    )  # attention rounds otherwise where it is differentiated
    unaware = free.plan(going)
    if delay or not isinstance(policy.chunking, TrainedPrefix):
        assert not np.array_equal(unaware[delay:], following[delay:])
    again = as_policy(model)
    again.plan(first)
    np.testing.assert_array_equal(unaware, again.plan(second))  # switched off, nothing has changed


def test_a_delay_beyond_the_trained_prefix_is_limited_to_it_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    model, (first, second, *_) = make_flow(prefix=2), observations(2)
    given = list[int]()

    class Watched(TrainedPrefix):
        def continuing_velocity(self, velocity: Velocity, running: RunningPlans) -> Velocity:
            given.append(int(running.delay))
            return super().continuing_velocity(velocity, running)

    policy = as_policy(model, chunking=Watched())
    plan = policy.plan(first)
    given.clear()
    for delay in (2, 3, 5):
        policy.plan(replace(second, running=RunningPlan(plan[3:], delay)))
    assert given == [2, 2, 2]
    assert [record.getMessage() for record in caplog.records] == [
        "a plan arrives 3 actions late, more than model.prefix=2 of its training: it may not continue the running one; "
        "train with a larger one"
    ]


@every_method
def test_lanes_continue_their_own_plans(method: Callable[[], Chunking]) -> None:
    model, (first, second, third, *_) = make_flow(), observations(3)
    together = as_policy(model, chunking=method(), lanes=2)
    plans = together.plan([first, second], [0, 1])
    seen = [replace(second, running=RunningPlan(plans[0][2:], 2)), third]
    results = together.plan(seen, [0, 1])
    for lane, before in enumerate((first, second)):
        alone = as_policy(model, chunking=method(), lanes=2)
        alone.plan([before], [lane])
        np.testing.assert_array_equal(alone.plan([seen[lane]], [lane])[0], results[lane])


def test_only_what_follows_the_prefix_is_learned() -> None:
    model = make_flow(copies=1, auxiliary=0.0).eval()
    batch = with_text(model, make_batch(1, 8, size=32))
    output, times = model(batch), list[Tensor]()
    model.denoiser.register_forward_pre_hook(lambda _, given: times.append(given[1]))

    def loss(**changes: Tensor) -> Tensor:
        return model.action_loss(output, {**batch, **changes})["action_loss"]

    expected = loss()
    known = (times[0] == 1).unsqueeze(1).unsqueeze(-1)  # (B, 1, k, 1)
    assert {*known.sum(2).flatten().tolist()} == {0, 1, 2, 3, 4}  # every length occurs
    changed = batch["action"] + 0.01
    assert torch.equal(loss(action=torch.where(known, changed, batch["action"])), expected)
    assert torch.equal(loss(executed=torch.where(known, batch["executed"], changed)), expected)
    assert not torch.equal(loss(executed=torch.where(known, changed, batch["executed"])), expected)
    assert not torch.equal(loss(action=torch.where(known, batch["action"], changed)), expected)
    # What follows a perturbation counts if that was given, and not if it would have had to be foreseen.
    once = (torch.arange(8) > 0).long().expand(32, 1, 8)
    foreseen = once.unsqueeze(-1).bool() & ~known.any(2, keepdim=True)
    assert foreseen.any()
    expected = loss(perturbations=once)
    assert torch.equal(loss(perturbations=once, action=torch.where(foreseen, changed, batch["action"])), expected)
    assert not torch.equal(loss(perturbations=once, action=torch.where(~foreseen, changed, batch["action"])), expected)


def test_training_with_prefixes_makes_a_plan_go_on_as_it_began() -> None:
    """Two ways are as good, and only the actions before tell which one was begun."""
    model = make_flow(auxiliary=0.0, temperature=1.0)
    batch = with_text(model, make_batch(1, 8, size=8))
    same = {name: batch[name][:1].expand_as(batch[name]) for name in ("state", "text")}
    same["rgb"] = {name: image[:1].expand_as(image) for name, image in batch["rgb"].items()}
    ways = torch.tensor([-0.04, 0.04]).repeat(4)[:, None, None, None] * torch.ones(8, 1, 8, 3)
    ways[..., 2] = 0.5
    batch |= {**same, "action": ways, "executed": ways}
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    for _ in range(80):
        optimizer.zero_grad()
        model.loss(batch)["loss"].backward()
        optimizer.step()
    model.eval().chunking = TrainedPrefix()
    counts = {"remaining": torch.full((8,), 6), "delay": torch.full((8,), 2)}
    with torch.inference_mode():
        plans = model.predict({**batch, "running": ways[:, 0], **counts, "noise": torch.randn(8, 8, 3)}).actions
    away = (plans[:, 2:, :2] - ways[:, 0, 2:, :2]).abs()
    assert away.mean() < 0.02 and (away < 0.04).float().mean() > 0.9  # the other way is 0.08 away


class Watched:
    """Plans with a policy, and keeps what it was given and what it planned."""

    def __init__(self, chunking: Chunking | None) -> None:
        self.policy = as_policy(make_flow(), chunking=chunking)
        self.execute, self.info = 2, dict[str, Any]()
        self.plans: list[tuple[RunningPlan | None, Array]] = []

    def reset(self, instruction: str, seed: int) -> None:
        """Start an episode."""
        self.policy.reset(instruction, seed)

    def act(self, observation: Observation) -> Array:
        """Not called by those who plan."""
        raise NotImplementedError

    def plan(self, observation: Observation) -> Array:
        """The plan of the policy."""
        self.plans.append((observation.running, self.policy.plan(observation)))
        return self.plans[-1][1]


@every_method
def test_over_a_network_the_arm_does_what_every_plan_begins_with(method: Callable[[], Chunking]) -> None:
    """The second observation is sent at step 2, then at 5, 8 …, each time when the plan of the one before arrives."""
    agent = Watched(method())
    distant = NetworkedAgent(lambda _: agent, NETWORK, ToyEnvironment())
    distant.reset("", 3)
    acted = [distant.act(seen) for seen in observations(20)]
    starts = [0, 2, 5, 8, 11, 14, 17]
    assert len(agent.plans) == len(starts) and agent.plans[0][0] is None
    for (_, before), (running, plan), last, start in zip(
        agent.plans, agent.plans[1:], starts, starts[1:], strict=False
    ):
        assert running is not None and running.delay == 3
        np.testing.assert_array_equal(running.actions, before[start - last :])
        np.testing.assert_array_equal(plan[:3], acted[start : start + 3])
    # So nobody sees where a plan arrives: the newest one says all that was done since its observation.
    for (_, plan), start, end in zip(agent.plans, starts, starts[2:], strict=False):
        np.testing.assert_array_equal(plan[: end - start], acted[start:end])


def test_episodes_over_a_network_are_repeatable_wherever_the_policy_is() -> None:
    policy = as_policy(make_flow(), chunking=TrainedPrefix(), lanes=2)

    def executed(make_agent: AgentFactory) -> Array:
        with closing(NetworkedAgent(make_agent, NETWORK, make_environment())) as agent:
            return rollout(make_environment(), agent, FIRST_SEED).executed

    beside = executed(lambda _: policy)
    np.testing.assert_array_equal(executed(lambda _: policy), beside)
    with shared_policy(lambda: policy) as make_agent:
        np.testing.assert_array_equal(executed(make_agent), beside)
    assert not np.array_equal(executed(lambda _: as_policy(policy.model)), beside)
    (seen,) = observations(1)
    with shared_policy(lambda: policy) as make_agent, closing(make_agent(ToyEnvironment())) as agent:
        plan = agent.plan(seen)
        following = agent.plan(replace(seen, running=RunningPlan(plan[2:], 3)))
        np.testing.assert_array_equal(following[:3], plan[2:5])


def test_a_delay_is_forecast_by_the_longest_of_the_last_ten() -> None:
    delays = Delays(0.1)
    assert delays.forecast == 0
    for seconds, longest in ((0.2, 2), (0.31, 4), (0.05, 4)):
        delays.add(seconds)
        assert delays.forecast == longest
    for _ in range(9):
        delays.add(0.05)
    assert delays.forecast == 1


def test_a_schedule_tells_what_remains_of_a_plan() -> None:
    schedule = Schedule[str](0.5)
    assert list(schedule.remaining_actions(1.0)) == [] and schedule.execution_end(2) == -np.inf
    schedule.add("abcd", 1.0)
    assert [*map("".join, map(schedule.remaining_actions, (1.0, 1.4, 2.0, 3.0)))] == ["abcd", "abcd", "cd", ""]
    assert schedule.execution_end(3) == 2.5


def test_what_cannot_continue_plans_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"\+policy/chunking \(Guided\) continues the plans of flow models, and ACT is none"
    ):
        as_policy(make_act(), chunking=METHODS["guided"]())
    with pytest.raises(ValueError, match=r"\(TrainedPrefix\) needs a model trained with prefixes: train with model"):
        as_policy(make_flow(prefix=0), chunking=TrainedPrefix())
    with pytest.raises(ValueError, match=r"model\.chunk=8 has no room for model\.prefix=7 and model\.execute=2"):
        make_flow(prefix=7)
    require_fit(TrainedPrefix, {"chunk": 8, "execute": 2, "prefix": 4}, delay=4)
    require_fit(Guided, {"chunk": 8}, delay=0)  # `execute` has a default
    with pytest.raises(ValueError, match=r"begin 5 actions apart and arrive 5 late, when .* model\.chunk=8, is over"):
        require_fit(Guided, {"chunk": 8, "execute": 2}, delay=5)
    with pytest.raises(ValueError, match=r"3 actions late, more than model\.prefix=2: train"):
        require_fit(TrainedPrefix, {"chunk": 8, "execute": 2, "prefix": 2}, delay=3)


@pytest.mark.parametrize(
    ("overrides", "sentence"),
    [
        (["model=bc", "+policy/chunking=guided"], "continues the plans of flow models, and BC is none"),
        (["model=flow", "+policy/chunking=trained"], "needs a model trained with prefixes"),
        (["model=flow", "policy=onnx", "+policy/chunking=guided"], "chunking"),
    ],
)
def test_before_any_work_chunking_must_go_with_the_model(overrides: list[str], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        check(composed("job=evaluate", *overrides))


def test_before_any_work_plans_must_be_long_enough_for_the_network(tmp_path: Path) -> None:
    config = [f"output={tmp_path}", "model=flow", "evaluate=latency", "+policy/chunking=guided"]
    require_possible(Experiment.from_config(composed(*config)))
    with pytest.raises(ValueError, match=r"begin 3 actions apart and arrive 3 late, when .* model\.chunk=5, is over"):
        require_possible(Experiment.from_config(composed(*config, "model.chunk=5")))


VLAS: dict[str, tuple[Callable[..., VisionLanguageAction], Spec]] = {
    "smolvla": (make_smolvla, tiny_vla.SPEC),
    "pi0": (partial(make_policy, "pi0"), tiny_pi.SPEC),
    "pi05": (partial(make_policy, "pi05"), tiny_pi.SPEC),
}


def make_vla(name: str) -> tuple[VisionLanguageAction, Spec]:
    """A tiny vision-language-action model that plans six actions, of which two are executed, and its spec."""
    torch.manual_seed(0)
    make, spec = VLAS[name]
    model = make(execute=2, prefix=3, steps=4, normalization="mean_std")
    random = np.random.default_rng(0)
    model.fit(*(random.standard_normal((50, len(part))) for part in (spec.state, spec.action)))
    return model, spec


@every_method
@pytest.mark.parametrize("name", VLAS)
def test_plans_of_vision_language_action_models_continue_each_other(name: str, method: Callable[[], Chunking]) -> None:
    model, spec = make_vla(name)
    policy, free = as_policy(model, spec, chunking=method()), as_policy(model, spec)
    first, second = (spec.random_observation(np.random.default_rng(seed)) for seed in (0, 1))
    plan = policy.plan(first)
    np.testing.assert_allclose(free.plan(first), plan, atol=1e-4)
    going = replace(second, running=RunningPlan(plan[1:], 2))
    following, unaware = policy.plan(going), free.plan(going)
    np.testing.assert_array_equal(following[:2], plan[1:3])
    assert not np.allclose(unaware[2:], following[2:], atol=1e-4)


@pytest.mark.parametrize("name", VLAS)
def test_what_follows_the_prefix_is_learned_by_vision_language_action_models(name: str) -> None:
    model, spec = make_vla(name)
    batch = with_text(model, make_batch(1, model.chunk, spec=spec, size=2))
    batch |= {"noise": torch.randn(2, *model.noise.shape), "time": torch.tensor([0.3, 0.6])}
    batch["length"] = torch.tensor([3, 0])

    def error(**changes: Tensor) -> float:
        given = {**batch, **changes}
        return float(model.action_loss(model(given), given)["action_loss"].detach())

    expected, known = error(), torch.zeros_like(batch["action"], dtype=torch.bool)
    known[0, :, :3] = True
    changed = batch["action"] + 0.1
    assert error(action=torch.where(known, changed, batch["action"])) == expected
    assert error(executed=torch.where(known, batch["executed"], changed)) == expected
    assert error(executed=torch.where(known, changed, batch["executed"])) != expected
    assert error(action=torch.where(known, batch["action"], changed)) != expected
    late = (torch.arange(model.chunk) >= 2).long().expand_as(batch["perturbations"])
    assert error(perturbations=late * torch.tensor([1, 0])[:, None, None]) == expected  # it was given
    assert error(perturbations=late * torch.tensor([0, 1])[:, None, None]) != expected


def test_a_method_without_its_library_says_which_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_library(self: TrainedPrefix) -> None:
        import_module("no_such_library")

    monkeypatch.setattr(TrainedPrefix, "__init__", without_library, raising=False)
    options = {"device": "cpu", "precision": "fp32", "compile": False, "lanes": 1}
    node = {"_target_": "vla.policy.Policy", **options, "chunking": {"_target_": "vla.models.chunking.TrainedPrefix"}}
    with pytest.raises(ValueError, match=r"policy needs a library that is not installed: .*no_such_library"):
        build(node, "policy", model=make_flow(), spec=SPEC)
