"""Parameters: declared with what they mean, overridden by name, refused when unknown or wrong."""

from __future__ import annotations

import pytest
import rclpy
from rclpy.parameter import Parameter

from hat_ros.config import describe, flat_options
from hat_ros.errors import ConfigError
from hat_ros.ros.player_node import PlayerNode
from hat_ros.ros.selector_node import SelectorNode


@pytest.fixture
def context():
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=116)
    yield context
    context.try_shutdown()


@pytest.fixture
def make(context):
    nodes = []

    def build(node_class=SelectorNode, **parameters):
        node = node_class(context=context, parameters=parameters)
        nodes.append(node)
        return node

    yield build
    for node in nodes:
        node.destroy_node()


def test_every_option_is_a_parameter_with_its_description(make):
    node = make()
    for name, (_, field) in flat_options().items():
        descriptor = node.describe_parameter(name)
        assert descriptor.description == describe(field.metadata)
        assert descriptor.read_only
    assert node.describe_parameter("fusion.gate_angle_deg").description.endswith("[deg, paper: D]")
    assert node.describe_parameter("selector.warmup_keyframes").integer_range[0].from_value == 1
    assert node.describe_parameter("fusion.gate_weight").floating_point_range[0].to_value == 1.0
    assert "huber" in node.describe_parameter("fusion.loss").additional_constraints


def test_parameters_override_the_preset(make):
    node = make(**{"config": "pico_hat", "selector.score_scale": 7.5, "keyframes.gap_frames": 11})
    assert node.settings.config.selector.score_scale == 7.5
    assert node.settings.config.keyframes.gap_frames == 11
    assert node.get_parameter("keyframes.gap_frames").value == 11
    assert node.settings.config.fusion.relative_weight == 0.1


def test_whole_numbers_are_fine_for_real_ones(make):
    assert make(**{"selector.score_scale": 7}).settings.config.selector.score_scale == 7.0
    assert make(PlayerNode, rate=2).settings.extra["rate"] == 2.0


@pytest.mark.parametrize(
    ("parameters", "complaint"),
    [
        (
            {"selector.score_scal": 1.0},
            r"unknown parameter 'selector\.score_scal': did you mean 'selector\.score_scale'",
        ),
        ({"zzz": 1}, "unknown parameter 'zzz'"),
        ({"selector.score_scale": "high"}, r"selector\.score_scale: expected float"),
        ({"fusion.gate_weight": 2.0}, r"fusion\.gate_weight: must be at most 1"),
        ({"fusion.loss": "cauchy"}, "must be one of huber, linear"),
        ({"live": "yes"}, "live: expected bool"),
        ({"config": "nope"}, "nope"),
        ({"bag": "x"}, "unknown parameter 'bag'"),
    ],
)
def test_wrong_parameters_are_refused_by_name(make, parameters, complaint):
    with pytest.raises(ConfigError, match=complaint):
        make(**parameters)


def test_parameters_cannot_change_under_a_running_stage(make):
    node = make()
    (result,) = node.set_parameters([Parameter("selector.score_scale", value=1.0)])
    assert not result.successful


def test_a_live_node_wants_the_initial_pose_on_its_topic(make):
    given = {"initial_pose.pose": "0 0 5 0 0 0 1", "initial_pose.sigma": "1 1 1 1 1 1"}
    assert make(**given).settings.config.initial_pose.pose == "0 0 5 0 0 0 1"
    with pytest.raises(ConfigError, match="live, send the pose on the topic initialpose"):
        make(live=True, **given)
