"""`job=evaluate`: the success rate of a policy on the same seeds under every condition; trains a policy if needed.

In a world of recordings there is no success to measure, only errors of actions: `vla.jobs.open_loop`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from vla.config.build import Group, build
from vla.config.check import NEAREST, Job, conditions, with_changes
from vla.config.experiment import Experiment
from vla.io.errors import UserError
from vla.io.files import warn_on_error, writing
from vla.io.printable import printable, show
from vla.io.versions import installed_versions
from vla.policy import costs
from vla.reports.evaluation import plot_report, write_report
from vla.reports.result_tables import SecondaryRows, conditions_table, plot_conditions, secondary_table
from vla.reports.run_page import write_page
from vla.rollouts.comparison import compare_conditions, compare_secondary_metrics
from vla.rollouts.evaluate import RecorderFactory, evaluate
from vla.rollouts.memorisation import make_nearest, make_without, open_memory
from vla.rollouts.realtime import Network, make_over_network
from vla.rollouts.recordings import clear, keep_recordings
from vla.rollouts.results import Report
from vla.rollouts.rollout import AgentFactory
from vla.rollouts.shared_policy import shared_policy
from vla.rollouts.statements import AgainstBar, AgainstRun, Statement, differs_clearly
from vla.runs.files import Round
from vla.runs.folder import (
    CHECKPOINTS,
    PAGE,
    PLOT,
    RECORDING,
    RECORDINGS,
    REPORT,
    SUITE,
    require_run,
    save_config,
    wall_time,
)
from vla.runs.played import Played
from vla.runs.resume import cached_success, training_lock
from vla.spec import IN_DISTRIBUTION, Multitask

log = logging.getLogger(__name__)

JOB = Job(
    ("task", "cluster", "agent", "recorder"),
    adopts=True,
    without_agent=("tokenizer", "model", "policy"),
    without_checkpoint=("expert", "data", "learner", "trainer", "logger"),
)


def run(experiment: Experiment) -> float | None:
    """Measure the success rate, or open-loop errors; return None in all but the first process of a training.

    A policy that is trained on all episodes of a recording is not evaluated, as none is left: the result is None, too.

    Raises:
        UserError: an episode ended in an error; the report is written and contains it.
    """
    output = experiment.output
    require_possible(experiment)
    if experiment["agent"] and experiment.playable:
        return _evaluated(experiment, None)
    # Both modules import Lightning, which takes seconds.
    if (checkpoint := experiment.checkpoint) is None and not experiment["agent"]:
        from vla.jobs.train import train

        if not experiment.playable and not experiment["data"]["validation_fraction"]:
            log.warning("data.validation_fraction=0 trains on all episodes and leaves none to evaluate the policy on")
            train(experiment.with_values({"job": "train"}))  # else resume=last would wait for an evaluation
            return None
        if (checkpoint := train(experiment)) is None:
            return None
    trained_here = checkpoint is not None and checkpoint.resolve().parent == output.resolve()
    if not experiment.playable:
        from vla.jobs.open_loop import evaluate_open_loop

        with training_lock(output / CHECKPOINTS) if trained_here else nullcontext():
            return evaluate_open_loop(experiment, checkpoint)
    assert checkpoint is not None
    if trained_here:
        return evaluate_trained(experiment, checkpoint)
    known = cached_success(output, experiment.config, checkpoint)
    return _evaluated(experiment, checkpoint) if known is None else known


def require_possible(experiment: Experiment) -> None:
    """Check, before any work, that the evaluation can be completed.

    Raises:
        UserError: there is no such run to compare with, nothing to decide, no such network or store, or no world to
            change; or its episodes selected the weights.
    """
    _require_unseen(experiment)
    _statements(experiment)
    _networks(experiment)
    if not experiment.playable and experiment["evaluate"]["conditions"]:
        raise UserError("evaluate.conditions change a world, and a recording has none: omit them")
    if (folder := experiment["evaluate"]["nearest"]) is not None:
        open_memory(Path(folder), None, experiment.world().spec)
    output = Path(experiment["output"])  # not created yet
    if experiment["job"] != "improve" and any(output.glob(f"round_*/{CHECKPOINTS}")):
        raise UserError(f"{output} has the rounds of a job=improve, whose report this would replace: add output=DIR")
    if experiment.playable:
        for name, changes in conditions(experiment["evaluate"]).items():
            _require_world(experiment, name, changes)


def _require_unseen(experiment: Experiment) -> None:
    """Raise a UserError if an episode of the evaluation selected given weights, whatever `validate` is now."""
    asked, named = experiment["evaluate"], [experiment["checkpoint"], experiment["pretrained"]]
    if not any(named):
        return
    from vla.models.policy_folder import is_gone, require_unseen  # imports PyTorch

    for name in named:
        if name and not is_gone(name):  # initial weights may have been deleted since
            require_unseen(name, "evaluate.seed", range(asked["seed"], asked["seed"] + asked["episodes"]))


def _require_world(experiment: Experiment, name: str, changes: dict[str, Any]) -> None:
    """Raise a UserError if there is no episode under a condition, such as with more blocks than colours."""
    try:
        world = experiment.make_environment(changes)()
        try:
            with world.blind():
                world.reset(experiment["evaluate"]["seed"])
        finally:
            world.close()
    except ValueError as error:
        raise UserError(f"condition {name} of the evaluation: {error}") from error


def evaluate_trained(experiment: Experiment, checkpoint: Path, rounds: Sequence[Round] = ()) -> float:
    """Return the success rate of a policy that this run trained, in `rounds` if given; a report of it is kept."""
    if (success := cached_success(experiment.output, experiment.config, checkpoint)) is not None:
        return success
    with training_lock(checkpoint.parent / CHECKPOINTS):  # else resume=last would find it interrupted
        return _evaluated(experiment, checkpoint, rounds)


def _evaluated(experiment: Experiment, checkpoint: Path | None, rounds: Sequence[Round] = ()) -> float:
    """Play the episodes, write the reports, and return the success rate; print it even if writing fails."""
    output, statements, result = experiment.output, _statements(experiment), list[str]()
    _ = experiment.origin  # of the code that is evaluated, not of later changes
    try:
        sources = _sources(experiment, checkpoint)
        with (
            Played(output, sources, experiment.config, installed_versions()) as played,
            policy_for_workers(experiment, checkpoint) as make_policy,
        ):
            reports = _play(experiment, checkpoint, make_policy, statements, played)
            report = reports[IN_DISTRIBUTION]
            result += [*(each.say(report) for each in statements), str(report)]
            with writing(output / REPORT):
                _write(experiment, checkpoint, reports, statements, rounds, played.seconds)
            if errors := _errors(reports):  # what was played is kept, so that the same command plays only these again
                raise UserError(f"{errors} episodes ended in an error, see {output / REPORT}")
    finally:
        for line in result:  # after whatever was logged, because scripts read the last line
            print(printable(line))
    return report.success


@contextmanager
def policy_for_workers(experiment: Experiment, checkpoint: Path | None) -> Iterator[AgentFactory | None]:
    """Enter with the factory of the policy in a checkpoint, which runs where `cluster.policy` says."""
    if checkpoint is None:
        yield None
        return
    make_policy = experiment.make_policy(checkpoint.resolve())  # workers may be in another folder
    if experiment["cluster"].get("policy") != "here":
        yield make_policy
        return
    with shared_policy(make_policy) as make_agent:
        yield make_agent


def _errors(reports: Mapping[str, Report]) -> int:
    """Return the number of errors; conditions that are equal to the training condition share its report."""
    return sum(len(each.errors) for each in {id(each): each for each in reports.values()}.values())


def _sources(experiment: Experiment, checkpoint: Path | None) -> list[Path]:
    """Return the files and folders that agents are read from."""
    named = [checkpoint, (experiment["agent"] or {}).get("folder"), experiment["evaluate"]["nearest"]]
    return [Path(each) for each in named if each is not None]


def _statements(experiment: Experiment) -> list[Statement]:
    """Build the statements on the training condition that the evaluation must decide.

    Raises:
        UserError: there is no such run to compare with, or nothing to decide.
    """
    asked = experiment["evaluate"]
    bar, against, found = asked["bar"], asked["against"], list[Statement]()
    if bar is not None:
        found.append(AgainstBar(bar))
    if against is not None:
        report = require_run(Path(against)).report
        if report is None:
            raise UserError(f"evaluate.against={against} has no report.json to compare with: evaluate that run first")
        theirs = {result.seed: result for result in report.per_episode}
        if not any(result.draws for result in report.per_episode) and report.config.get("task") != experiment["task"]:
            theirs = {}  # without draws to compare, equal seeds are the same episodes in the same task only
        statement = AgainstRun(against, theirs, asked["margin"], report.anytime)
        statement.require_common(range(asked["seed"], asked["seed"] + asked["episodes"]))
        found.append(statement)
    others = asked["without"] or asked["nearest"] or asked["networks"]
    if asked["until"] and not found and not (conditions(asked) or others):
        raise UserError(
            "evaluate.until=decided needs something to decide: evaluate.bar=0.95, evaluate.against=RUN, or conditions, "
            "as in evaluate=suite"
        )
    if not experiment.playable and (found or asked["until"] or others):
        raise UserError(
            "evaluate.bar, against, until, without, nearest and networks need success, which recordings do not have: "
            "omit them"
        )
    return found


def _networks(experiment: Experiment) -> dict[str, Network]:
    """Return condition → network of `evaluate.networks`.

    Raises:
        UserError: one is invalid.
    """
    kind = Group("evaluate.networks", ("vla.rollouts.realtime.Network",))
    return {name: build(node, kind) for name, node in experiment["evaluate"]["networks"].items()}


def _play(
    experiment: Experiment,
    checkpoint: Path | None,
    make_policy: AgentFactory | None,
    statements: Sequence[Statement],
    kept: Played,
) -> dict[str, Report]:
    """Return condition → report on the same seeds; only the first, the training condition, is recorded.

    Episodes in `kept` are not played again; others are added to it. Without a checkpoint the agent of the config acts.
    With `evaluate.until` the first condition stops when all statements are clear. Every other one has the seeds of the
    first, and stops when its difference from it is clear.
    """
    asked, task = experiment["evaluate"], experiment["task"]
    seeds: Sequence[int] = range(asked["seed"], asked["seed"] + asked["episodes"])
    cluster = experiment.cluster()
    named = (experiment["agent"] or {}).get("folder")
    here = experiment["cluster"].get("policy") == "here"  # then lanes are workers
    lanes = 1 if here else (experiment["policy"] or {}).get("lanes", 1)
    if folder := named and Path(named).resolve():  # workers may be in another folder
        experiment = experiment.with_values({"agent.folder": str(folder)})
    make_agent = experiment.make_agent() or make_policy
    assert make_agent is not None, "there is a checkpoint"
    recordings = experiment.output.resolve() / RECORDINGS
    recorder = experiment.make_recorder(recordings)
    if recorder:
        recordings.mkdir(exist_ok=True)
    if not len(kept):
        clear(recordings)

    def played(
        name: str,
        seeds: Sequence[int],
        until: Callable[[Report], bool] | None,
        changes: dict[str, Any] | None = None,
        agent: AgentFactory = make_agent,
        recorder: RecorderFactory | None = None,
    ) -> Report:
        environment, wanted = experiment.make_environment(changes), asked["recordings"]
        until = until if asked["until"] else None
        known, keep = kept.of(name), partial(kept.add, name)
        report = evaluate(environment, agent, recorder, seeds, cluster, name, until, wanted, turns, known, keep, lanes)
        return replace(report, tiers=task.get("tiers") or {})  # of worlds that have them

    world = experiment.world() if asked["until"] else None
    turns = len(world.tasks) if isinstance(world, Multitask) else 1
    decided = (lambda report: all(each.is_decided(report) for each in statements)) if statements else None
    first = played(IN_DISTRIBUTION, seeds, decided, recorder=recorder)
    reports, seeds = {IN_DISTRIBUTION: first}, [result.seed for result in first.results]
    changed = {name: changes for name, changes in conditions(asked).items() if with_changes(task, changes) != task}
    others = _other_agents(experiment, make_agent)
    until = partial(differs_clearly, first, asked["margin"], len(changed) + len(others))
    for name in conditions(asked):
        reports[name] = played(name, seeds, until, changed[name]) if name in changed else first
    return reports | {name: played(name, seeds, until, agent=agent) for name, agent in others.items()}


def _other_agents(experiment: Experiment, make_agent: AgentFactory) -> dict[str, AgentFactory]:
    """Return condition → factory of another agent: the same one without a modality or at the other end of a network, or
    the nearest demonstration."""
    asked = experiment["evaluate"]
    impaired = {f"without_{each}": partial(make_without, make_agent, each) for each in asked["without"]}
    distant = {name: partial(make_over_network, make_agent, network) for name, network in _networks(experiment).items()}
    folder = asked["nearest"]
    replayed = {NEAREST: partial(make_nearest, Path(folder).resolve())} if folder else {}
    return {**impaired, **replayed, **distant}


def _write(
    experiment: Experiment,
    checkpoint: Path | None,
    reports: dict[str, Report],
    statements: Sequence[Statement],
    rounds: Sequence[Round],
    seconds: float,
) -> None:
    """Write all results of an evaluation that took `seconds`."""
    output, report = experiment.output, reports[IN_DISTRIBUTION]
    others = {name: each for name, each in reports.items() if name != IN_DISTRIBUTION}
    compared, secondary = (
        compare_conditions(reports, experiment["evaluate"]["margin"]),
        compare_secondary_metrics(reports),
    )
    facts = _facts(experiment, checkpoint, rounds, seconds) | {"origin": asdict(experiment.origin)}
    facts["statements"] = [each.say(report) for each in statements]
    save_config(output, experiment.config, experiment.changes)
    recording = output / RECORDING
    recording.unlink(missing_ok=True)  # of an earlier evaluation
    if experiment["recorder"]:
        with warn_on_error(recording):
            again = _errors(reports) > 0  # this evaluation is then continued
            wanted = experiment["evaluate"]["recordings"]
            facts["recorded"] = keep_recordings(report, output / RECORDINGS, recording, wanted, again)
    with warn_on_error(output / PLOT):
        (output / PLOT).unlink(missing_ok=True)  # of an earlier evaluation
        plot_report(report, output / PLOT)
    (output / SUITE).unlink(missing_ok=True)  # of an earlier evaluation
    if others:
        with warn_on_error(output / SUITE):
            plot_conditions(reports, output / SUITE)
        show(conditions_table(reports, compared))
        rows: SecondaryRows = {
            (name,): metrics for name, metrics in secondary.items() if metrics and reports[name] is not report
        }
        if rows:
            show(secondary_table(rows, ["condition"]))
    used = str(checkpoint) if checkpoint else None
    # Last, because its existence marks the evaluation as finished.
    write_report(report, output / REPORT, used, experiment.config, facts, others, compared, secondary)
    page = None
    with warn_on_error(output / PAGE):
        page = write_page(output)
    written = [path for path in (page, output / REPORT, output / PLOT, recording) if path and path.is_file()]
    log.info("wrote %s", ", ".join([str(written[0]), *(path.name for path in written[1:])]))


def _facts(experiment: Experiment, checkpoint: Path | None, rounds: Sequence[Round], seconds: float) -> dict[str, Any]:
    """Return the entries of a report that describe the agent, given the duration of its evaluation [s]."""
    chosen = {**experiment["chosen"], "versions": installed_versions()}
    if checkpoint is None:
        return {**chosen, "model": chosen["agent"], "wall_time_s": seconds}
    return {
        **chosen,
        **costs(experiment.make_policy(checkpoint)()),
        "wall_time_s": wall_time(checkpoint, seconds + _before_last_training(rounds)),
        "rounds": [asdict(one) for one in rounds],
    }


def _before_last_training(rounds: Sequence[Round]) -> float:
    """Return the duration of all rounds [s] without the last training, which is read from its own folder."""
    return sum(each.collection_s + each.training_s for each in rounds) - (rounds[-1].training_s if rounds else 0.0)
