"""The core and the whole temporal method stand on numpy and scipy alone."""

import subprocess
import sys

CODE = """
import importlib, pkgutil, sys
import hat_ros.core
modules = [name for _, name, _ in pkgutil.iter_modules(hat_ros.core.__path__, "hat_ros.core.")]
assert len(modules) > 8, modules
for name in modules + ["hat_ros.bench.methods.temporal"]:
    importlib.import_module(name)
heavy = [name for name in ("torch", "cv2", "rclpy", "numba", "trimesh", "matplotlib") if name in sys.modules]
sys.exit(f"imported: {heavy}" if heavy else 0)
"""


def test_importing_the_core_brings_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
