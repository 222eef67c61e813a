"""Send an instruction to a deployed policy: python -m vla.deploy.say "put the red block on the pad"; "" stops it."""

from __future__ import annotations

import argparse
import signal
import sys

from vla.deploy.ros import NETWORKS, command_node
from vla.deploy.settings import NAME
from vla.io.printable import escape
from vla.spec import LONGEST_INSTRUCTION

FLAGS = {  # in the order in which they are obeyed; the instruction follows --hand-over
    "reset": "start the next episode of the simulator",
    "hand-over": "stop the agent's commands, for a person to move the arm",
    "hand-back": "let the agent command the arm again, from where it is",
    "resume": "resume a stopped agent",
    "state": "print the state and the latencies of the agent",
}


def main() -> None:
    """Do what is asked."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.say", description=__doc__)
    parser.add_argument("instruction", nargs="?", help="sentence to follow; an empty one stops the agent")
    parser.add_argument("--topic", default="/user/command", help="deploy.topics.instruction of the agent")
    for flag, purpose in FLAGS.items():
        parser.add_argument(f"--{flag}", action="store_true", help=purpose)
    parser.add_argument("--network", choices=NETWORKS, default="loopback", help="deploy.network.reach of the agent")
    options = parser.parse_args()
    if options.instruction is None and not any(getattr(options, flag.replace("-", "_")) for flag in FLAGS):
        parser.error(f"nothing to do: add an instruction, or one of --{', --'.join(FLAGS)}")
    if not NAME.fullmatch(options.topic):
        parser.error(f"--topic {options.topic!r} is not a valid ROS name")
    if (length := len(options.instruction or "")) > LONGEST_INSTRUCTION:
        sys.exit(f"error: the instruction has {length} characters, the limit is {LONGEST_INSTRUCTION}")
    with command_node("vla_say", options.network) as (node, stop_event):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)  # end at once: there is no arm to brake here
        if stop_event.is_set():  # by a signal that came before that
            signal.raise_signal(signal.SIGINT)
        from vla.deploy.operator import Operator

        operator = Operator(node, options.topic)
        if options.reset:
            print(escape(operator.next_episode()))
        if options.hand_over:
            operator.hand_over(to_person=True)
        if options.instruction is not None:
            operator.say(options.instruction)
        if options.hand_back:
            operator.hand_over(to_person=False)
        if options.resume:
            operator.resume()
        if options.state:
            print(escape(operator.describe()))


if __name__ == "__main__":
    main()
