"""`job=preview`: a contact sheet of randomised resets, a table of their draws, and a recording of the expert."""

from __future__ import annotations

import logging
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

from vla.config.experiment import Experiment
from vla.config.nodes import Preview
from vla.io.files import writing
from vla.io.printable import show
from vla.reports.observations import draws_table, reset_panels
from vla.reports.pictures import save
from vla.rollouts.recordings import SUFFIXES
from vla.rollouts.rollout import close_agent, rollout
from vla.runs.folder import RECORDINGS

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Roll out the expert on a few seeds; write contact sheet and, with a recorder, recording; print the draws."""
    output, options = experiment.output, experiment.options(Preview)
    seeds, files = range(options.seed, options.seed + options.episodes), [output / "preview.png"]
    with (
        writing(output / "preview.rrd"),
        TemporaryDirectory(prefix=".recordings-", dir=output) as folder,
        closing(experiment.make_environment()()) as environment,
    ):
        make_recorder = experiment.make_recorder(Path(folder))
        expert, recorder = experiment.make_expert()(environment), make_recorder() if make_recorder else None
        first_observations, draws = [], []  # of every episode; all of their images might not fit into memory
        for seed in seeds:
            episode = rollout(environment, expert, seed, recorder)
            first_observations.append(episode.observations[0])
            draws.append(episode.draws)
        close_agent(expert)
        if recordings := sorted(Path(folder).glob("*.rrd")):
            from vla.rollouts.recorder import merge  # imports the viewer's library

            merge(recordings, output / "preview.rrd")
            files.append(output / "preview.rrd")
        for file in sorted(Path(folder).iterdir()):
            if file.suffix not in SUFFIXES:  # of a recorder of a package
                (output / RECORDINGS).mkdir(exist_ok=True)
                files.append(file.replace(output / RECORDINGS / file.name))
    save(output / "preview.png", reset_panels(list(seeds), first_observations), 2, (6.5, 2.2))
    show(draws_table(list(seeds), draws))
    log.info("wrote %s", " and ".join(map(str, files)))
