"""What ament needs beside pyproject.toml, above all files in ``share/``. pip and colcon read both."""

from glob import glob

from setuptools import setup

setup(
    license="MIT",
    python_requires=">=3.11,<3.14",
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/hat_ros"]),
        ("share/hat_ros", ["package.xml"]),
        ("share/hat_ros/config", sorted(glob("config/*"))),
        ("share/hat_ros/launch", sorted(glob("launch/*.launch.py"))),
    ],
)
