"""The policy as an agent."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from defaults import defaults_of
from fake_batch import MODELS, TINY_TEXT, as_policy, make_act, make_bc, make_denoising, make_rt1
from observing import act, observations
from torch import Tensor, nn
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from toy import SPEC, ToyEnvironment

from vla.io.types import Inherited
from vla.models.compilation import prepare_compilation
from vla.models.flow import Flow
from vla.models.layers import Batch, pixels
from vla.models.model import Model, TokenModel
from vla.models.tokenizers.tokenizer import Uniform
from vla.policy import Policy
from vla.rollouts.rollout import rollout
from vla.spec import Observation


def whole_window(model: Model, seen: list[Observation]) -> torch.Tensor:
    """Logits (k, D, K) of the last of the given frames, all of which the model sees as images."""

    def stack(values: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.stack(values))[None]

    batch = {
        "rgb": {camera: stack([o.rgb[camera] for o in seen]) for camera in SPEC.cameras},
        "state": stack([o.state for o in seen]),
        "present": torch.ones(1, len(seen), dtype=torch.bool),
        "text": model.text.tokenize([seen[0].instruction]),
    }
    with torch.inference_mode():
        logits: torch.Tensor = model(batch)["logits"][0, -1]
    return logits


@pytest.mark.parametrize("name", MODELS)
def test_plays_an_episode_within_the_limits(name: str) -> None:
    torch.manual_seed(0)
    policy = as_policy(MODELS[name](), spec=replace(SPEC, low=(0.02, -0.05, 0.0), high=(0.021, 0.05, 1.0)))
    episode = rollout(ToyEnvironment(), policy, seed=3)
    assert episode.actions.shape == (40, 3) and episode.actions.dtype == np.float32
    assert episode.actions[:, 0].min() >= np.float32(0.02) and episode.actions[:, 0].max() <= np.float32(0.021)
    probabilities = policy.info.get("probabilities")
    assert (probabilities is not None) == policy.model.uses_tokens
    if probabilities is not None:
        assert probabilities.shape == (3, 64) and probabilities.dtype == np.float32
        assert probabilities.sum(-1) == pytest.approx(np.ones(3), abs=1e-5)


@pytest.mark.parametrize("proprioception", [False, True])
def test_kept_tokens_give_what_the_whole_window_gives(proprioception: bool) -> None:
    model = make_rt1(history=3, proprioception=proprioception)
    policy = as_policy(model)
    seen = observations(6)
    policy.reset(seen[0].instruction, 0)
    for step, observation in enumerate(seen):
        policy.act(observation)
        logits = whole_window(model, seen[max(0, step - 2) : step + 1])
        assert policy.info["probabilities"] == pytest.approx(logits[0].softmax(-1).numpy(), abs=1e-5)


STREAMS = [
    [replace(each, instruction=text) for each in observations(5, seed)]
    for seed, text in enumerate(("go", "go", "lift it now", "go", "put it down"))
]


def acted(policy: Policy, order: list[int], together: bool) -> dict[int, list[np.ndarray]]:
    """What the policy does in each of some streams, in lanes in that order, whose seed is the number of the stream."""
    done: dict[int, list[np.ndarray]] = {stream: [] for stream in order}
    for lane, stream in enumerate(order):
        policy.reset(STREAMS[stream][0].instruction, stream, lane)
    for step in range(len(STREAMS[0])):
        for lanes in [range(len(order))] if together else [[lane] for lane in range(len(order))]:
            actions = policy.act([STREAMS[order[lane]][step] for lane in lanes], lanes)
            for lane, action in zip(lanes, actions, strict=True):
                done[order[lane]].append(action)
    return done


@pytest.mark.parametrize("make", [make_bc, make_rt1, partial(make_act, execute=2), partial(make_denoising, Flow)])
@pytest.mark.parametrize("rows", [1, 2, 3, 4])
def test_a_seed_acts_the_same_alone_and_in_any_company_bit_for_bit(make: Callable[..., Model], rows: int) -> None:
    policy = as_policy(make(width=33 if make is make_bc else 32), lanes=rows)  # odd products are rounded by their rows
    alone = acted(policy, [0, 1, 2, 3, 4], together=False)
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1], [2, 0], [1, 3]):
        for stream, actions in acted(policy, order, together=True).items():
            np.testing.assert_array_equal(actions, alone[stream])
    (first,) = acted(as_policy(policy.model, lanes=rows), [3], together=True).values()
    np.testing.assert_array_equal(first, alone[3])


def test_lanes_share_the_passes_of_their_rows() -> None:
    model = make_bc()
    policy, passes = as_policy(model, lanes=2), list[int]()
    model.mlp.register_forward_pre_hook(lambda module, inputs: passes.append(len(inputs[0])))
    for seeds, expected in (([4, 5], [2]), ([4, 6], [2, 2]), ([1], [2])):
        for lane, seed in enumerate(seeds):
            policy.reset("go", seed, lane)
        policy.plan([STREAMS[0][0]] * len(seeds), range(len(seeds)))
        assert passes == expected
        passes.clear()


def test_what_does_not_fit_in_one_lane_leaves_the_others_as_they_were() -> None:
    policy = as_policy(make_rt1())
    policy.reset("go", 0, 1)
    before = policy.act([STREAMS[0][0]], [1])
    policy.reset("go", 0, 1)
    with pytest.raises(ValueError, match="the policy needs "):
        policy.act([STREAMS[0][0], replace(STREAMS[0][1], rgb={})], [1, 2])
    with pytest.raises(ValueError, match=rf"the observation's state is not finite in {SPEC.state[1]}$"):
        policy.act([replace(STREAMS[0][0], state=np.array([0, np.nan], np.float32))], [1])
    np.testing.assert_array_equal(policy.act([STREAMS[0][0]], [1]), before)


class Linear(TokenModel):
    """A linear model of brightness, state and instruction, whose few kernels are soon compiled."""

    def __init__(self, **inherited: Inherited) -> None:
        super().__init__(**inherited)
        inputs = len(self.spec.cameras) + self.robot_state.width + self.text.width
        self.head = nn.Linear(inputs, int(np.prod(self.logits_shape)))

    def forward(self, batch: Batch) -> dict[str, Tensor]:
        brightness = [pixels(batch["rgb"][camera][:, -1:]).mean((1, 2, 3)) for camera in self.spec.cameras]
        features = torch.cat(
            [*(each.unsqueeze(1) for each in brightness), self.robot_state(batch)[:, -1], self.text(batch["text"])], -1
        )
        return {"logits": self.head(features).unflatten(-1, (1, *self.logits_shape))}


# What the compiler knows of the vectors of this processor takes longer to find out than the kernels to compile.
without_vectors = torch._inductor.config.patch("cpp.vec_isa_ok", False)


def make_linear() -> Linear:
    tokenizer = Uniform(spec=SPEC, **defaults_of("tokenizer/uniform", bins=64))
    return Linear(text=TINY_TEXT, text_width=16, chunk=1, width=16, auxiliary=0.0, spec=SPEC, tokenizer=tokenizer)


@without_vectors
def test_compiled_models_of_one_class_act_like_themselves() -> None:
    torch.manual_seed(0)
    seen = observations(3)
    models = [make_linear(), make_linear()]
    for model in models:
        nn.init.normal_(model.head.weight, std=0.5)
    eager, compiled = ([act(as_policy(model, compile=compile), seen) for model in models] for compile in (False, True))
    assert np.abs(eager[0] - eager[1]).max() > 1e-3
    assert compiled == [pytest.approx(actions, abs=1e-5) for actions in eager]


def test_what_is_compiled_is_kept_apart_by_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    folders = {default_cache_dir()}
    for instructions in ("AVX2", "AVX512_CORE", "AVX2"):
        monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", default_cache_dir())  # as PyTorch does when it compiles
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", instructions)
        prepare_compilation()
        folders.add(os.environ["TORCHINDUCTOR_CACHE_DIR"])
    assert len(folders) == 3
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", "chosen")
    prepare_compilation()
    assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == "chosen"


@without_vectors
def test_another_sentence_is_not_compiled_anew() -> None:
    torch.compiler.reset()
    policy = as_policy(make_linear(), compile=True)
    (seen,) = observations(1)
    compiled = torch._dynamo.utils.counters["stats"]
    counts = [compiled["unique_graphs"]]
    for sentence in ("lift it", "put the small green block on the blue pad, and leave the others where they are"):
        policy.act(replace(seen, instruction=sentence))
        counts.append(compiled["unique_graphs"])
    assert counts[0] < counts[1] == counts[2]


@pytest.mark.parametrize("make", [make_bc, make_rt1], ids=["bc", "rt1 with kept tokens"])
def test_in_half_precision_it_sees_about_the_same(make: Callable[[], Model]) -> None:
    torch.manual_seed(0)
    model = make()
    exact, half = as_policy(model), as_policy(model, precision="bf16")
    for seen in observations(4):
        exact.act(seen), half.act(seen)
    assert half.info["probabilities"] == pytest.approx(exact.info["probabilities"], abs=0.01)
    assert not np.array_equal(half.info["probabilities"], exact.info["probabilities"])


def test_a_gpu_that_is_not_there_is_named() -> None:
    with pytest.raises(ValueError, match=r"policy\.device=cuda, but PyTorch finds no GPU"):
        as_policy(make_bc(), device="cuda")


def test_another_instruction_starts_afresh() -> None:
    model = make_rt1(history=3)
    policy, fresh = as_policy(model), as_policy(model)
    seen = observations(4)
    act(policy, seen[:3])
    changed = replace(seen[3], instruction="push the button")
    fresh.reset("push the button", 0)
    assert np.array_equal(policy.act(changed), fresh.act(changed))


@pytest.mark.parametrize("make", [lambda: make_bc(chunk=3), lambda: make_rt1(chunk=3)], ids=["bc", "rt1"])
def test_a_chunk_is_executed_action_by_action(make: Callable[[], TokenModel]) -> None:
    model = make()
    policy = as_policy(model)
    seen = observations(4)
    actions = act(policy, seen)
    planned = [
        model.tokenizer.decode_logits(whole_window(model, part)).numpy()
        for part in (seen[:1], seen[max(0, 4 - model.history) :])
    ]
    expected = np.clip(np.concatenate([planned[0], planned[1][:1]]), SPEC.low, SPEC.high)
    assert actions == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    "rgb",
    [
        {"front": np.zeros((16, 16, 3), np.uint8)},
        {"eye": np.zeros((8, 16, 4), np.uint8)},
        {"eye": np.zeros((8, 16, 3), np.float32)},
    ],
    ids=["camera", "channels", "numbers"],
)
def test_observations_of_another_kind_are_refused(rgb: dict[str, np.ndarray]) -> None:
    policy = as_policy(make_bc())
    with pytest.raises(ValueError, match="eye"):
        policy.act(replace(observations(1)[0], rgb=rgb))
    with pytest.raises(ValueError, match="east"):
        policy.act(replace(observations(1)[0], state=np.zeros(3, np.float32)))


def test_lanes_take_mappings_whose_numbers_are_lists_and_whose_instruction_is_an_array() -> None:
    policy, seen = as_policy(make_bc(), lanes=2), observations(1)[0]
    mapping = {**seen.rgb, "state": seen.state, "instruction": seen.instruction}
    other = {**mapping, "state": seen.state.tolist(), "instruction": np.array(seen.instruction, dtype=object)}
    expected = policy.act([seen, seen], [0, 1])
    np.testing.assert_array_equal(policy.act([mapping, other], [0, 1]), expected)
    for wrong in (None, ["one", "two"]):
        with pytest.raises(ValueError, match=r"^the observation's instruction must be a text, got "):
            policy.act({**mapping, "instruction": wrong})
