"""A closed-loop demo on one machine: simulator node, policy node, and an operator that sends the instructions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from vla.deploy.bag import BagRecorder
from vla.deploy.ros import plain_errors, ros
from vla.deploy.ros2 import PolicyDeployment, SimulatorDeployment
from vla.io.errors import UserError
from vla.io.types import Count
from vla.parallel.processes import leave_with_parent, without_triton
from vla.rollouts.results import ERROR, Report, Result
from vla.spec import Shell

if TYPE_CHECKING:
    from vla.deploy.demo_operator import DemoOperator
    from vla.policy import Policy
    from vla.spec import Environment

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class Loop:
    """Plays episodes over ROS and reports them as an evaluation would.

    Attributes:
        agent, simulator: factories of the two deployments, called with `policy`, `environment` and `output`.
        episodes: number of episodes.
        shell: factory of the surface of the arm in `session.rrd`; None draws lines between its joints.
        record: write the inputs and commands of the agent as `session.rrd`, and all standard messages as a bag.
        policy, environment: factories of the checkpoint's policy and of its task's environment.
        output: folder of the report and the recordings.
    """

    needs_environment: ClassVar[bool] = True

    agent: Callable[..., PolicyDeployment]
    simulator: Callable[..., SimulatorDeployment]
    episodes: Count
    record: bool
    shell: Callable[[], Shell] | None
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> Report:
        """Play all episodes, up to the first one that ends in an error.

        Raises:
            UserError: a node exited or does not respond in the first episode, or is not to move the arm.
        """
        with self.running() as operator:
            results: list[Result] = []
            log.info("playing %d episodes", self.episodes)
            while len(results) < self.episodes and not operator.stopped.is_set():
                try:
                    result = operator.play()
                except ValueError as error:
                    if not results:
                        raise
                    results.append(Result(results[-1].seed + 1, ERROR, error=str(error)))
                    break
                if result:
                    results.append(result)
                    log.info("seed %d: %s", result.seed, result.outcome)
            log.info("%s", ", ".join(f"{key} {value}" for key, value in operator.status.items() if "[ms]" in key))
        return Report(tuple(results))

    @contextmanager
    def running(self) -> Iterator[DemoOperator]:
        """Start both nodes, and the recorders if configured; yields the operator."""
        arguments = {"policy": self.policy, "environment": self.environment, "output": self.output}
        agent, simulator = self.agent(**arguments), self.simulator(**arguments)
        if agent.command != "joint_state" or agent.dry_run:
            raise UserError(
                "deploy=loop: the simulator obeys deploy.agent.command=joint_state only, without deploy.agent.dry_run"
            )
        processes = get_context("spawn")
        nodes = [processes.Process(target=_run, args=(node,), daemon=True) for node in (agent, simulator)]
        for node in nodes:
            node.start()
        try:
            with ros(agent.network, self.output) as stopped, ExitStack() as opened:
                from vla.deploy.demo_operator import DemoOperator

                operator = DemoOperator(agent.topics.instruction, simulator.timing.speed, stopped, *nodes)
                opened.callback(operator.node.destroy_node)
                if self.record:
                    self._record(operator.node, opened)
                yield operator
        finally:
            for node in nodes:
                node.terminate()
            for node in nodes:
                node.join(timeout=5.0)
                node.kill()

    def _record(self, node: Any, opened: ExitStack) -> None:
        """Record until `opened` is closed: an episode that fails is the one to look at."""
        from vla.deploy.view import View

        session = self.output / "session.rrd"
        opened.callback(log.info, "rerun %s shows the inputs and commands of the agent", session)
        opened.enter_context(closing(BagRecorder(node, self.output / "bag")))
        shell = self.shell() if self.shell is not None else None
        opened.enter_context(closing(View(node, session, shell)))


def _run(node: PolicyDeployment | SimulatorDeployment) -> None:
    """Run a node in its own process; user errors exit with one sentence."""
    leave_with_parent()
    without_triton()
    with plain_errors():
        node.run()
