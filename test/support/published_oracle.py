"""Stages 3 and 4 of the paper once more, written down plainly: scipy's solvers, lists that grow, no shared code.

What the published text leaves open is as the authors' reference has it. Only for tests: it costs seconds a clip.
"""

import numpy as np
import scipy.optimize
from scipy.spatial.transform import Rotation

TIGHT = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15}


def run(observations, config):
    """(N, 4, 4) outputs, (N,) chosen, and the frames of resets."""
    decoder, fusion = Decoder(config), Fusion(config)
    out, chosen, held = [], [], np.full((4, 4), np.nan)
    last_slam = None
    for frame in range(len(observations)):
        slam = None if np.isnan(observations.slam[frame, 0, 0]) else observations.slam[frame]
        anchor, area, index = None, np.nan, -1
        if observations.key[frame]:
            index = decoder.choose(
                observations.poses[frame], observations.scores[frame], area_of(observations, frame), slam
            )
            anchor = observations.poses[frame, index]
            area = area_of(observations, frame)
        pose = fusion.step(frame, slam, anchor, area)
        if pose is not None:
            held = pose
        elif config.fusion.gap_fill == "rotate" and slam is not None and last_slam is not None:
            held = held.copy()
            held[:3, :3] = slam[:3, :3].T @ last_slam[:3, :3] @ held[:3, :3]
        last_slam = slam
        out.append(held)
        chosen.append(index)
    return np.array(out), np.array(chosen), fusion.resets


def area_of(observations, frame):
    return np.nan if observations.box_area_px is None else observations.box_area_px[frame]


def angle_deg(R_a, R_b):
    return np.degrees(np.linalg.norm(log(R_a @ R_b.T)))


def log(R):
    return Rotation.from_matrix(R).as_rotvec()


class Decoder:
    """Eq. (forward) with the running gate; all candidates of these clips pass the guard."""

    def __init__(self, config):
        self.config, self.past, self.supports, self.overrides, self.count = config.selector, None, [], 0, 0

    def choose(self, poses, scores, area, slam):
        c = self.config
        alpha = c.score_scale
        if c.size_weighting and np.isfinite(area):
            alpha *= np.clip((np.sqrt(area) / c.size_ref_px) ** c.size_exponent, c.size_weight_min, 1.0)
        unary = alpha * (scores - scores.max())
        V = unary.copy()
        if self.past is not None:
            past_poses, past_V, past_slam = self.past
            for k, pose in enumerate(poses):
                penalty = np.zeros(len(past_poses))
                if slam is not None and past_slam is not None:
                    step = slam[:3, :3].T @ past_slam[:3, :3]
                    penalty = np.array([angle_deg(pose[:3, :3], step @ p[:3, :3]) for p in past_poses])
                V[k] += np.max(past_V - c.motion_weight_per_deg * penalty)
        self.past = poses, V, slam
        self.count += 1
        best, proposal = int(np.argmax(unary)), int(np.argmax(V))
        self.supports.append(sum(angle_deg(p[:3, :3], poses[best, :3, :3]) <= c.gate_neighbourhood_deg for p in poses))
        self.overrides += proposal != best
        if self.count < c.warmup_keyframes:
            return best
        trusted = (
            np.median(self.supports) >= c.gate_min_median_support
            and self.overrides / self.count <= c.gate_max_override_share
        )
        return proposal if trusted or not c.running_gate else best


class Fusion:
    """Alignment, reset and the zero-lag solve."""

    def __init__(self, config):
        self.a, self.f = config.alignment, config.fusion
        self.observations, self.n_counted, self.parameters, self.last_fit = [], 0, None, 0
        self.dissenters, self.resets, self.previous, self.areas, self.relatives = [], [], None, [], []

    def step(self, frame, slam, anchor, area):
        confidence = 1.0 if anchor is None else self.confidence(area)
        if anchor is not None and slam is not None:
            self.observations.append((anchor, slam))
            self.n_counted += 1
        if self.parameters is None and self.n_counted >= self.a.min_observations:
            self.fit(frame, umeyama(self.observations), 3)
        elif self.parameters is not None and frame - self.last_fit >= self.a.refit_interval_frames:
            self.fit(frame, self.parameters, 1)
        g = 1.0
        if anchor is not None and slam is not None and self.parameters is not None:
            g = self.gate(frame, anchor, slam)
        pose = self.solve(slam, anchor, g * confidence)
        self.previous = None if pose is None or slam is None else (pose, slam)
        return pose

    def confidence(self, area):
        if self.f.confidence == "uniform" or not area > 0:
            return 1.0
        self.areas.append(area)
        self.relatives.append((area / np.mean(self.areas)) ** self.f.confidence_exponent)
        return self.relatives[-1] / np.mean(self.relatives)

    def gate(self, frame, anchor, slam):
        aligned = aligned_pose(self.parameters, slam)
        if angle_deg(anchor[:3, :3], aligned[:3, :3]) <= self.f.gate_angle_deg:
            self.dissenters = []
            return 1.0
        if self.dissenters:
            before, aligned_before = self.dissenters[-1]
            carried = aligned[:3, :3] @ aligned_before[:3, :3].T @ before[:3, :3]
            if angle_deg(anchor[:3, :3], carried) > self.f.gate_angle_deg:
                self.dissenters = []
        self.dissenters.append((anchor, aligned))
        if len(self.dissenters) < self.a.reset_anchors:
            return self.f.gate_weight
        self.resets.append(frame)
        # The anchor at hand is fitted to, and does not count.
        self.observations, self.n_counted, self.parameters, self.dissenters = [(anchor, slam)], 0, None, []
        return 1.0

    def fit(self, frame, start, n_rounds):
        rows = list(range(len(self.observations)))
        for _ in range(n_rounds):
            found = scipy.optimize.least_squares(self.residuals, start, args=(rows,), method="lm", **TIGHT)
            start = found.x
            norms = np.linalg.norm(self.residuals(start, range(len(self.observations))).reshape(-1, 6), axis=1)
            limit = self.a.rejection_factor * max(np.median(norms[rows]), 1e-6)
            inliers = np.flatnonzero(norms < limit).tolist()
            if len(inliers) < 3 or len(inliers) == len(rows):
                break
            rows = inliers
        self.parameters, self.last_fit = start, frame

    def residuals(self, parameters, rows):
        out = []
        for row in rows:
            anchor, slam = self.observations[row]
            aligned = aligned_pose(parameters, slam)
            out += [self.a.lever_m_per_rad * log(anchor[:3, :3] @ aligned[:3, :3].T), anchor[:3, 3] - aligned[:3, 3]]
        return np.concatenate(out)

    def solve(self, slam, anchor, weight):
        if self.parameters is None or self.n_counted < self.f.warmup_observations:
            return anchor
        predicted = None
        if self.previous is not None and slam is not None:
            output, before = self.previous
            step = aligned_pose(self.parameters, slam) @ np.linalg.inv(aligned_pose(self.parameters, before))
            predicted = step @ output
        if predicted is None:
            return aligned_pose(self.parameters, slam) if anchor is None and slam is not None else anchor
        if anchor is None:
            return predicted
        lever, w = self.a.lever_m_per_rad, self.f.relative_weight

        def residuals(x):
            pose = moved(predicted, x)
            unary = [lever * log(anchor[:3, :3] @ pose[:3, :3].T), anchor[:3, 3] - pose[:3, 3]]
            E = predicted @ np.linalg.inv(pose)
            return np.concatenate([weight * np.concatenate(unary), w * lever * log(E[:3, :3]), w * E[:3, 3]])

        loss = {"huber": "huber", "linear": "linear"}[self.f.loss]
        found = scipy.optimize.least_squares(
            residuals, np.zeros(6), jac="3-point", loss=loss, f_scale=self.f.huber_delta_m, max_nfev=2000, **TIGHT
        )
        return moved(predicted, found.x)


def moved(pose, x):
    out = pose.copy()
    out[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix() @ pose[:3, :3]
    out[:3, 3] += x[3:]
    return out


def aligned_pose(parameters, slam):
    """Eq. (alignmentmap): log-scale, rotation vector, translation."""
    scale, R_A, t_A = np.exp(parameters[0]), Rotation.from_rotvec(parameters[1:4]).as_matrix(), parameters[4:]
    out = np.eye(4)
    out[:3, :3] = (R_A @ slam[:3, :3]).T
    out[:3, 3] = -out[:3, :3] @ (scale * R_A @ slam[:3, 3] + t_A)
    return out


def umeyama(observations):
    """Umeyama's similarity of the camera centres; scale 1 and the matching mean when there is none."""
    source = np.array([slam[:3, 3] for _, slam in observations])
    target = np.array([np.linalg.inv(anchor)[:3, 3] for anchor, _ in observations])
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, singular, Vt = np.linalg.svd(b.T @ a / len(a))
    signs = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    R = U @ np.diag(signs) @ Vt
    variance = np.mean(np.sum(a * a, axis=1))
    scale = float(singular @ signs / variance) if variance > 0 else 0.0
    scale = scale if scale > 0 else 1.0
    return np.concatenate([[np.log(scale)], log(R), target.mean(axis=0) - scale * R @ source.mean(axis=0)])
