"""A process that runs nodes: start, spin until the end or a failure, one sentence on stderr, an exit code."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from hat_ros.errors import HatError
from hat_ros.nodes.base import HatNode
from hat_ros.nodes.environment import keep_large_blocks, prepare_environment


def spin(executor: SingleThreadedExecutor, nodes: Sequence[HatNode]) -> HatError | None:
    """Run nodes until all have finished, one has failed, or the process is asked to end; the failure if any."""
    try:
        while not all(node.finished for node in nodes):
            failed = next((node for node in nodes if node.failure is not None), None)
            if failed is not None:
                return failed.failure
            executor.spin_once(timeout_sec=0.2)
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    return None


def close(executor: SingleThreadedExecutor, nodes: Sequence[HatNode]) -> None:
    """Take nodes apart, also after the context was shut down by a signal: what they hold open must be closed."""
    executor.shutdown()
    for node in nodes:
        node.active = False
        node.release()
        node.destroy_node()


def main(node_classes: Sequence[type[HatNode]], args: Sequence[str] | None = None) -> int:
    """Entry point of every node process: 0 done, 1 failed, 2 bad input, with one sentence on stderr."""
    prepare_environment()
    keep_large_blocks()
    logging.getLogger("hat_ros").setLevel(logging.INFO)
    context = rclpy.Context()
    rclpy.init(
        args=list(sys.argv if args is None else args),
        context=context,
        signal_handler_options=SignalHandlerOptions.ALL,  # a stopped recorder must still close its bag
    )
    executor = SingleThreadedExecutor(context=context)
    nodes: list[HatNode] = []
    try:
        for node_class in node_classes:
            node = node_class(context=context)
            nodes.append(node)
            executor.add_node(node)
            if node.settings.autostart:
                node.start()
        failure = spin(executor, nodes)
    except HatError as error:
        failure = error
    finally:
        close(executor, nodes)
        context.try_shutdown()
    if failure is not None:
        print(failure, file=sys.stderr)
        return failure.exit_code
    return 0
