"""Packaging says one thing: what is imported is declared, pins lie within bounds, ROS gets what pip gets."""

import ast
import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import hat_ros
from hat_ros.app import doctor

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
ROS_NAMES = {element.text for element in PACKAGE.iter("exec_depend")}
# rosdep key -> package on PyPI
APT = {
    "python3-numpy": "numpy",
    "python3-scipy": "scipy",
    "python3-opencv": "opencv-python-headless",
    "python3-yaml": "pyyaml",
    "python3-rich": "rich",
    "python3-matplotlib": "matplotlib",
    "python3-pil": "pillow",
}
# The command line where one package is not installed.
WITHOUT = """
import sys
from hat_ros.cli import main

class NotInstalled:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "{module}":
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)

sys.meta_path.insert(0, NotInstalled())
sys.exit(main(sys.argv[1:]))
"""


def names(requirements):
    return {canonicalize_name(Requirement(text).name) for text in requirements}


def requirements(*files):
    """Name -> requirement, of all files together."""
    lines = [line.split("#")[0].strip() for file in files for line in (ROOT / file).read_text().splitlines()]
    return {canonicalize_name(Requirement(line).name): Requirement(line) for line in lines if line}


def imports(*folders):
    """Top-level modules that the code of ``folders`` imports anywhere, the standard library's and ours left out."""
    found = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {"hat_ros", "_typeshed"}  # the latter is only for type checkers


def test_every_import_is_declared():
    declared = names(PROJECT["dependencies"])
    for extra, packages in PROJECT["optional-dependencies"].items():
        declared |= names(packages) if extra != "ros" else set()
    providers = packages_distributions()
    undeclared = {
        module
        for module in imports("hat_ros", "launch") - ROS_NAMES
        if not declared & {canonicalize_name(name) for name in providers.get(module, [module])}
    }
    assert not undeclared


def test_every_declared_package_is_imported():
    providers = packages_distributions()
    used = {canonicalize_name(name) for module in imports("hat_ros") for name in providers.get(module, [module])}
    assert names(PROJECT["dependencies"]) <= used


def test_pins_lie_within_the_bounds():
    pins = requirements("requirements.txt", "requirements-nets.txt", "requirements-test.txt")
    stated = PROJECT["dependencies"] + [
        text for extra in ("ros", "nets", "train") for text in PROJECT["optional-dependencies"][extra]
    ]
    for need in map(Requirement, stated):
        (pin,) = pins[canonicalize_name(need.name)].specifier
        assert pin.operator == "=="
        assert pin.version in need.specifier, f"{need} is pinned to {pin.version}"


def test_a_package_has_one_pin():
    pins = {}
    for path in ROOT.glob("requirements*.txt"):
        for name, pin in requirements(path.name).items():
            if str(pin.specifier).startswith("=="):
                pins.setdefault(name, set()).add(str(pin.specifier))
    assert {name: found for name, found in pins.items() if len(found) > 1} == {}


def test_ros_machines_get_every_dependency():
    from_pip = requirements("requirements-ros.txt")
    from_apt = {APT[name] for name in ROS_NAMES if name in APT}
    assert from_apt | set(from_pip) == names(PROJECT["dependencies"])
    pins = requirements("requirements.txt")
    assert {name: pins[name].specifier for name in from_pip if name not in from_apt} == {
        name: need.specifier for name, need in from_pip.items() if name not in from_apt
    }


def test_package_xml_states_the_same_version_and_licence():
    assert PACKAGE.findtext("version") == hat_ros.__version__
    assert f'license="{PACKAGE.findtext("license")}"' in (ROOT / "setup.py").read_text()


def test_one_statement_about_python():
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    low, high = re.search(r'python_requires=">=3\.(\d+),<3\.(\d+)"', setup).groups()
    versions = [f"3.{minor}" for minor in range(int(low), int(high))]
    listed = [text.split(" :: ")[-1] for text in PROJECT["classifiers"] if "Python :: 3." in text]
    assert listed == versions
    for file in ("Makefile", "README.md", "requirements.txt", "hat_ros/app/doctor.py"):
        assert f"{versions[0]} to {versions[-1]}" in (ROOT / file).read_text(encoding="utf-8"), file


def test_nodes_of_the_launch_file_are_executables():
    tree = ast.parse((ROOT / "launch" / "hat.launch.py").read_text(encoding="utf-8"))
    assigned = {node.targets[0].id: node.value for node in tree.body if isinstance(node, ast.Assign)}
    for stage in (*ast.literal_eval(assigned["STAGES"]), "overlay"):
        assert PROJECT["scripts"][f"{stage}_node"] == f"hat_ros.ros.{stage}_node:main"


def test_doctor_asks_for_every_dependency():
    everywhere = {canonicalize_name(need.name) for need in map(Requirement, PROJECT["dependencies"]) if not need.marker}
    assert {canonicalize_name(name) for name in doctor._REQUIRED.values()} == everywhere


@pytest.mark.parametrize(
    ("module", "arguments", "advice"),
    [
        ("rclpy", ["replay", "bags/demo"], "pip install 'hat_ros[ros]'"),
        ("torch", ["track", "bags/demo", "--config", "pico_hat"], "pip install 'hat_ros[nets]'"),
        ("torch", ["train", "segmenter"], "pip install 'hat_ros[train]'"),
        ("numba", ["track", "bags/demo"], "'numba' is missing: run `make install`"),
    ],
)
def test_a_missing_package_is_one_sentence(module, arguments, advice, tmp_path):
    command = [
        sys.executable,
        "-c",
        WITHOUT.format(module=module),
        *arguments,
        "--quiet",
        "--out",
        str(tmp_path / "out"),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("hat: ")
    assert advice in done.stderr
    assert done.stderr.count("\n") == 1
