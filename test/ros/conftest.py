"""A short synthetic clip with the answers of one process to it, and an executor for single nodes."""

from __future__ import annotations

import numpy as np
import pytest
import rclpy
from graph_clip import CONFIG_OVERRIDES, FIRST_NS, N_FRAMES, STEP_NS, run_in_process
from rclpy.executors import SingleThreadedExecutor

from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.bench.synth.models import write_model
from hat_ros.config import load_config
from hat_ros.io.bag_writer import BagWriter
from hat_ros.ros import process
from hat_ros.ros.node import HatNode
from hat_ros.target.loading import load_target

SPEC = ClipSpec(
    frames=N_FRAMES, width=160, height=120, focal_px=260.0, range_m=(8.0, 7.0), supersample=1, spin_deg_per_frame=2.0
)


@pytest.fixture(scope="session")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "cad.glb"
    write_model("observer", path)
    return path


@pytest.fixture(scope="session")
def spec():
    return SPEC


@pytest.fixture(scope="session")
def clip(model):
    return list(render_clip(load_target(model), SPEC))


@pytest.fixture(scope="session")
def config():
    return load_config("default", CONFIG_OVERRIDES)


@pytest.fixture(scope="session")
def write_bag(model, clip, tmp_path_factory):
    """Writes a bag of the clip; ``change(writer, index, stamp_ns, rgb)`` may add to or replace a frame."""

    def write(name, change=None, *, masks=False, image_format="raw"):
        path = tmp_path_factory.mktemp(name) / name
        with BagWriter(path, image_format=image_format) as writer:
            for index, frame in enumerate(clip):
                stamp_ns, rgb = FIRST_NS + index * STEP_NS, frame.rgb
                if change is not None:
                    rgb = change(writer, index, stamp_ns, rgb)
                mask = frame.mask.astype(np.uint8) * 255 if masks and index != 3 else None
                writer.write_frame(stamp_ns, rgb, SPEC.camera, mask=mask, T_cam_target=frame.T_cam_target)
            writer.write_target(model)
        return path

    return write


@pytest.fixture(scope="session")
def clean_bag(write_bag):
    return write_bag("clean")


@pytest.fixture(scope="session")
def in_process(clean_bag, config, tmp_path_factory):
    """Topic -> what one process says, as a result bag would hold it."""
    return run_in_process(clean_bag, config, tmp_path_factory.mktemp("in_process") / "bag")


@pytest.fixture
def executor():
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=115)
    executor = SingleThreadedExecutor(context=context)
    yield executor
    process.close(executor, [node for node in executor.get_nodes() if isinstance(node, HatNode)])
    context.try_shutdown()
