"""What `job=…` does: each job a few lines over the parts.

`collect`, `train` and `evaluate` are stages of one line: a stage runs those before it whose product is missing.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from rich import print as show

from vla.check import build, with_changes
from vla.files import atomic_path, writing
from vla.parts import (
    collected,
    make_environment,
    make_expert,
    make_policy,
    make_recorder,
    note_config,
    output_folder,
    plain,
)
from vla.processor import warn_of_bfloat16

if TYPE_CHECKING:
    from vla.evaluate import Report
    from vla.policy import Policy

log = logging.getLogger(__name__)


def run(config: DictConfig) -> float | None:
    """Do what `config.job` says; evaluation returns the success rate, which sweeps maximise."""
    warn_of_bfloat16(config)
    return JOBS[config.job](config)


def preview(config: DictConfig) -> None:
    """Show randomised resets as a contact sheet, their draws as a table, and the expert at work as a recording."""
    from vla.record import RerunRecorder, merge
    from vla.report import contact_sheet, draws_table
    from vla.rollout import rollout

    output = output_folder(config)
    environment = make_environment(plain(config.task))
    expert = make_expert(plain(config.expert), environment)
    seeds = range(config.preview.seed, config.preview.seed + config.preview.episodes)
    with writing(output / "preview.rrd"), TemporaryDirectory(prefix=".recordings-", dir=output) as folder:
        recorder = RerunRecorder(folder)
        episodes = [rollout(environment, expert, seed, recorder) for seed in seeds]
        environment.close()
        merge(sorted(Path(folder).glob("*.rrd")), output / "preview.rrd")
    with atomic_path(output / "preview.png") as draft:
        contact_sheet(list(seeds), [episode.observations[0] for episode in episodes]).save(draft)
    show(draws_table(list(seeds), [episode.draws for episode in episodes]))
    log.info("wrote %s and %s", output / "preview.png", output / "preview.rrd")


def collect(config: DictConfig) -> None:
    """Fill the episode store with verified demonstrations."""
    collected(config)


def train(config: DictConfig) -> None:
    """Train a model on the episode store, which is filled first; a checkpoint is gone on from."""
    from vla.train import trained

    trained(config)


def evaluate(config: DictConfig) -> float | None:
    """Measure the success rate of a checkpoint, which is trained first if none is given, and again under every
    condition that the evaluation names, on the same seeds.

    Raises:
        ValueError: an episode could not be played to its end; the report, which is written, says why.
    """
    from vla.resume import alone, reported
    from vla.train import trained

    output = output_folder(config)
    checkpoint = Path(config.checkpoint) if config.checkpoint and not config.resume else trained(config)
    if checkpoint is None:
        return None
    own = checkpoint.resolve().parent == (output / "checkpoints").resolve()
    if own and (success := reported(config, checkpoint)) is not None:
        return success
    with alone(checkpoint.parent) if own else nullcontext():  # checkpoint=last shall not take it for interrupted
        return _reported(config, checkpoint, output)


def _reported(config: DictConfig, checkpoint: Path, output: Path) -> float:
    """Play, write down how it went, and return the success rate, which is printed even where it cannot be written."""
    from vla.evaluate import SEEN

    started = time.monotonic()
    reports = _played(config, checkpoint, output / "recordings")
    report = reports.pop(SEEN)
    try:
        with writing(output / "report.json"):
            _write_reports(config, checkpoint, output, report, reports, started)
    finally:
        print(report)
    errors = [error for each in (report, *reports.values()) for error in each.errors]
    if errors:
        raise ValueError(f"{len(errors)} episodes ended in an error, see {output / 'report.json'}")
    return report.success


def _write_reports(
    config: DictConfig, checkpoint: Path, output: Path, report: Report, others: dict[str, Report], started: float
) -> None:
    """Write what came of an evaluation that `started` then [s], under the seen and the `others` of its conditions."""
    from vla.evaluate import SEEN, keep_recordings
    from vla.page import PAGE, optional, write_page
    from vla.policy import latency
    from vla.report import plot_report, write_report
    from vla.results import run_of
    from vla.suite import plot_suite, suite_table

    policy = make_policy(plain(config.policy), checkpoint)
    facts = {
        **plain(config.chosen),
        "parameters": sum(p.numel() for p in policy.model.parameters()),
        "latency_ms": latency(policy),
        "budget_s": run_of(checkpoint).budget(time.monotonic() - started),
    }
    note_config(config)
    if config.recorder:
        with optional(output / "rollouts.rrd"):
            keep_recordings(report, output / "recordings", output / "rollouts.rrd", config.evaluate.recordings)
    with atomic_path(output / "report.png") as draft:
        plot_report(report, draft)
    if others:
        with atomic_path(output / "suite.png") as draft:
            plot_suite({SEEN: report, **others}, draft)
        show(suite_table({SEEN: report, **others}))
    # Only now: whoever finds it does nothing of this again.
    write_report(report, output / "report.json", str(checkpoint), plain(config), facts, others)
    with optional(output / PAGE):
        write_page(output)
    log.info("wrote %s, report.json, report.png%s", output / PAGE, " and rollouts.rrd" if config.recorder else "")


def _played(config: DictConfig, checkpoint: Path, recordings: Path) -> dict[str, Report]:
    """Condition → report on the same seeds; the first is what the policy was trained for, and alone is recorded."""
    from vla.evaluate import SEEN, evaluate

    seeds = range(config.evaluate.seed, config.evaluate.seed + config.evaluate.episodes)
    make = partial(make_policy, plain(config.policy), checkpoint)
    recorder = partial(make_recorder, plain(config.recorder), recordings) if config.recorder else None
    task = with_changes(plain(config.task), {})
    reports: dict[str, Report] = {}
    for name, changes in {SEEN: {}, **plain(config.evaluate.conditions)}.items():
        changed = with_changes(task, changes)
        if reports and changed == task:  # the level at which it was trained
            reports[name] = reports[SEEN]
        else:
            environment = partial(make_environment, changed)
            watching = None if reports else recorder
            reports[name] = evaluate(environment, make, watching, seeds, config.evaluate.workers, name)
    return reports


def export(config: DictConfig) -> None:
    """Write the first `collect.episodes` of the episode store in another format, or a trained policy as programs.

    Raises:
        ValueError: programs are asked for, and there is no checkpoint.
    """
    exporter = build(config.export, "export")
    if config.export._target_.startswith("vla.program."):
        log.info("wrote %s", exporter.export(_required_policy(config)))
        return
    log.info("wrote %s", exporter.export(collected(config)))


def deploy(config: DictConfig) -> None:
    """Put a trained policy to work as `config.deploy` says; what reports a success rate is reported like an evaluation.

    Raises:
        ValueError: there is no checkpoint where one is needed.
    """
    from vla.report import plot_report, write_report

    report = deployed(config).run()
    if report is not None:
        output = output_folder(config)
        write_report(report, output / "report.json", config.checkpoint, plain(config))
        plot_report(report, output / "report.png")
        print(report)


def deployed(config: DictConfig) -> Any:
    """The deployment that `config.deploy` describes, ready to run."""
    return build(
        config.deploy,
        "deploy",
        policy=partial(_required_policy, config),
        environment=partial(make_environment, plain(config.task)),
        output=output_folder(config),
    )


def _required_policy(config: DictConfig) -> Policy:
    if config.checkpoint is None:
        raise ValueError("this needs a trained policy: checkpoint=FILE")
    return make_policy(plain(config.policy), Path(config.checkpoint))


def benchmark(config: DictConfig) -> None:
    """Time the stages against their floors and write `benchmark.json`."""
    from vla.benchmark import benchmark

    benchmark(config, output_folder(config))


def inspect(config: DictConfig) -> None:
    """Verify and describe an episode store, which may first be put together from others; or replay one episode."""
    from vla.stores import look_into, replay_into

    asked = plain(config.inspect)
    seed = asked.pop("episode")
    if seed is None:
        look_into(**asked)
    else:
        replay_into(output_folder(config), Path(asked["folder"]), seed)


def report(config: DictConfig) -> None:
    """Compare runs in one page."""
    from vla.page import write_comparison

    log.info("wrote %s", write_comparison([Path(run) for run in config.report.runs], Path(config.output)))


JOBS: dict[str, Callable[[DictConfig], float | None]] = {
    "preview": preview,
    "collect": collect,
    "train": train,
    "evaluate": evaluate,
    "export": export,
    "deploy": deploy,
    "benchmark": benchmark,
    "inspect": inspect,
    "report": report,
}
