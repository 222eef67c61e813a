"""What `job=…` does: each job a few lines over the parts.

`collect`, `train` and `evaluate` are stages of one line: a stage runs those before it whose product is missing.
"""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig
from rich import print as show

from vla.check import build
from vla.parts import (
    collected,
    demonstrated,
    fit,
    make_data,
    make_environment,
    make_expert,
    make_policy,
    make_recorder,
    plain,
    unfitted_learner,
)

if TYPE_CHECKING:
    from vla.policy import Policy

log = logging.getLogger(__name__)


def run(config: DictConfig) -> float | None:
    """Do what `config.job` says; evaluation returns the success rate, which sweeps maximise."""
    return JOBS[config.job](config)


def preview(config: DictConfig) -> None:
    """Show randomised resets as a contact sheet, their draws as a table, and the expert at work as a recording."""
    from vla.record import RerunRecorder, merge
    from vla.report import contact_sheet, draws_table
    from vla.rollout import rollout

    output = _output(config)
    environment = make_environment(plain(config.task))
    expert = make_expert(plain(config.expert), environment)
    seeds = range(config.preview.seed, config.preview.seed + config.preview.episodes)
    recorder = RerunRecorder(output / "recordings")
    episodes = [rollout(environment, expert, seed, recorder) for seed in seeds]
    environment.close()
    files = sorted((output / "recordings").glob("*.rrd"))
    merge(files, output / "preview.rrd")
    for file in files:
        file.unlink()
    (output / "recordings").rmdir()
    contact_sheet(list(seeds), [episode.observations[0] for episode in episodes]).save(output / "preview.png")
    show(draws_table(list(seeds), [episode.draws for episode in episodes]))
    log.info("wrote %s and %s", output / "preview.png", output / "preview.rrd")


def collect(config: DictConfig) -> None:
    """Fill the episode store with verified demonstrations."""
    collected(config)


def train(config: DictConfig) -> None:
    """Train a model on the episode store, which is filled first; a checkpoint is gone on from."""
    _trained(config)


def evaluate(config: DictConfig) -> float:
    """Measure the success rate of a checkpoint, which is trained first if none is given, and again under every
    condition that the evaluation names, on the same seeds.

    Raises:
        ValueError: an episode could not be played to its end; the report, which is written, says why.
    """
    from vla.evaluate import SEEN, evaluate, keep_recordings
    from vla.policy import latency
    from vla.report import plot_report, write_report
    from vla.suite import plot_suite, suite_table

    output = _output(config)
    checkpoint = Path(config.checkpoint) if config.checkpoint else _trained(config)
    seeds = range(config.evaluate.seed, config.evaluate.seed + config.evaluate.episodes)
    recordings = output / "recordings"
    make = partial(make_policy, plain(config.policy), checkpoint)
    recorder = partial(make_recorder, plain(config.recorder), recordings) if config.recorder else None
    task, reports = plain(config.task), {}
    for name, changes in {SEEN: {}, **plain(config.evaluate.conditions)}.items():
        environment = partial(make_environment, {**task, "randomize": {**task["randomize"], **changes}})
        # Recordings are for what the policy was trained for; what fails elsewhere is counted.
        watching = recorder if name == SEEN else None
        reports[name] = evaluate(environment, make, watching, seeds, config.evaluate.workers, name)
    report = reports.pop(SEEN)
    if config.recorder:
        keep_recordings(report, recordings, output / "rollouts.rrd", config.evaluate.recordings)
    policy = make()
    size = {"parameters": sum(p.numel() for p in policy.model.parameters()), "latency_ms": latency(policy)}
    write_report(report, output / "report.json", str(checkpoint), plain(config), size, reports)
    plot_report(report, output / "report.png")
    log.info("wrote %s, report.png%s", output / "report.json", " and rollouts.rrd" if config.recorder else "")
    if reports:
        plot_suite({SEEN: report, **reports}, output / "suite.png")
        show(suite_table({SEEN: report, **reports}))
    print(report)
    errors = [error for each in (report, *reports.values()) for error in each.errors]
    if errors:
        raise ValueError(f"{len(errors)} episodes ended in an error, see {output / 'report.json'}")
    return report.success


def export(config: DictConfig) -> None:
    """Write the first `collect.episodes` of the episode store in another format, or a trained policy as programs.

    Raises:
        ValueError: programs are asked for, and there is no checkpoint.
    """
    exporter = build(config.export)
    if config.export._target_.startswith("vla.program."):
        log.info("wrote %s", exporter.export(_required_policy(config)))
        return
    from vla.data.episodes import EpisodeStore

    store = EpisodeStore(collected(config).folder, config.collect.episodes)
    log.info("wrote %s", exporter.export(store))


def deploy(config: DictConfig) -> None:
    """Put a trained policy to work as `config.deploy` says; what reports a success rate is reported like an evaluation.

    Raises:
        ValueError: there is no checkpoint where one is needed.
    """
    from vla.report import plot_report, write_report

    report = deployed(config).run()
    if report is not None:
        output = _output(config)
        write_report(report, output / "report.json", config.checkpoint, plain(config))
        plot_report(report, output / "report.png")
        print(report)


def deployed(config: DictConfig) -> Any:
    """The deployment that `config.deploy` describes, ready to run."""
    return build(
        config.deploy,
        policy=partial(_required_policy, config),
        environment=partial(make_environment, plain(config.task)),
        output=_output(config),
    )


def _required_policy(config: DictConfig) -> Policy:
    if config.checkpoint is None:
        raise ValueError("this needs a trained policy: checkpoint=FILE")
    return make_policy(plain(config.policy), Path(config.checkpoint))


def benchmark(config: DictConfig) -> None:
    """Time the stages against their floors and write `benchmark.json`."""
    from vla.benchmark import benchmark

    benchmark(config, _output(config))


def inspect(config: DictConfig) -> None:
    """Verify and describe an episode store, which may first be put together from others; or replay one episode."""
    from vla.stores import look_into, replay_into

    asked = plain(config.inspect)
    seed = asked.pop("episode")
    if seed is None:
        look_into(**asked)
    else:
        replay_into(_output(config), Path(asked["folder"]), seed)


JOBS: dict[str, Callable[[DictConfig], float | None]] = {
    "preview": preview,
    "collect": collect,
    "train": train,
    "evaluate": evaluate,
    "export": export,
    "deploy": deploy,
    "benchmark": benchmark,
    "inspect": inspect,
}


def _trained(config: DictConfig) -> Path:
    """Path of the checkpoint that training leaves behind."""
    import lightning

    from vla.models.fidelity import fidelity
    from vla.training import LAST, Interruption, enough_memory, make_trainer, quiet_lightning

    quiet_lightning()
    checkpoints = _output(config) / "checkpoints"
    interruption = Interruption(checkpoints)
    # Before anything is collected: the checkpoint to go on from may be unfit, the devices asked for may be missing, and
    # so may be pretrained weights.
    if config.checkpoint:
        _require_same_policy(config)
    trainer = make_trainer(config, checkpoints, interruption)
    lightning.seed_everything(config.seed, verbose=False)
    with enough_memory(config):
        learner = unfitted_learner(config, demonstrated(config))
    store = collected(config)
    fit(learner.model.tokenizer, config, store)
    data = make_data(config, store, learner.model)
    parameters = sum(parameter.numel() for parameter in learner.model.parameters())
    tokens = fidelity(learner.model.tokenizer, store.statistics.chunks(learner.model.chunk), store.spec.units)
    log.info("%s: %s", type(learner.model.tokenizer).__name__, tokens)
    log.info("training %s with %.2f M parameters", type(learner.model).__name__, parameters / 1e6)
    started = time.monotonic()
    try:
        with enough_memory(config), interruption.listening():
            trainer.fit(learner, datamodule=data, ckpt_path=config.checkpoint, weights_only=True)
    except SystemExit:  # at a SIGTERM Lightning leaves as if all were well
        if not interruption.asked:
            raise
    if interruption.asked:
        raise KeyboardInterrupt
    trainer.save_checkpoint(checkpoints / LAST, weights_only=False)
    if not trainer.is_global_zero:
        sys.exit()  # what follows training is done once
    log.info("trained %d steps in %.0f s: %s", trainer.global_step, time.monotonic() - started, checkpoints)
    return checkpoints / LAST


def _require_same_policy(config: DictConfig) -> None:
    from vla.policy import read_checkpoint

    saved = read_checkpoint(config.checkpoint)
    environment = make_environment(plain(config.task))
    saved.spec.perceived.require(environment.spec.perceived, f"the checkpoint {config.checkpoint}", "the task")
    environment.close()
    for group in ("model", "tokenizer"):
        if saved.config[group] != plain(config[group]):
            raise ValueError(
                f"training cannot go on from {config.checkpoint}, which has another {group}: give the same overrides "
                "as when it was started"
            )


def _output(config: DictConfig) -> Path:
    folder = Path(config.output)
    folder.mkdir(parents=True, exist_ok=True)
    return folder
