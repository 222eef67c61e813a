"""Starting and ending ROS: the network, the arguments, the signals."""

from __future__ import annotations

import gc
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

LAST_DOMAIN = 232  # beyond it there are no ports
LOOPBACK = Path(__file__).with_name("loopback.xml")

# What stood behind --ros-args on the command line; it belongs to ROS, and Hydra must not see it.
arguments: list[str] = []


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """What is for Hydra, and the stretch from --ros-args to -- or the end, which is for ROS."""
    if "--ros-args" not in argv:
        return list(argv), []
    start = list(argv).index("--ros-args")
    end = list(argv).index("--", start) if "--" in argv[start:] else len(argv)
    return [*argv[:start], *argv[end + 1 :]], list(argv[start:end])


Range = Literal["SYSTEM_DEFAULT", "LOCALHOST", "SUBNET", "OFF"]
NETWORKS: dict[str, Range] = {"loopback": "SYSTEM_DEFAULT", "localhost": "LOCALHOST", "site": "SUBNET"}


class Network:
    """Who can hear and be heard."""

    def __init__(
        self,
        discovery: Range,
        profile: str | None = None,
        domain: Annotated[int, Ge(0), Le(LAST_DOMAIN)] | None = None,
    ) -> None:
        """Args:
        discovery: ROS_AUTOMATIC_DISCOVERY_RANGE.
        profile: a Fast DDS profile; "loopback" is the one that comes with this package, on 127.0.0.1 only.
        domain: ROS_DOMAIN_ID; None leaves it to the environment.
        """
        self.discovery, self.domain = discovery, domain
        self.profile = str(LOOPBACK) if profile == "loopback" else profile

    @classmethod
    def named(cls, name: str) -> Network:
        """One of the options of `deploy/network`, for the little tools that compose no configuration."""
        return cls(NETWORKS[name], "loopback" if name == "loopback" else None)

    def apply(self) -> None:
        """Set the environment, which ROS reads when it starts.

        Raises:
            ValueError: there is no such profile or domain.
        """
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = self.discovery
        if self.profile is not None:
            if not Path(self.profile).is_file():
                raise ValueError(f"deploy.network.profile: there is no file {self.profile}")
            os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = self.profile
        if self.domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(self.domain)
        domain = os.environ.get("ROS_DOMAIN_ID") or "0"
        if not (domain.isdecimal() and int(domain) <= LAST_DOMAIN):
            raise ValueError(f"deploy.network.domain, or ROS_DOMAIN_ID, is {domain!r}: 0 to {LAST_DOMAIN} exist")


@contextmanager
def ros(network: Network, log_folder: Path | None = None) -> Iterator[Event]:
    """ROS, started; gives an event that SIGINT and SIGTERM set. ROS' own handlers would end it before a last word.

    Raises:
        ImportError: rclpy cannot be imported.
        ValueError: ROS does not start with this network and these arguments.
    """
    network.apply()
    # dm_control has DeprecationWarnings shown; those of other people's packages are nothing that a user could mend.
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="lark")
    if log_folder is not None:
        os.environ.setdefault("ROS_LOG_DIR", str(log_folder))
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise ImportError(
            "ROS 2 is not here: install vla[ros] (Linux, x86-64), or source the setup.bash of a ROS 2 Jazzy whose "
            f"Python is this one ({error})"
        ) from error
    stopped = Event()

    def stop(number: int, frame: FrameType | None) -> None:
        stopped.set()

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        try:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:
            given = shlex.join(arguments) or "its environment"
            raise ValueError(f"ROS does not accept {given}: {str(error).splitlines()[0]}") from error
        yield stopped
    finally:
        rclpy.try_shutdown()
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def plain_errors() -> Iterator[None]:
    """Ends the process with one sentence for what the user can mend."""
    try:
        yield
    except (ValueError, ImportError) as error:
        sys.exit(f"error: {error}")


def spin(node: Any, stopped: Event) -> None:
    """Serve a node's callbacks in this thread until stopped."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    # All that was imported and built stays: the collector need not look through it while an arm moves, nor at the end.
    gc.freeze()
    try:
        while not stopped.is_set():
            executor.spin_once(timeout_sec=0.05)
    finally:
        executor.remove_node(node)
        executor.shutdown()
