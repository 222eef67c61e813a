"""Initialisation and shutdown of ROS: network, arguments, signals."""

from __future__ import annotations

import gc
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from threading import Event
from typing import Annotated, Any, Literal

from annotated_types import Ge, Le

from vla.io.errors import UserError
from vla.io.printable import escape
from vla.parallel.processes import signal_event

MAX_DOMAIN = 232  # larger domains have no UDP ports
LOOPBACK = Path(__file__).with_name("loopback.xml")

# The arguments after --ros-args on the command line, which Hydra must not parse.
arguments: list[str] = []


def split_arguments(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split off the arguments of ROS, from --ros-args to -- or the end; returns those of Hydra and those of ROS."""
    if "--ros-args" not in argv:
        return list(argv), []
    start = list(argv).index("--ros-args")
    end = list(argv).index("--", start) if "--" in argv[start:] else len(argv)
    return [*argv[:start], *argv[end + 1 :]], list(argv[start:end])


FAST_DDS = "rmw_fastrtps"  # prefix of the names of its RMW implementations
Reach = Literal["loopback", "localhost", "site"]
NETWORKS = {"loopback": "SYSTEM_DEFAULT", "localhost": "LOCALHOST", "site": "SUBNET"}  # → ROS_AUTOMATIC_DISCOVERY_RANGE


@dataclass(frozen=True)
class RosNetwork:
    """The part of the network that ROS communicates with."""

    reach: Reach  # 127.0.0.1 and shared memory, this machine, the local network
    profile: str | None  # file with a Fast DDS profile; None: for `loopback` that of this package
    domain: Annotated[int, Ge(0), Le(MAX_DOMAIN)] | None  # ROS_DOMAIN_ID; None: that of the environment

    def apply(self) -> None:
        """Set the environment variables that ROS reads at start; raise a UserError if ROS would not accept them."""
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = NETWORKS[self.reach]
        if self.profile or self.reach == "loopback":
            profile = Path(self.profile or LOOPBACK)
            if not profile.is_file():
                raise UserError(f"deploy.network.profile: there is no file {profile}")
            middleware = os.environ.get("RMW_IMPLEMENTATION") or FAST_DDS
            if not middleware.startswith(FAST_DDS):
                raise UserError(
                    f"RMW_IMPLEMENTATION is {middleware}, which ignores the profile of Fast DDS that keeps others out: "
                    "unset it, or choose deploy.network.reach=localhost or site"
                )
            os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(profile)
        if self.domain is not None:
            os.environ["ROS_DOMAIN_ID"] = str(self.domain)


def require_ros(network: RosNetwork) -> None:
    """Import ROS for a network; raise a UserError if it is not installed, or would not accept the network."""
    network.apply()
    # dm_control enables DeprecationWarnings; users cannot fix those of other packages.
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="lark")
    try:
        import_module("rclpy")
    except ImportError as error:
        raise UserError(
            "ROS 2 is not installed: install vla[ros] (Linux, x86-64), or source the setup.bash of a ROS 2 Jazzy for "
            f"this version of Python ({error})"
        ) from error


@contextmanager
def ros(network: RosNetwork, log_folder: Path | None = None) -> Iterator[Event]:
    """Run ROS; yields an event that SIGINT, SIGTERM and a hang-up of the terminal set.

    The handlers of ROS would shut it down before a node can publish its last command.

    Raises:
        UserError: rclpy cannot be imported.
        UserError: ROS does not accept this network or these arguments.
    """
    require_ros(network)
    if log_folder is not None:
        os.environ.setdefault("ROS_LOG_DIR", str(log_folder))
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    hangup = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)  # ignored by nohup
    with signal_event(signal.SIGINT, signal.SIGTERM, *hangup) as stop_event:
        try:
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as error:
            settings = shlex.join(arguments) or "its environment"
            raise UserError(f"ROS does not accept {settings}: {str(error).splitlines()[0]}") from error
        try:
            yield stop_event
        finally:
            rclpy.try_shutdown()


@contextmanager
def plain_errors() -> Iterator[None]:
    """Exit with one sentence on user errors."""
    try:
        yield
    except UserError as error:
        sys.exit(escape(f"error: {error}"))
    except OSError as error:
        sys.exit(f"error: {error.filename}: {error.strerror}" if error.filename else f"error: {error}")


@contextmanager
def command_node(name: str, network: Reach) -> Iterator[tuple[Any, Event]]:
    """Run a command as a ROS node on a part of the network; user errors exit with one sentence.

    Yields the node, and the event of `ros`.
    """
    with plain_errors(), ros(RosNetwork(network, None, None)) as stop_event:
        from rclpy import create_node

        node = create_node(name)
        yield node, stop_event
        node.destroy_node()


def spin(node: Any, stopped: Event) -> None:
    """Run a node's callbacks in this thread until stopped."""
    from rclpy.executors import SingleThreadedExecutor

    executor = SingleThreadedExecutor()
    executor.add_node(node)
    # Exclude all existing objects, which stay alive, from garbage collection while an arm moves.
    gc.freeze()
    try:
        while not stopped.is_set():
            executor.spin_once(timeout_sec=0.05)
    finally:
        executor.remove_node(node)
        executor.shutdown()
