"""Tell a deployed policy what to do: python -m vla.deploy.say "put the red block on the pad"; empty words stop it."""

from __future__ import annotations

import argparse
import time
from typing import Any

from vla.deploy.ros import NETWORKS, Network, plain_errors, ros
from vla.spec import LONGEST_INSTRUCTION

PATIENCE = 10.0  # for somebody to listen or to answer [s]
SETTLED = 0.7  # without anybody new [s]
RESUME, CHANGE, RESET = "/vla_agent/resume", "/vla_agent/change_state", "/vla_simulator/reset"


def main() -> None:
    """Reset, say and resume, whatever of it is asked for, in this order."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.say", description=__doc__)
    parser.add_argument("instruction", nargs="?")
    parser.add_argument("--topic", default="/user/command")
    parser.add_argument("--resume", action="store_true", help="let an agent that was stopped go on")
    parser.add_argument("--reset", action="store_true", help="start the next episode of the simulator")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    if options.instruction is None and not (options.resume or options.reset):
        parser.error("nothing to do: add an instruction, --resume or --reset")
    words = options.instruction or ""
    with plain_errors():
        if len(words) > LONGEST_INSTRUCTION:
            raise ValueError(f"the instruction has {len(words)} characters, at most {LONGEST_INSTRUCTION} are heard")
        with ros(Network.named(options.network)):
            import rclpy

            node = rclpy.create_node("vla_say")
            if options.reset:
                print(next_episode(node))
            if options.instruction is not None:
                say(node, options.topic, words)
            if options.resume:
                resume(node)
            node.destroy_node()


def say(node: Any, topic: str, words: str) -> None:
    """Publish an instruction once all who listen are found.

    Raises:
        ValueError: nobody listens.
    """
    from std_msgs.msg import String

    publisher = node.create_publisher(String, topic, 1)
    listeners, since = 0, time.monotonic()
    # Listeners are found one by one, and the first need not be the one that is meant.
    while time.monotonic() - since < (SETTLED if listeners else PATIENCE):
        if publisher.get_subscription_count() != listeners:
            listeners, since = publisher.get_subscription_count(), time.monotonic()
        time.sleep(0.02)
    if publisher.get_subscription_count() == 0:
        raise ValueError(f"nobody listens on {topic}: is the agent running, and on the same network and domain?")
    publisher.publish(String(data=words))
    publisher.wait_for_all_acked()


def resume(node: Any) -> None:
    """Let an agent that was stopped go on.

    Raises:
        ValueError: there is none, or it was not stopped.
    """
    from std_srvs.srv import Trigger

    answer = _ask(node, Trigger, RESUME, Trigger.Request())
    if not answer.success:
        raise ValueError(answer.message)


def next_episode(node: Any) -> str:
    """Start the simulator's next episode, in which the agent, if there is one, first waits for an instruction.

    Returns what the simulator says of the episode.

    Raises:
        ValueError: there is no simulator, or one of the nodes does not answer.
    """
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState
    from std_srvs.srv import Trigger

    def change(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(_ask(node, ChangeState, CHANGE, request).success)

    reset = node.create_client(Trigger, RESET)
    if not reset.wait_for_service(PATIENCE):
        raise ValueError(f"nobody serves {RESET}: is the simulator running, and on the same network and domain?")
    agent = node.create_client(ChangeState, CHANGE).wait_for_service(SETTLED)
    # The arm is somewhere else afterwards: an agent that went on would pull it back to where it was.
    active = agent and change(Transition.TRANSITION_DEACTIVATE)
    words = str(_ask(node, Trigger, RESET, Trigger.Request()).message)
    if active and not change(Transition.TRANSITION_ACTIVATE):
        raise ValueError("the agent cannot be activated again, its log says why")
    return words


def _ask(node: Any, kind: Any, service: str, request: Any) -> Any:
    import rclpy

    client = node.create_client(kind, service)
    if not client.wait_for_service(PATIENCE):
        raise ValueError(f"nobody serves {service}: is the agent running, and on the same network and domain?")
    asked = client.call_async(request)
    rclpy.spin_until_future_complete(node, asked, timeout_sec=PATIENCE)
    if not asked.done():
        raise ValueError(f"{service} does not answer")
    return asked.result()


if __name__ == "__main__":
    main()
