"""A closed-loop demo on one machine: simulator node, policy node, and an operator that sends the instructions."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from vla.deploy.record import BagRecorder, require_new
from vla.deploy.ros import arguments as ros_arguments
from vla.deploy.ros import plain_errors, ros
from vla.deploy.ros2 import PolicyDeployment, SimulatorDeployment
from vla.io.errors import UserError, counted
from vla.io.types import Count
from vla.parallel.processes import leave_with_parent, without_triton
from vla.rollouts.results import ERROR, Report, Result

if TYPE_CHECKING:
    from vla.deploy.operator import DemoOperator
    from vla.policy import Policy
    from vla.spec import Environment

log = logging.getLogger(__name__)

BAG = "bag"  # folder of the recorded messages, in that of the run


@dataclass(kw_only=True)
class Loop:
    """Plays episodes over ROS, reports them as an evaluation would, and records all standard messages as a bag.

    Attributes:
        agent, simulator: factories of the two deployments, called with `policy`, `environment` and `output`.
        episodes: number of episodes.
        policy, environment: factories of the checkpoint's policy and of its task's environment.
        output: folder of the report and the recordings.
    """

    needs_environment: ClassVar[bool] = True

    agent: Callable[..., PolicyDeployment]
    simulator: Callable[..., SimulatorDeployment]
    episodes: Count
    policy: Callable[[], Policy]
    environment: Callable[[], Environment]
    output: Path

    def run(self) -> Report | None:
        """Play all episodes, up to the first that ends in an error, which is raised if none was completed before.

        Returns None if interrupted before the first episode was over.
        """
        with self.running() as operator:
            results: list[Result] = []
            log.info("playing %s", counted(self.episodes, "episode"))
            while len(results) < self.episodes and not operator.stopped.is_set():
                try:
                    result = operator.play()
                except UserError as error:
                    if not results:
                        raise
                    results.append(Result(results[-1].seed + 1, ERROR, error=str(error)))
                    break
                if result:
                    results.append(result)
                    log.info("seed %d: %s", result.seed, result.outcome)
            log.info("%s", ", ".join(f"{key} {value}" for key, value in operator.values.items() if "[ms]" in key))
        return Report(tuple(results)) if results else None

    @contextmanager
    def running(self) -> Iterator[DemoOperator]:
        """Start both nodes and the recorder; yields the operator."""
        arguments = {"policy": self.policy, "environment": self.environment, "output": self.output}
        agent, simulator = self.agent(**arguments), self.simulator(**arguments)
        if agent.command != "joint_state" or agent.dry_run or not agent.autostart:
            raise UserError(
                "deploy=loop: the simulator obeys deploy.agent.command=joint_state only, without deploy.agent.dry_run, "
                "from an agent with deploy.agent.autostart"
            )
        robot = ("joints", "fingers", "finger_open", "finger_closed", "widest")
        for name in ("topics", "network", *(f"robot.{key}" for key in robot)):
            if attrgetter(name)(agent) != attrgetter(name)(simulator):
                raise UserError(
                    f"deploy=loop: agent and simulator would not hear each other, because deploy.agent.{name} and "
                    f"deploy.simulator.{name} differ: change both alike"
                )
        require_new(self.output / BAG)
        context = get_context("spawn")
        processes = [
            context.Process(target=_run, args=(node, ros_arguments), daemon=True) for node in (agent, simulator)
        ]
        with ros(agent.network, self.output) as stop_event, ExitStack() as stack:
            from rclpy import create_node

            from vla.deploy.operator import DemoOperator, require_alone

            node = create_node("vla_operator")
            stack.callback(node.destroy_node)
            require_alone(node)
            for process in processes:
                process.start()
            stack.callback(_end, processes)
            operator = DemoOperator(node, agent.topics.instruction, stop_event, *processes)
            # Recorded to the end, because a failed episode is the one to inspect.
            stack.enter_context(closing(BagRecorder(node, self.output / BAG)))
            yield operator


def _end(processes: Sequence[BaseProcess]) -> None:
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(timeout=5.0)
        process.kill()


def _run(node: PolicyDeployment | SimulatorDeployment, arguments: list[str]) -> None:
    """Run a node in its own process, with arguments of ROS; user errors exit with one sentence."""
    ros_arguments[:] = arguments
    leave_with_parent()
    without_triton()
    with plain_errors():
        node.run()
