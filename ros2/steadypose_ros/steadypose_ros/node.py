"""steadypose as a lifecycle node: configured by parameters, running while active.

The steadypose program is installed separately, with its own Python. This node starts it, and imports nothing of it.
"""

# pyright: reportMissingImports=false
# rclpy is installed with ROS

from __future__ import annotations

import ctypes
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

OWN = {"launch": "ros2", "command": "steadypose", "autostart": True}
"""The node's own parameters and their defaults. Any other parameter is a setting of steadypose's launch file."""
OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides")
"""Prefixes of ROS's own parameters, which are not passed on."""
STOPS_WITHIN_S = 15.0
"""Time after which a program that does not stop is killed, seconds."""


def arguments(parameters: Mapping[str, Any], namespace: str) -> list[str]:
    """The command line of steadypose.

    Args:
        parameters: all parameters of the node by name: ``OWN``, and ``section.key`` of a launch file.
        namespace: the node's namespace, such as ``/robot``; also that of the topics, unless ``ros2.namespace`` is set.
    """
    settings = {name: it for name, it in parameters.items() if name not in OWN and not name.startswith(OF_ROS)}
    settings.setdefault("ros2.namespace", namespace.strip("/"))
    command = [parameters["command"], "run", parameters["launch"]]
    for name, value in settings.items():
        plain = value if isinstance(value, (bool, int, float, str)) else list(value)
        command += ["--set", f"{name}={json.dumps(plain, ensure_ascii=False)}"]  # JSON values are valid TOML here
    return command


class SteadyposeNode(LifecycleNode):
    """A lifecycle node that is active while the program runs. When the program ends or fails, it becomes inactive."""

    def __init__(self) -> None:
        super().__init__(
            "steadypose", allow_undeclared_parameters=True, automatically_declare_parameters_from_overrides=True
        )
        for name, default in OWN.items():
            if not self.has_parameter(name):
                self.declare_parameter(name, default)
        self._command: list[str] = []
        self._program: subprocess.Popen[bytes] | None = None
        self.create_timer(0.5, self._watch)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        found = {name: parameter.value for name, parameter in self.get_parameters_by_prefix("").items()}
        if shutil.which(found["command"]) is None:
            self.get_logger().error(
                f"parameter command: expected steadypose's program, got {found['command']!r}, which is not there; "
                "give its path, such as command:=/home/me/steadypose/steadypose"
            )
            return TransitionCallbackReturn.FAILURE
        self._command = arguments(found, self.get_namespace())
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.get_logger().info(" ".join(self._command))
        # in a separate session, so that Ctrl-C reaches only this node, which passes it on once
        self._program = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, start_new_session=True, preexec_fn=_end_with_parent
        )
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.stop()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.stop()
        return super().on_shutdown(state)

    def stop(self) -> None:
        """Stop the program as Ctrl-C does, and wait for it to end."""
        program, self._program = self._program, None
        if program is None or program.poll() is not None:
            return
        program.send_signal(signal.SIGINT)
        try:
            program.wait(STOPS_WITHIN_S)
        except subprocess.TimeoutExpired:
            program.kill()
            program.wait()

    def _watch(self) -> None:
        if self._program is not None and (status := self._program.poll()) is not None:
            log = self.get_logger().error if status else self.get_logger().info
            log(f"steadypose ended, with status {status}")
            self._program = None
            self.trigger_deactivate()


def _end_with_parent() -> None:
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGINT)


def main() -> None:
    rclpy.init()
    node = SteadyposeNode()
    try:
        autostart = node.get_parameter("autostart").value
        if autostart and node.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            node.trigger_activate()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.stop()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
