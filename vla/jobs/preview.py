"""`job=preview`: a contact sheet of randomised resets, a table of their draws, and a recording of the expert."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
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
from vla.spec import Recorder

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Roll out the expert on a few seeds; write contact sheet and, with a recorder, recording; print the draws."""
    output, options = experiment.output, experiment.options(Preview)
    seeds, picture = range(options.seed, options.seed + options.episodes), output / "preview.png"
    with (
        recording(experiment, output / "preview.rrd") as (recorder, recordings),
        closing(experiment.make_environment()()) as environment,
    ):
        expert = experiment.make_expert()(environment)
        first_observations, draws = [], []  # of every episode; all of their images might not fit into memory
        for seed in seeds:
            episode = rollout(environment, expert, seed, recorder)
            first_observations.append(episode.observations[0])
            draws.append(episode.draws)
        close_agent(expert)
    save(picture, reset_panels(list(seeds), first_observations), 2, (6.5, 2.2))
    show(draws_table(list(seeds), draws))
    log.info("wrote %s", " and ".join(map(str, [picture, *recordings])))


@contextmanager
def recording(experiment: Experiment, target: Path) -> Iterator[tuple[Recorder | None, list[Path]]]:
    """Yield the recorder, if any, for a few episodes, and a list to which the files that it wrote are added at the end.

    Rerun's recordings become one file, `target`; files of a package's recorder get a folder beside it.
    """
    files = list[Path]()
    with writing(target), TemporaryDirectory(prefix=".recordings-", dir=target.parent) as folder:
        make_recorder = experiment.make_recorder(Path(folder))
        yield make_recorder() if make_recorder else None, files
        if recordings := sorted(Path(folder).glob("*.rrd")):
            from vla.rollouts.recorder import merge  # imports the viewer's library

            merge(recordings, target)
            files.append(target)
        for file in sorted(Path(folder).iterdir()):
            if file.suffix not in SUFFIXES:
                (target.parent / RECORDINGS).mkdir(exist_ok=True)
                place = target.parent / RECORDINGS / file.name
                if place.is_dir():  # of an earlier preview, which no other folder can replace
                    shutil.rmtree(place)
                files.append(file.replace(place))
