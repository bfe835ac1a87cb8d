import numpy as np

from hat_ros.bench.synth.models import build_target
from hat_ros.bench.training.views import render_views


def test_views_hang_on_the_number_of_the_craft_and_the_seed(views):
    craft = build_target("probe")
    same = render_views(craft, 1, 3, 1)
    for number in range(3):
        np.testing.assert_array_equal(same.view(number), views.view(3 + number))
    assert render_views(craft, 2, 1, 1).view(0).shape != same.view(0).shape


def test_joined_views_are_those_of_the_parts(views):
    assert len(views) == 6
    assert views.index[:, 3].tolist() == [0, 0, 0, 1, 1, 1]
    assert len(views.pixels) == (views.index[:, 1] * views.index[:, 2]).sum()


def test_a_view_is_cut_to_the_target(views):
    for number in range(len(views)):
        coverage = views.view(number)[..., 3]
        for border in (coverage[0], coverage[-1], coverage[:, 0], coverage[:, -1]):
            assert border.any()
        assert (views.view(number)[coverage == 0] == 0).all()
        assert max(coverage.shape) <= 176


def test_another_view_is_of_the_same_craft(views):
    rng = np.random.default_rng(0)
    assert {views.another(1, rng) for _ in range(50)} == {0, 1, 2}
    assert {views.another(4, rng) for _ in range(50)} == {3, 4, 5}


def test_no_views_are_no_error():
    nothing = render_views(build_target("cubesat"), 0, 0, 1)
    assert len(nothing) == 0
    assert nothing.pixels.shape == (0, 4)
