"""Print the state of a deployed policy: python -m vla.deploy.watch"""

from __future__ import annotations

import argparse
from typing import Any

from vla.deploy.ros import NETWORKS, command_node, spin
from vla.deploy.settings import NAME
from vla.io.printable import printable


def main() -> None:
    """Print every status message of the agent until interrupted."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.watch", description=__doc__)
    parser.add_argument("--agent", default="/vla_agent")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    if not NAME.fullmatch(options.agent):
        parser.error(f"--agent {options.agent!r} is not a valid ROS name")
    with command_node("vla_watch", options.network) as (node, stopped):
        from diagnostic_msgs.msg import DiagnosticStatus

        def show(status: Any) -> None:
            values = {pair.key: pair.value for pair in status.values}
            latencies = "  ".join(
                f"{key} {value}" for key, value in values.items() if key not in ("state", "instruction")
            )
            state, instruction = values.get("state", "?"), values.get("instruction", "")
            print(printable(f"{state:8} {status.message:40} '{instruction}'  {latencies}"), flush=True)

        node.create_subscription(DiagnosticStatus, f"{options.agent}/status", show, 10)
        spin(node, stopped)


if __name__ == "__main__":
    main()
