import numpy as np
import pytest

from hat_ros.bench.synth.models import build_target
from hat_ros.bench.training.backgrounds import render_background
from hat_ros.bench.training.views import Views, join, render_views


@pytest.fixture(scope="session")
def views(tmp_path_factory) -> Views:
    """Three views of each of two craft."""
    root = tmp_path_factory.mktemp("views")
    parts = []
    for number, name in enumerate(("cubesat", "probe")):
        part = root / name
        part.mkdir()
        render_views(build_target(name), number, 3, 1).save(part)
        parts.append(part)
    join(parts, root)
    return Views.load(root)


@pytest.fixture(scope="session")
def backgrounds():
    return np.stack([render_background(number, 1) for number in range(4)])


@pytest.fixture(scope="module")
def one_thread():
    """torch on one thread: its results do not depend on how busy the machine is, and small networks are faster."""
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
