"""`job=evaluate`: the success rate of a policy on the same seeds under every condition; trains a policy if needed.

In a world of recordings there is no success to measure, only errors of actions: `vla.jobs.open_loop`.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from vla.config.adopt import LAST_CHECKPOINT
from vla.config.annotations import locate
from vla.config.build import Group, build
from vla.config.differences import IGNORED_KEYS
from vla.config.experiment import Experiment
from vla.config.nodes import NEAREST, Evaluation, with_changes
from vla.data.index import INDEX
from vla.io.errors import UserError, counted
from vla.io.files import warn_on_error, writing
from vla.io.printable import escape, show
from vla.io.versions import installed_versions
from vla.models.chunking import require_fit
from vla.models.policy_folder import POLICY, read_policy, require_unseen
from vla.policy import costs, torch_device
from vla.reports.evaluation import plot_report, write_report
from vla.reports.result_tables import conditions_table, plot_conditions, secondary_table
from vla.reports.run_page import try_write_page
from vla.rollouts.comparison import compare_conditions
from vla.rollouts.evaluate import evaluate
from vla.rollouts.memorisation import AgentWithoutModality, make_nearest, open_memory
from vla.rollouts.realtime import NetworkedAgent
from vla.rollouts.recordings import clear_recordings, keep_pictures, merge_recordings
from vla.rollouts.results import Report
from vla.rollouts.rollout import AgentFactory, EnvironmentFactory
from vla.rollouts.shared_policy import shared_policy
from vla.rollouts.statements import BarStatement, RunStatement, Statement, differs_clearly
from vla.runs.files import readable_config
from vla.runs.folder import PLOT, RECORDING, RECORDINGS, REPORT, SUITE, describe_files, require_run, save_config
from vla.runs.played import PlayedEpisodes
from vla.runs.resume import cached_report, has_rounds
from vla.schedule import Delays
from vla.spec import FIRST_SEED, IN_DISTRIBUTION, Multitask

log = logging.getLogger(__name__)

NETWORK = Group("evaluate.networks", ("vla.rollouts.realtime.Network",))


def run(experiment: Experiment) -> float | None:
    """Measure the success rate, or open-loop errors; raise a UserError if an episode ended in an error.

    The result is None in all but the first process of a training, and if no episodes are left to evaluate on.
    """
    statements, agent = require_possible(experiment), experiment.make_agent()
    checkpoint = None if agent else experiment.checkpoint or _train(experiment)
    if checkpoint is agent is None:
        return None
    if experiment.playable:
        return evaluate_closed_loop(experiment, checkpoint, statements)
    from vla.jobs.open_loop import evaluate_open_loop  # imports Lightning, which takes seconds, as training does

    return evaluate_open_loop(experiment, checkpoint)


def _train(experiment: Experiment) -> Path | None:
    """Train; return None in all but the first process, or if no episodes are left to evaluate on."""
    from vla.jobs.train import train

    if experiment.playable or experiment["data"]["validation_fraction"]:
        return train(experiment)
    log.warning("data.validation_fraction=0 trains on all episodes and leaves none to evaluate the policy on")
    train(experiment)
    return None


def evaluate_closed_loop(experiment: Experiment, checkpoint: Path | None, statements: Sequence[Statement]) -> float:
    """Return the success rate of a policy, or of the agent of the config, and print it after what was to be decided.

    A finished evaluation of a policy is not repeated, and an unfinished one continues after the episodes that were
    played. If an episode ended in an error, a UserError is raised after the report, which contains it, is written.
    """
    output, identity = experiment.output, _identity(experiment, checkpoint)
    weights = identity["weights"]
    if checkpoint and (finished := cached_report(output, experiment.config, checkpoint, weights)):
        try_write_page(output)  # once more, because a kill or a full disk may have left none, or an older one
        report = finished.reports[IN_DISTRIBUTION]
        _conclude([*finished.statements, str(report)])
        return report.success
    against, conclusions = experiment.evaluate.against, list[str]()
    if against and Path(against).resolve() != output.resolve():  # it may have been evaluated again during the training
        statements = _statements(experiment)
    _ = experiment.origin, experiment.changes  # determine them now, before the code may change
    try:
        with PlayedEpisodes(output, identity) as played:
            if checkpoint is None and any(played.results.values()) and (url := (experiment["agent"] or {}).get("url")):
                log.warning("they are of what %s served then: if that is another policy now, choose output=DIR", url)
            with agents_for_workers(experiment, checkpoint) as make_agent:
                reports = _play(experiment, make_agent, statements, played)
            if checkpoint and read_policy(checkpoint).training.weights != weights:  # workers read them as they start
                raise UserError(f"{checkpoint} was replaced while it was evaluated: run the evaluation again")
            report = reports[IN_DISTRIBUTION]
            verdicts = [statement.say(report) for statement in statements]
            conclusions += [*verdicts, str(report)]
            with writing(output / REPORT):
                facts = {**_facts(experiment, checkpoint), "weights": weights, "statements": verdicts}
                _write(experiment, checkpoint, reports, facts)
            if errors := _errors(reports):  # what was played is kept, so that the same command plays only these again
                hint = f"the same evaluation with output={output} plays only these again"
                raise UserError(f"{counted(errors, 'episode')} ended in an error, see {output / REPORT}: {hint}")
    finally:
        _conclude(conclusions)
    return report.success


def _conclude(conclusions: Sequence[str]) -> None:
    """Print the conclusions, after whatever was logged, because scripts read the last line."""
    for line in conclusions:
        print(escape(line))


def _identity(experiment: Experiment, checkpoint: Path | None) -> dict[str, Any]:
    """Return what determines the results of all conditions of an evaluation; other episodes and conditions do not."""
    config = {name: node for name, node in experiment.config.items() if name not in (*IGNORED_KEYS, "evaluate")}
    weights = read_policy(checkpoint).training.weights if checkpoint else None
    is_recorded = experiment.evaluate.recordings == "all"  # as it is played
    identity = {"weights": weights, "versions": installed_versions(), "config": config, "recorded": is_recorded}
    if checkpoint is None and (memory := _digest((experiment["agent"] or {}).get("folder"))):
        identity["memory"] = memory
    return identity


def _digest(folder: str | None) -> str | None:
    """Return the SHA-256 of the index of an episode store; None for no folder, and any other."""
    index = Path(folder) / INDEX if folder else None
    return hashlib.sha256(index.read_bytes()).hexdigest() if index and index.is_file() else None


def _condition_identity(options: Evaluation, name: str) -> str:
    """Return what determines the results of a condition, apart from `_identity`."""
    detail = options.changes.get(name) or options.networks.get(name)
    if name == NEAREST:
        detail = _digest(options.nearest)
    return json.dumps([name, detail])


def agents_for_workers(experiment: Experiment, checkpoint: Path | None) -> AbstractContextManager[AgentFactory]:
    """Return a context with the factory of a checkpoint's policy, run where `cluster.policy` says, or of the agent."""
    if checkpoint is None:
        make_agent = experiment.make_agent()
        assert make_agent is not None, "there is an agent or a checkpoint"
        return nullcontext(make_agent)
    make_policy = experiment.make_policy(checkpoint.resolve())  # workers may be in another folder
    return shared_policy(make_policy) if experiment.build("cluster").policy == "here" else nullcontext(make_policy)


def _conditions(experiment: Experiment, make_agent: AgentFactory) -> dict[str, tuple[EnvironmentFactory, AgentFactory]]:
    """Return condition → world and agent: the training condition, then those that change its world or its agent.

    The other agents are this one without a modality or at the other end of a network, and the nearest demonstration.
    """
    options, world = experiment.evaluate, experiment.make_environment()
    conditions = {IN_DISTRIBUTION: (world, make_agent)}
    for name, changes in options.changes.items():
        if with_changes(experiment["task"], changes) != experiment["task"]:
            conditions[name] = experiment.make_environment(changes), make_agent
    for modality in options.without:
        conditions[f"without_{modality}"] = world, partial(AgentWithoutModality, make_agent, modality)
    if options.nearest:
        conditions[NEAREST] = world, partial(make_nearest, Path(options.nearest).resolve())
    for name, node in options.networks.items():
        conditions[name] = world, partial(NetworkedAgent, make_agent, build(node, NETWORK))
    return conditions


def _play(
    experiment: Experiment, make_agent: AgentFactory, statements: Sequence[Statement], played: PlayedEpisodes
) -> dict[str, Report]:
    """Return condition → report on the same seeds; only the first, the training condition, is recorded.

    Episodes in `played` are not played again; others are added to it. With `evaluate.until` the first condition stops
    once all statements are decided; the others play the seeds of the first, and stop once their difference is decided.
    """
    options, recordings = experiment.evaluate, experiment.output.resolve() / RECORDINGS
    make_recorder = experiment.make_recorder(recordings)
    if make_recorder:
        recordings.mkdir(exist_ok=True)
    if not any(played.results.values()):
        clear_recordings(recordings)
    world = experiment.world() if options.until else None
    turns = len(world.tasks) if isinstance(world, Multitask) else 1
    cluster = experiment.build("cluster")
    lanes = 1 if cluster.policy == "here" else (experiment["policy"] or {}).get("lanes", 1)  # here, workers are lanes
    play = partial(evaluate, cluster=cluster, turns=turns, lanes=lanes, recordings=options.recordings)
    conditions, reports, seeds = _conditions(experiment, make_agent), dict[str, Report](), list(options.seeds)
    until = (lambda report: all(statement.is_decided(report) for statement in statements)) if statements else None
    for number, (name, (make_environment, make_its_agent)) in enumerate(conditions.items(), 1):
        is_first = name == IN_DISTRIBUTION
        label, identity = "as configured" if is_first else name, _condition_identity(options, name)
        known_results = played.results[identity]
        reports[name] = play(
            *(make_environment, make_its_agent, make_recorder if is_first else None, seeds),
            name=f"{label} ({number} of {len(conditions)})" if len(conditions) > 1 else label,
            until=until if options.until else None,
            known_results={seed: known_results[seed] for seed in seeds if seed in known_results},
            on_result=partial(played.add, identity),
        )
        if is_first:
            seeds = [result.seed for result in reports[name].results]
            until = partial(differs_clearly, reports[name], options.margin, len(conditions) - 1)
    tiers = experiment["task"].get("tiers") or {}  # of worlds that have them
    reports = {name: replace(report, tiers=tiers) for name, report in reports.items()}
    training = reports[IN_DISTRIBUTION]  # also the report of conditions that change nothing, which were not played
    return {name: reports.get(name, training) for name in (IN_DISTRIBUTION, *options.changes, *reports)}


def require_possible(experiment: Experiment) -> list[Statement]:
    """Check, before any work, that the evaluation can be completed, and return what it is to decide.

    Raises a UserError if the run to compare with or a store is missing, there is nothing to decide, a policy, a
    network, a condition or a tier is impossible, or the episodes selected the weights or are not distinct.
    """
    options, settings = experiment.evaluate, experiment.settings
    readable_config(experiment.config)
    for name in (settings.checkpoint, settings.pretrained):
        if name:
            require_unseen(name, "evaluate.seed", options.seeds)  # whatever `validate` is now
    statements = _statements(experiment)  # before a training that goes on archives the report of its run
    if not experiment.nodes.get("agent"):
        _require_usable(experiment)
    for node in options.networks.values():
        network = build(node, NETWORK)
        if (chunking := (experiment.nodes.get("policy") or {}).get("chunking")) and not experiment.nodes.get("agent"):
            method = locate("policy.chunking._target_", chunking["_target_"])
            delays = Delays(1 / experiment.world().spec.control_hz)
            delays.add(network.latency + network.jitter)
            require_fit(method, experiment["model"], delays.forecast)
    if not experiment.playable and options.changes:
        raise UserError("evaluate.conditions change a world, and a recording has none: omit them")
    if options.nearest is not None:
        open_memory(Path(options.nearest), None, experiment.world().spec)
    output = Path(settings.output)  # not created yet
    if settings.job != "improve" and has_rounds(output):
        raise UserError(f"{output} has the rounds of a job=improve, whose report this would replace: add output=DIR")
    _require_own(experiment, output)
    # Worlds take time to compile: one is built for all conditions that change the same arguments; nodes were checked.
    # Before hours of training it is one for the same parts of these, such as `randomize`.
    trains = experiment.checkpoint is None and not experiment.nodes.get("agent")
    key = _changed_parts if trains else frozenset
    kinds = {key(changes): (name, changes) for name, changes in reversed(options.changes.items())}
    for name, changes in kinds.values() if experiment.playable else ():
        try:
            with closing(experiment.make_environment(changes)()) as world, world.blind():
                world.reset(options.seed)  # fails, for instance, with more blocks than colours
        except ValueError as error:
            raise UserError(f"condition {name} of the evaluation: {error}") from error
    if hasattr(experiment.kind("task"), "distinct"):
        for name, changes in {IN_DISTRIBUTION: {}, **options.changes}.items():
            with closing(experiment.make_environment(changes)()) as world:
                _require_distinct(name, world, options)
                if trains and not changes:
                    _require_unseen_in_validation(world, experiment.validate.seeds, options.seeds)
                elif not changes and (selected := _validation(experiment)):
                    _require_unseen_in_validation(world, selected, options.seeds)
    return statements


def _validation(experiment: Experiment) -> range | None:
    """Return the seeds whose episodes in this task selected the weights of the policy to evaluate, if known."""
    saved = read_policy(experiment.checkpoint) if experiment.checkpoint else None
    if saved is None or saved.training.validation is None or saved.config["task"] != experiment["task"]:
        return None
    first, count = saved.training.validation
    return range(first, first + count)


def _changed_parts(changes: Mapping[str, Any]) -> frozenset[tuple[str, ...]]:
    """Return the arguments that a condition changes, each followed by those within, if it is a node."""
    return frozenset((name, *(value if isinstance(value, Mapping) else ())) for name, value in changes.items())


def _require_usable(experiment: Experiment) -> None:
    """Raise a UserError if the policy, which may have to be trained first, lacks a GPU or cannot be exported."""
    kind: Any = experiment.kind("policy")
    if experiment["policy"].get("device") == "cuda":
        torch_device("cuda")
    if hasattr(kind, "require_exportable"):
        kind.require_exportable(experiment.kind("model"), experiment.kind("tokenizer"))


def _require_own(experiment: Experiment, output: Path) -> None:
    """Raise a UserError if the output folder has a training, and not its policy but another one, or an agent, acts."""
    policy = experiment.checkpoint
    acts_otherwise = policy is not None or experiment["agent"] is not None
    if not acts_otherwise or (policy and policy.resolve().is_relative_to(output.resolve())):
        return
    if (output / LAST_CHECKPOINT).exists() or (output / POLICY).exists():
        raise UserError(f"{output} has a training of its own, whose report this would replace: add output=DIR")


def _require_unseen_in_validation(world: Any, validation: range, evaluation: range) -> None:
    """Raise a UserError if seeds that select the weights give episodes of the evaluation in a world."""
    if world.distinct([*validation, *evaluation]) < world.distinct(validation) + world.distinct(evaluation):
        raise UserError(
            f"validate.seed={validation.start} and evaluate.seed={evaluation.start} share initial states, but episodes "
            f"that select the weights must not evaluate them: train with validate.seed={2 * FIRST_SEED}"
        )


def _require_distinct(condition: str, world: Any, options: Evaluation) -> None:
    """Raise a UserError if an evaluation would play an episode twice in the world of a condition."""
    count: int = world.distinct(options.seeds)
    if count < options.episodes:
        place = "" if condition == IN_DISTRIBUTION else f" in the condition {condition}"
        raise UserError(
            f"evaluate.episodes={options.episodes}: there are {count} different ones{place}, and no interval may count "
            f"one twice: set evaluate.episodes={count}"
        )


def _statements(experiment: Experiment) -> list[Statement]:
    """Build the statements to decide; raise a UserError if the run to compare with is missing, or nothing to decide."""
    options, statements = experiment.evaluate, list[Statement]()
    measured = (options.bar is not None, options.against, options.until, options.agent_conditions)
    if not experiment.playable and any(measured):
        raise UserError(
            "evaluate.bar, against, until, without, nearest and networks need a success rate, which recordings lack: "
            "omit them"
        )
    if options.bar is not None:
        statements.append(BarStatement(options.bar))
    if options.against is not None:
        statements.append(_against_run(experiment, options.against))
    if options.until and not (statements or options.changes or options.agent_conditions):
        raise UserError(
            "evaluate.until=decided needs something to decide: evaluate.bar=0.95, evaluate.against=RUN, or conditions, "
            "as in evaluate=suite"
        )
    return statements


def _against_run(experiment: Experiment, run: str) -> RunStatement:
    """Build the comparison with another run; raise a UserError if it has no report or no episode in common."""
    report = require_run(Path(run)).report
    if report is None:
        raise UserError(f"evaluate.against={run} has no report.json to compare with: evaluate that run first")
    results = {result.seed: result for result in report.per_episode}
    if not any(result.draws for result in report.per_episode) and report.config.get("task") != experiment["task"]:
        results = {}  # without draws to compare, equal seeds are the same episodes in the same task only
    statement = RunStatement(run, results, experiment.evaluate.margin, report.anytime)
    statement.require_common(experiment.evaluate.seeds)
    return statement


def _write(experiment: Experiment, checkpoint: Path | None, reports: dict[str, Report], facts: dict[str, Any]) -> None:
    """Write all results of an evaluation; `facts` are further entries of its report."""
    output, options, report = experiment.output, experiment.evaluate, reports[IN_DISTRIBUTION]
    conditions = {name: other for name, other in reports.items() if name != IN_DISTRIBUTION}
    compared = compare_conditions(reports, options.margin)
    save_config(output, experiment.config, experiment.changes)
    recording = output / RECORDING
    for file in (recording, output / SUITE):
        file.unlink(missing_ok=True)
    if experiment["recorder"] and not _errors(reports):  # else the same command continues
        with warn_on_error(recording):
            facts["recorded"] = merge_recordings(report, output / RECORDINGS, recording, options.recordings)
    with warn_on_error(output / PLOT):
        (output / PLOT).unlink(missing_ok=True)  # of an earlier evaluation
        plot_report(report, output / PLOT)
    if conditions:
        with warn_on_error(output / SUITE):
            plot_conditions(reports, output / SUITE)
        show(conditions_table(reports, compared))
        secondary = secondary_table({(name,): tests for name, tests in compared.items() if reports[name] is not report})
        if secondary.rows:
            show(secondary)
    policy = str(checkpoint) if checkpoint else None
    # Last, because its existence marks the evaluation as finished.
    write_report(report, output / REPORT, policy, experiment.config, facts, conditions, compared)
    if "recorded" in facts:  # only now: without a report the same command merges them again
        with warn_on_error(output / RECORDINGS):
            keep_pictures(report, output / RECORDINGS, options.recordings, {*facts["recorded"]})
    log.info("wrote %s", describe_files([try_write_page(output), output / REPORT, output / PLOT, recording]))


def _errors(reports: Mapping[str, Report]) -> int:
    """Return the number of errors; conditions that are equal to the training condition share its report."""
    return sum(len(report.errors) for report in {id(report): report for report in reports.values()}.values())


def _facts(experiment: Experiment, checkpoint: Path | None) -> dict[str, Any]:
    """Return the entries of a report that describe the agent."""
    facts = {**experiment.settings.chosen, "versions": installed_versions(), "origin": asdict(experiment.origin)}
    return facts | (costs(experiment.make_policy(checkpoint)()) if checkpoint else {"model": facts["agent"]})
