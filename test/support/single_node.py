"""A domain with an executor, for tests that look at single nodes."""

from __future__ import annotations


def add(executor, node_class, **parameters):
    node = node_class(context=executor.context, parameters=parameters)
    executor.add_node(node)
    return node


def spin_until(executor, condition, turns=200):
    for _ in range(turns):
        if condition():
            return True
        executor.spin_once(timeout_sec=0.02)
    return False
