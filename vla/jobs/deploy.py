"""`job=deploy`: run a trained policy on a robot or a simulator."""

from __future__ import annotations

import logging
from functools import partial
from typing import Any

from vla.config.differences import value_at
from vla.config.experiment import Experiment
from vla.io.errors import UserError
from vla.io.printable import escape
from vla.models.policy_folder import require_unseen
from vla.runs.folder import PLOT, REPORT, describe_files
from vla.spec import FIRST_SEED

log = logging.getLogger(__name__)


def run(experiment: Experiment) -> None:
    """Run the deployment until done or interrupted; report a measured success rate like an evaluation.

    Raises a UserError if the policy may have been trained or selected on an episode of the deployment, or if an episode
    ended in an error.
    """
    seed, episodes = (value_at(experiment["deploy"], key, None) for key in ("simulator.seed", "episodes"))
    if seed is not None and episodes is not None:  # whose success is reported
        if seed < FIRST_SEED:
            raise UserError(f"deploy.simulator.seed={seed}: seeds below {FIRST_SEED} are for demonstrations: raise it")
        if experiment.checkpoint is not None:
            require_unseen(experiment.checkpoint, "deploy.simulator.seed", range(seed, seed + episodes))
    policy, environment = partial(_policy, experiment), experiment.make_environment()
    deployment = experiment.build("deploy", policy=policy, environment=environment, output=experiment.output)
    if getattr(deployment, "needs_policy", True) and experiment.checkpoint is experiment.make_agent() is None:
        raise UserError("this deployment needs a trained policy: add checkpoint=RUN")
    if (report := deployment.run()) is not None:
        from vla.reports.evaluation import plot_report, write_report  # imports matplotlib, as the next one does
        from vla.reports.run_page import write_page

        output = experiment.output
        write_report(report, output / REPORT, experiment.settings.checkpoint, experiment.config)
        plot_report(report, output / PLOT)
        log.info("wrote %s", describe_files([write_page(output), output / REPORT, output / PLOT]))
        print(escape(str(report)))
        if report.errors:
            raise UserError(f"the last episode ended with an error, see {output / REPORT}: {report.errors[0].error}")


def _policy(experiment: Experiment) -> Any:
    """Build the trained policy, or the agent in its place; raise a UserError if there is neither."""
    make_agent = experiment.make_agent()
    if make_agent is None:
        return experiment.make_policy()()
    world: Any = experiment.world()
    agent: Any = make_agent(world)
    if not hasattr(agent, "plan"):
        raise UserError(f"{type(agent).__name__} plans no chunks of actions, which deploy= needs: use checkpoint=RUN")
    return agent
