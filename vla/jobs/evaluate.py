"""`job=evaluate`: the success rate of a policy on the same seeds under every condition; trains a policy if needed.

In a world of recordings there is no success to measure, only errors of actions: `vla.jobs.open_loop`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import print as show

from vla.config.check import Job, with_changes
from vla.config.conditions import conditions
from vla.config.experiment import Experiment
from vla.io.files import writing
from vla.policy import latency
from vla.reports.conditions import conditions_table, plot_conditions
from vla.reports.evaluation import plot_report, write_report
from vla.reports.html import PAGE, optional, write_page
from vla.rollouts.evaluate import IN_DISTRIBUTION, Report, evaluate, keep_recordings
from vla.runs.files import Round
from vla.runs.folder import CHECKPOINTS, save_config, wall_time
from vla.runs.resume import cached_success, training_lock

log = logging.getLogger(__name__)

JOB = Job(
    ("task", "cluster", "agent", "recorder"),
    adopts=True,
    without_agent=("tokenizer", "model", "policy"),
    without_checkpoint=("expert", "data", "learner", "trainer", "logger"),
)


def run(experiment: Experiment) -> float | None:
    """Measure the success rate, or open-loop errors; return None in all but the first process of a training.

    Raises:
        ValueError: an episode ended in an error; the report is written and contains it.
    """
    output = experiment.output
    if experiment["agent"]:
        return _evaluated(experiment, None)
    if not experiment.playable and experiment["evaluate"]["conditions"]:
        raise ValueError("evaluate.conditions change a world, and a recording has none: omit them")
    # Both modules import Lightning, which takes seconds.
    if (checkpoint := experiment.checkpoint) is None:
        from vla.jobs.train import train

        checkpoint = train(experiment)
    if checkpoint is None:
        return None
    if not experiment.playable:
        from vla.jobs.open_loop import evaluate_open_loop

        return evaluate_open_loop(experiment, checkpoint)
    if checkpoint.resolve().parent == (output / CHECKPOINTS).resolve():
        return evaluate_trained(experiment, checkpoint)
    return _evaluated(experiment, checkpoint)


def evaluate_trained(experiment: Experiment, checkpoint: Path, rounds: Sequence[Round] = ()) -> float:
    """Return the success rate of a policy that this run trained, in `rounds` if given; a report of it is kept."""
    if (success := cached_success(experiment.output, experiment.config, checkpoint)) is not None:
        return success
    with training_lock(checkpoint.parent):  # else resume=last would find it interrupted
        return _evaluated(experiment, checkpoint, rounds)


def _evaluated(experiment: Experiment, checkpoint: Path | None, rounds: Sequence[Round] = ()) -> float:
    """Play the episodes, write the reports, and return the success rate; print it even if writing fails."""
    started, output = time.monotonic(), experiment.output
    reports = _play(experiment, checkpoint)
    report = reports[IN_DISTRIBUTION]
    try:
        with writing(output / "report.json"):
            _write(experiment, checkpoint, reports, rounds, started)
    finally:
        print(report)
    errors = [error for each in reports.values() for error in each.errors]
    if errors:
        raise ValueError(f"{len(errors)} episodes ended in an error, see {output / 'report.json'}")
    return report.success


def _play(experiment: Experiment, checkpoint: Path | None) -> dict[str, Report]:
    """Return condition → report on the same seeds; only the first, the training condition, is recorded.

    Without a checkpoint the agent of the config acts.
    """
    asked, task = experiment["evaluate"], experiment["task"]
    seeds = range(asked["seed"], asked["seed"] + asked["episodes"])
    cluster, needs = experiment.cluster(), [checkpoint.resolve()] if checkpoint else []
    make_agent = experiment.make_agent() or experiment.make_policy(needs[0])
    recordings = experiment.output.resolve() / "recordings"
    recorder = experiment.make_recorder(recordings)
    if recorder:
        recordings.mkdir(exist_ok=True)
        needs.append(recordings)
    reports: dict[str, Report] = {}
    for name, changes in {IN_DISTRIBUTION: {}, **conditions(asked)}.items():
        if reports and with_changes(task, changes) == task:  # equal to the training condition
            reports[name] = reports[IN_DISTRIBUTION]
            continue
        watching = None if reports else recorder
        make_environment = experiment.make_environment(changes)
        tiers = task.get("tiers")  # of worlds that have them
        reports[name] = evaluate(make_environment, make_agent, watching, seeds, cluster, name, needs, tiers)
    return reports


def _write(
    experiment: Experiment,
    checkpoint: Path | None,
    reports: dict[str, Report],
    rounds: Sequence[Round],
    started: float,
) -> None:
    """Write all results of an evaluation that started at `started` [s]."""
    output, report = experiment.output, reports[IN_DISTRIBUTION]
    others = {name: each for name, each in reports.items() if name != IN_DISTRIBUTION}
    facts = _facts(experiment, checkpoint, rounds, time.monotonic() - started)
    save_config(output, experiment.config, experiment.changes)
    if experiment["recorder"]:
        recording, limit = output / "rollouts.rrd", experiment["evaluate"]["recordings"]
        with optional(recording):
            keep_recordings(report, output / "recordings", recording, limit)
    plot_report(report, output / "report.png")
    if others:
        plot_conditions(reports, output / "suite.png")
        show(conditions_table(reports))
    # Last, because its existence marks the evaluation as finished.
    write_report(
        report, output / "report.json", str(checkpoint) if checkpoint else None, experiment.config, facts, others
    )
    with optional(output / PAGE):
        write_page(output)
    log.info(
        "wrote %s, report.json, report.png%s", output / PAGE, " and rollouts.rrd" if experiment["recorder"] else ""
    )


def _facts(experiment: Experiment, checkpoint: Path | None, rounds: Sequence[Round], seconds: float) -> dict[str, Any]:
    """Return what a report says of the agent, given the duration of its evaluation [s]."""
    if checkpoint is None:
        chosen = experiment["chosen"]
        return {**chosen, "model": chosen["agent"], "wall_time_s": seconds}
    policy = experiment.make_policy(checkpoint)()
    return {
        **experiment["chosen"],
        "parameters": sum(p.numel() for p in policy.model.parameters()),
        "latency_ms": latency(policy),
        "wall_time_s": wall_time(checkpoint, seconds + _before_last_training(rounds)),
        "rounds": [asdict(one) for one in rounds],
    }


def _before_last_training(rounds: Sequence[Round]) -> float:
    """Return the duration of all rounds but for the training of the last [s], which its own folder has."""
    return sum(each.collection_s + each.training_s for each in rounds) - (rounds[-1].training_s if rounds else 0.0)
