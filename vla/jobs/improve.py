"""`job=improve`: rounds in which the expert labels what the policy saw, and training goes on (DAgger).

S. Ross, G. Gordon, J. A. Bagnell, A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning, AISTATS 2011 (arXiv 1011.0686), algorithm 3.1. The demonstrations are its first round, in which the expert
acts; in the others the policy does. Every round is a run in a folder of its own, `round_1`, `round_2`, …, with its
episodes beside its checkpoints; `round_0` is the training on demonstrations alone.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from vla.config.adopt import LAST_CHECKPOINT, require_identity
from vla.config.check import devices
from vla.config.differences import value_at
from vla.config.experiment import Experiment
from vla.config.nodes import Rounds, with_changes
from vla.data.datamodule import require_trainable
from vla.data.episodes import EpisodeStore
from vla.data.header import is_store
from vla.data.index import format_numbers
from vla.io.errors import UserError, counted
from vla.jobs.collect import complete_store, demonstrations
from vla.jobs.evaluate import agents_for_workers, evaluate_closed_loop, require_possible
from vla.jobs.train import train
from vla.models.policy_folder import read_policy
from vla.rollouts.collect import collect
from vla.rollouts.rollout import close_agent
from vla.rollouts.statements import Statement
from vla.rollouts.supervised import SupervisedAgent, require_memoryless
from vla.runs.folder import EPISODES, archive_evaluation, read_report, read_run, save_config
from vla.runs.resume import LENGTHS, training_lock
from vla.spec import FIRST_SEED

log = logging.getLogger(__name__)

ROUNDS = ("steps", "episodes", "seed", "changes")  # keys of what every round does


def run(experiment: Experiment) -> float:
    """Improve a policy in rounds and return its success rate; finished rounds, and parts of one, are kept.

    Raises a UserError if the expert cannot label, seeds are not new, or the folder has a round of another policy.
    """
    seeds, statements = _require_possible(experiment)
    main_store = complete_store(experiment)
    for store in (*([main_store] if main_store else ()), *map(EpisodeStore, experiment.collect.more or ())):
        require_new(seeds, store)
    with training_lock(experiment.output):
        _save_config(experiment)
        require_new(seeds, demonstrations(experiment))
        return _improve(experiment, seeds, statements)


def _improve(experiment: Experiment, seeds: range, statements: Sequence[Statement]) -> float:
    options, output = experiment.options(Rounds), experiment.output
    checkpoint, stores = experiment.pretrained, list[Path]()
    if (report := read_report(output)) and (count := value_at(report.config, "improve.rounds", 0)) != options.rounds:
        archive_evaluation(output, count)
    if checkpoint is None:
        checkpoint = _train(experiment.with_values({"job": "train", "output": str(output / "round_0")}))
    for number in range(1, options.rounds + 1):
        folder = output / f"round_{number}"
        store = _labelled_store(experiment, checkpoint, folder / EPISODES, seeds[(number - 1) * options.episodes])
        stores.append(store.folder)
        successes = sum(entry.success for entry in store.episodes)
        log.info("round %d: success in %d of %s", number, successes, counted(len(store.episodes), "labelled episode"))
        checkpoint = _train(_round(experiment, checkpoint, folder, stores))
    return evaluate_closed_loop(experiment, checkpoint, statements)


def _save_config(experiment: Experiment) -> None:
    """Save the config for `resume=`; raise a UserError if the folder has rounds with other episodes or lengths."""
    saved_config = read_run(experiment.output).config
    if saved_config.get("job") == "improve":
        # Later trainings continue the earlier ones, which must not get another length.
        has_rounds = is_store(experiment.output / "round_1" / EPISODES)
        lengths = [f"trainer.{name}" for name in LENGTHS] if experiment.pretrained is None else []
        keys = (*lengths, *(f"improve.{name}" for name in ROUNDS), "policy") if has_rounds else ()
        require_identity(saved_config, experiment.config, experiment.output, keys)
    if saved_config != experiment.config:  # else a new date would suggest that the rounds began again
        save_config(experiment.output, experiment.config, experiment.changes)


def _require_possible(experiment: Experiment) -> tuple[range, list[Statement]]:
    """Return the seeds of all rounds, and what the evaluation is to decide; raise a UserError if evaluation reserves
    them, or the rounds cannot be played."""
    statements = require_possible(experiment)
    options = experiment.options(Rounds)
    seeds = options.seeds
    if seeds.stop > FIRST_SEED:
        raise UserError(f"improve.seed={seeds.start}: its rounds reach {FIRST_SEED}, where evaluation begins: lower it")
    if (Path(experiment.settings.output) / LAST_CHECKPOINT).exists():
        raise UserError(f"{experiment.settings.output} has a training without rounds: choose another output=DIR")
    if devices(experiment["trainer"]) > 1:
        raise UserError("job=improve trains on one device, as its trainings follow each other: add trainer.devices=1")
    if (policy := experiment.pretrained) is not None:
        _require_further_episodes(experiment, policy)
    with closing(experiment.make_environment()()) as environment:
        expert = experiment.make_expert()(environment)
        close_agent(expert)
        require_memoryless(expert)
        require_trainable(environment.spec, map(EpisodeStore, experiment.collect.more or ()))
        if policy is not None:
            read_policy(policy).spec.require_input(environment.spec, f"the checkpoint {policy}", "the task")
        with closing(experiment.make_environment(options.changes)()) as variant:
            environment.spec.require(variant.spec, "the task", "the task with improve.changes")
            with variant.blind():
                variant.reset(seeds.start)
    return seeds, statements


def _require_further_episodes(experiment: Experiment, policy: Path) -> None:
    """Raise a UserError if the policy was trained on further stores, such as rounds, and `collect.more` is not set."""
    stores = value_at(read_policy(policy).config, "collect.more", None)
    if isinstance(stores, list) and stores and experiment.collect.more is None:
        names = ",".join(map(str, stores))
        raise UserError(
            f"{policy} was also trained on {names}: add collect.more=[{names}] to train on "
            "these episodes again, or collect.more=[] to leave them out"
        )


def require_new(seeds: range, store: EpisodeStore) -> None:
    """Raise a UserError if a demonstration has one of the seeds."""
    used_seeds = [entry.seed for entry in store.attempts if entry.seed in seeds]
    if used_seeds:
        raise UserError(
            f"improve.seed={seeds.start}: the {len(seeds)} seeds of the rounds must be new, and the demonstrations in "
            f"{store.folder} have {format_numbers(used_seeds)}: set improve.seed={max(used_seeds) + 1}, or higher"
        )


def _labelled_store(experiment: Experiment, checkpoint: Path, folder: Path, seed: int) -> EpisodeStore:
    """Return the store of a round: episodes of the policy in a checkpoint, labelled by the expert; add missing ones."""
    options = experiment.options(Rounds)
    variant = experiment.with_values({"task": with_changes(experiment["task"], options.changes)})
    nodes = {
        **variant.source,
        "policy": {**experiment["policy"], "weights": read_policy(checkpoint).training.weights[:12]},
        "improve": {"episodes": options.episodes, "seed": seed},
    }
    store = EpisodeStore.create_or_open(folder, variant.world().spec, nodes, experiment.collect.codec)
    with agents_for_workers(experiment, checkpoint) as make_policy:
        agent = partial(SupervisedAgent, make_policy, experiment.make_expert())
        cluster = experiment.build("cluster")
        collect(store, variant.make_environment(), agent, options.episodes, cluster, seed, keep_failures=True)
    return EpisodeStore(folder)


def _round(experiment: Experiment, checkpoint: Path, folder: Path, stores: Sequence[Path]) -> Experiment:
    """Return the experiment that trains in a round, from the last weights, on demonstrations and all rounds so far."""
    steps, batches = experiment.options(Rounds).steps, experiment["trainer"]["accumulate_grad_batches"]
    store_folders = [*(experiment.collect.more or ()), *map(str, stores)]
    return experiment.with_values(
        {
            "job": "train",
            "output": str(folder),
            "pretrained": str(checkpoint),
            "collect.more": store_folders,
            "trainer.max_steps": steps,
            "trainer.val_check_interval": steps * batches,  # once, at the end
        }
    )


def _train(experiment: Experiment) -> Path:
    checkpoint = train(experiment)
    assert checkpoint is not None, "this is the only process"
    return checkpoint
