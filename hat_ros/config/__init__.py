"""The configuration.

:mod:`~hat_ros.config.schema` says what there is (its sections are in :mod:`~hat_ros.config.front_ends` and
:mod:`~hat_ros.config.estimation`), :mod:`~hat_ros.config.loader` reads it and
:mod:`~hat_ros.config.text` writes it with comments.
"""

from hat_ros.config.estimation import (
    AlignmentConfig,
    FusionConfig,
    KeyframeConfig,
    PriorConfig,
    RefinementConfig,
    SelectorConfig,
)
from hat_ros.config.front_ends import (
    ClassicalConfig,
    DroidConfig,
    FeatureSlamConfig,
    HypothesesConfig,
    LearnedConfig,
    Mask2FormerConfig,
    MegaPoseConfig,
    PicoPoseConfig,
    SegmentationConfig,
    SlamConfig,
    TemplateConfig,
)
from hat_ros.config.loader import (
    config_from_dict,
    config_to_dict,
    flat_options,
    load_config,
    preset_folder,
    preset_names,
)
from hat_ros.config.option import LEVELS, Level, describe
from hat_ros.config.schema import CameraConfig, GraphConfig, HatConfig, InitialPoseConfig, NetsConfig
from hat_ros.config.text import commented_yaml, differences, value_text

__all__ = [
    "LEVELS",
    "AlignmentConfig",
    "CameraConfig",
    "ClassicalConfig",
    "DroidConfig",
    "FeatureSlamConfig",
    "FusionConfig",
    "GraphConfig",
    "HatConfig",
    "HypothesesConfig",
    "InitialPoseConfig",
    "KeyframeConfig",
    "LearnedConfig",
    "Level",
    "Mask2FormerConfig",
    "MegaPoseConfig",
    "NetsConfig",
    "PicoPoseConfig",
    "PriorConfig",
    "RefinementConfig",
    "SegmentationConfig",
    "SelectorConfig",
    "SlamConfig",
    "TemplateConfig",
    "commented_yaml",
    "config_from_dict",
    "config_to_dict",
    "describe",
    "differences",
    "flat_options",
    "load_config",
    "preset_folder",
    "preset_names",
    "value_text",
]
