"""A process that runs nodes: start, spin until the end or a failure, one sentence on stderr, an exit code."""

from __future__ import annotations

import gc
import logging
import signal
import sys
from collections.abc import Sequence
from types import FrameType

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from hat_ros.errors import HatError
from hat_ros.ros.environment import end_with_parent, keep_large_blocks, leave_cores_to_stages, prepare_environment
from hat_ros.ros.node import HatNode
from hat_ros.ros.session import Session
from hat_ros.ros.shared_memory import free_abandoned


class StopRequest:
    """SIGINT and SIGTERM as a flag that the spinning loop reads.

    rclpy's own handlers take the context away between any two instructions, and whatever is being waited for, published
    or recorded then fails. A process that is still starting (weights, template banks) is interrupted at once instead.
    """

    def __init__(self) -> None:
        self.made = False
        self.starting = True

    def install(self) -> None:
        """Take the two signals over; main thread only."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        first, self.made = not self.made, True
        if first and self.starting:
            raise KeyboardInterrupt


def spin(executor: SingleThreadedExecutor, nodes: Sequence[HatNode[Session]], stop: StopRequest) -> HatError | None:
    """Run nodes until all have finished, one has failed, or the process is asked to end; the failure if any."""
    while not stop.made and not all(node.finished for node in nodes):
        failed = next((node for node in nodes if node.failure is not None), None)
        if failed is not None:
            return failed.failure
        executor.spin_once(timeout_sec=0.2)
    return None


def close(executor: SingleThreadedExecutor, nodes: Sequence[HatNode[Session]]) -> None:
    """Close sessions and destroy nodes, also in a process that was interrupted."""
    executor.shutdown()
    for node in nodes:
        node.release()
        node.destroy_node()


def main(node_classes: Sequence[type[HatNode[Session]]], args: Sequence[str] | None = None) -> int:
    """Entry point of every node process: 0 done, 1 failed, 2 bad input, with one sentence on stderr."""
    free_abandoned()
    prepare_environment()
    keep_large_blocks()
    leave_cores_to_stages()
    logging.getLogger("hat_ros").setLevel(logging.INFO)
    context = Context()
    arguments = list(sys.argv if args is None else args)
    rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor(context=context)
    nodes: list[HatNode[Session]] = []
    stop = StopRequest()
    try:
        stop.install()
        for node_class in node_classes:
            node = node_class(context=context)
            nodes.append(node)
            executor.add_node(node)
            if node.settings.supervisor_pid:
                end_with_parent()
                node.check_supervisor()  # it may have ended before
                if node.failure is not None:
                    raise node.failure
            if node.settings.autostart:
                node.start()
        stop.starting = False
        failure = spin(executor, nodes, stop)
    except HatError as error:
        failure = error
    except KeyboardInterrupt:
        failure = None
    finally:
        close(executor, nodes)
        context.try_shutdown()
        # The interpreter would look at every object once more: half a second of processor time at the end of a node.
        gc.freeze()
    if failure is not None:
        print(failure, file=sys.stderr)
        return failure.exit_code
    return 0
