"""How long a graph may take to answer, and the error when it takes longer."""

from __future__ import annotations

import time

from hat_ros.config import GraphConfig
from hat_ros.errors import StageTimeoutError

# Ends the sentence of a stage timeout, so that whatever started the node can tell it from other failures.
HANGS = "a stage does not answer"
# Far beyond any limit; more would leave the range of floats after hours.
_DOUBLINGS = 16


def answer_limit(config: GraphConfig, first: bool, given_up: int | None = None) -> tuple[float, str]:
    """Seconds that a frame may take through the graph, and the option to raise; the first one also compiles code.

    Args:
        config: the limits.
        first: no frame has been answered so far.
        given_up: live: frames given up in a row. Each doubles the limit: otherwise a graph that is slow, not stuck,
            would have ever more frames in its queues.
    """
    if given_up is not None and not first:
        return min(
            config.live_timeout_s * 2 ** min(given_up, _DOUBLINGS), config.stage_timeout_s
        ), "graph.live_timeout_s"
    if first and config.startup_timeout_s > config.stage_timeout_s:
        return config.startup_timeout_s, "graph.startup_timeout_s"
    return config.stage_timeout_s, "graph.stage_timeout_s"


def check_progress(since_s: float, limit_s: float, what: str, option: str) -> None:
    """Raise when too much time has passed.

    Args:
        since_s: monotonic time of the last progress.
        limit_s: seconds that may pass without any.
        what: what did not happen.
        option: the option that raises the limit.

    Raises:
        StageTimeoutError: more time has passed.
    """
    if time.monotonic() - since_s > limit_s:
        raise StageTimeoutError(f"{what} within {limit_s:g} s (raise {option} if it is only slow)")
