"""The attitude filter: laws on made-up tracks whose images and predictions err in known ways."""

import numpy as np
import pytest

from hat_ros.geometry import lie
from hat_ros.tracking.attitude import AttitudeFilter

START_SIGMA_RAD = np.radians(5.0)
TURN = lie.so3_exp(np.radians([0.0, 2.0, 0.5]))
# One sigma of what an image says, camera axes: nothing about the line of sight.
SHARP_RAD, BLUNT_RAD = np.radians(0.3), np.radians(12.0)


def run(n_frames, drift_deg=(0.0, 0.0, 0.0), seed=0, axes=None):
    """Follow a turning target: errors (n, 3) of the rotations, degrees, camera axes, and the filter."""
    rng = np.random.default_rng(seed)
    axes = np.eye(3) if axes is None else axes
    sigma = np.array([SHARP_RAD, SHARP_RAD, BLUNT_RAD])
    covariance = axes @ np.diag(sigma**2) @ axes.T
    wrong = lie.so3_exp(np.radians(drift_deg))
    attitude = AttitudeFilter(START_SIGMA_RAD)
    truth = R = np.eye(3)
    errors = []
    for i in range(n_frames):
        if i:
            truth, predicted = TURN @ truth, wrong @ TURN @ R
            information = attitude.predict(wrong @ TURN)
        seen = lie.so3_exp(axes @ (sigma * rng.normal(size=3))) @ truth
        if i == 0:
            R = seen
            attitude.restart(R, covariance)
        else:
            # What a refinement held to the prediction returns: the balance of both.
            offset = lie.so3_log(seen @ predicted.T)
            weight = np.linalg.inv(covariance)
            R = lie.so3_exp(np.linalg.solve(weight + information, weight @ offset)) @ predicted
            attitude.correct(R, predicted, covariance)
        errors.append(np.degrees(lie.so3_log(R @ truth.T)))
    return np.array(errors), attitude


def test_what_an_image_does_not_show_lasts_from_earlier_ones():
    errors, attitude = run(80)
    assert np.abs(errors[40:, 2]).mean() < np.degrees(BLUNT_RAD) / 3, "one image alone is off by ten degrees"
    assert np.abs(errors[40:, :2]).mean() < np.degrees(SHARP_RAD)
    assert attitude.drift_rad() < np.radians(0.5)


@pytest.mark.parametrize("drift_deg", [(1.5, 0.0, 0.0), (0.0, -3.0, 0.0)])
def test_predictions_that_drift_are_found_out_and_not_followed(drift_deg):
    errors, attitude = run(60, drift_deg)
    assert attitude.drift_rad() > 0.4 * np.radians(np.linalg.norm(drift_deg))
    assert np.abs(errors[20:, :2]).max() < 1.2


def test_trust_has_to_be_earned():
    attitude = run(4)[1]
    assert attitude.drift_rad() == START_SIGMA_RAD
    attitude = run(40)[1]
    attitude.forget()
    assert attitude.drift_rad() == START_SIGMA_RAD
    np.testing.assert_allclose(attitude.predict(TURN), START_SIGMA_RAD**-2 * np.eye(3))


def test_the_axes_do_not_matter():
    axes = lie.so3_exp(np.array([0.4, -1.1, 0.7]))
    attitude = run(30, axes=axes)[1]
    information = attitude.predict(np.eye(3))
    blunt = axes[:, 2] @ information @ axes[:, 2]
    assert blunt < 0.2 * min(axes[:, 0] @ information @ axes[:, 0], axes[:, 1] @ information @ axes[:, 1])


def test_without_measurements_knowledge_fades():
    attitude = run(30)[1]
    known = [np.trace(np.linalg.inv(attitude.predict(TURN))) for _ in range(20)]
    assert (np.diff(known) > 0).all()
    assert known[-1] <= 3 * START_SIGMA_RAD**2
