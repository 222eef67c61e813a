"""Tell a deployed policy what to do: python -m vla.deploy.say "put the red block on the pad"; empty words stop it."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from vla.deploy.ros import NETWORKS, Network, ros

PATIENCE = 10.0  # for somebody to listen [s]
SETTLED = 0.7  # without anybody new [s]
RESUME = "/vla_agent/resume"


def main() -> None:
    """Publish one instruction, once somebody listens."""
    parser = argparse.ArgumentParser(prog="python -m vla.deploy.say", description=__doc__)
    parser.add_argument("instruction")
    parser.add_argument("--topic", default="/user/command")
    parser.add_argument("--resume", action="store_true", help="let an agent that was stopped go on")
    parser.add_argument("--network", choices=NETWORKS, default="loopback")
    options = parser.parse_args()
    with ros(Network.named(options.network)):
        import rclpy
        from std_msgs.msg import String

        node = rclpy.create_node("vla_say")
        publisher = node.create_publisher(String, options.topic, 1)
        listeners, since = 0, time.monotonic()
        # Listeners are found one by one, and the first need not be the one that is meant.
        while time.monotonic() - since < (SETTLED if listeners else PATIENCE):
            if publisher.get_subscription_count() != listeners:
                listeners, since = publisher.get_subscription_count(), time.monotonic()
            time.sleep(0.02)
        if publisher.get_subscription_count() == 0:
            sys.exit(
                f"error: nobody listens on {options.topic}: is the agent running, and on the same network and domain?"
            )
        publisher.publish(String(data=options.instruction))
        publisher.wait_for_all_acked()
        if options.resume:
            _resume(node)
        node.destroy_node()


def _resume(node: Any) -> None:
    import rclpy
    from std_srvs.srv import Trigger

    client = node.create_client(Trigger, RESUME)
    if not client.wait_for_service(PATIENCE):
        sys.exit(f"error: nobody serves {RESUME}")
    asked = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, asked, timeout_sec=PATIENCE)
    if not asked.done() or not asked.result().success:
        sys.exit(f"error: {asked.result().message if asked.done() else 'the agent does not answer'}")


if __name__ == "__main__":
    main()
