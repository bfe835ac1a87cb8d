import pytest
from segmentation_scene import Scene, build_target


@pytest.fixture(scope="session")
def lopsided():
    return build_target()


@pytest.fixture(scope="session")
def scene(lopsided):
    return Scene(lopsided)
