"""ament_python package; ``pip install -e .`` and ``colcon build`` both use this file."""

from glob import glob

from setuptools import find_packages, setup

NODES = ("segmentation", "hypotheses", "slam", "selector", "fusion", "overlay", "player", "recorder")

setup(
    name="hat_ros",
    version="0.1.0",
    packages=find_packages(include=["hat_ros", "hat_ros.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/hat_ros"]),
        ("share/hat_ros", ["package.xml"]),
        ("share/hat_ros/config", glob("config/*")),
        ("share/hat_ros/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.10,<3.14",
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "opencv-python-headless>=4.8",
        "trimesh>=4.4",
        "embreex>=2.17",
        "numba>=0.59",
        "rosbags>=0.10",
        "mcap>=1.1",
        "PyYAML>=6.0",
        "rich>=13.0",
        "matplotlib>=3.7",
        "zstandard>=0.22",
    ],
    extras_require={
        "ros": ["ros-jazzy-rclpy==7.1.6", "ros-jazzy-common-interfaces==5.3.6", "ros-rclpy[fastrtps]==7.1.6"],
        "nets": ["torch==2.13.0", "transformers>=5.23", "safetensors>=0.4"],
        "gl": ["pyrender==0.1.45"],
        "cluster": ["distributed>=2024.1"],
    },
    zip_safe=True,
    description="Hypothesis-Anchored Tracking: causal monocular 6-DoF pose of an uncooperative spacecraft.",
    license="MIT",
    entry_points={
        "console_scripts": [
            "hat = hat_ros.cli:main",
            *(f"{name}_node = hat_ros.ros.{name}_node:main" for name in NODES),
        ]
    },
)
