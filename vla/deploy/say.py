"""Send an instruction to a deployed policy: python -m vla.deploy.say "put the red block on the pad"; "" stops it."""

from __future__ import annotations

import argparse
import signal
import sys

from vla.deploy.ros import NETWORKS, command_node
from vla.deploy.settings import NAME
from vla.io.printable import printable
from vla.spec import LONGEST_INSTRUCTION


def main() -> None:
    """Reset, hand the arm over, send the instruction, hand back, resume, print the state, as asked, in this order."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.say", description=__doc__)
    parser.add_argument("instruction", nargs="?")
    parser.add_argument("--topic", default="/user/command")
    parser.add_argument("--resume", action="store_true", help="resume a stopped agent")
    parser.add_argument("--reset", action="store_true", help="start the next episode of the simulator")
    parser.add_argument("--state", action="store_true", help="print the state and the latencies of the agent")
    arm = parser.add_mutually_exclusive_group()
    arm.add_argument("--hand-over", action="store_true", help="stop the agent's commands, for a person to move the arm")
    arm.add_argument("--hand-back", action="store_true", help="let the agent command the arm again, from where it is")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    flags = (options.resume, options.hand_over, options.hand_back, options.reset, options.state)
    if options.instruction is None and not any(flags):
        parser.error("nothing to do: add an instruction, --resume, --hand-over, --hand-back, --reset or --state")
    if not NAME.fullmatch(options.topic):
        parser.error(f"--topic {options.topic!r} is not a valid ROS name")
    if (length := len(options.instruction or "")) > LONGEST_INSTRUCTION:
        sys.exit(f"error: the instruction has {length} characters, the limit is {LONGEST_INSTRUCTION}")
    with command_node("vla_say", options.network) as (node, _):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)  # end at once: there is no arm to brake here
        from vla.deploy import calls

        if options.reset:
            print(printable(calls.next_episode(node)))
        if options.hand_over:
            calls.hand_over(node, to_person=True)
        if options.instruction is not None:
            calls.say(node, options.topic, options.instruction)
        if options.hand_back:
            calls.hand_over(node, to_person=False)
        if options.resume:
            calls.resume(node)
        if options.state:
            print(printable(calls.state(node)))


if __name__ == "__main__":
    main()
