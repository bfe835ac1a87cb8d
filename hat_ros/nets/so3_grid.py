"""Uniform rotation grid: HEALPix directions times equal in-plane steps (Hopf coordinates).

Yershova, Jain, LaValle, Mitchell, "Generating Uniform Incremental Grids on SO(3) Using the Hopf Fibration", IJRR 2010;
Gorski et al., "HEALPix", ApJ 622 (2005), ring scheme. The second level, 48 directions x 12 steps = 576 rotations, is
the grid that MegaPose's coarse network was trained with.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float


def so3_grid(level: int = 2) -> Float:
    """Unit quaternions xyzw of the grid: (72 * 8**(level - 1), 4); level 1 has 72 rotations, level 2 has 576.

    Raises:
        ValueError: level is below 1.
    """
    if level < 1:
        raise ValueError(f"level must be at least 1, found {level}")
    n_side, n_inplane = 2 ** (level - 1), 6 * 2 ** (level - 1)
    polar, azimuth = _healpix_directions(n_side)
    psi = 2 * np.pi * (np.arange(n_inplane) + 0.5) / n_inplane
    theta, phi, psi = np.repeat(polar, n_inplane) / 2, np.repeat(azimuth, n_inplane), np.tile(psi, len(polar)) / 2
    return np.stack(
        [
            np.cos(theta) * np.sin(psi),
            np.cos(theta) * np.cos(psi),
            np.sin(theta) * np.sin(phi + psi),
            np.sin(theta) * np.cos(phi + psi),
        ],
        axis=1,
    )


def _healpix_directions(n_side: int) -> tuple[Float, Float]:
    """Polar angle and azimuth of the 12 n_side^2 pixel centres, ring by ring from the north."""
    z, phi = [], []
    for ring in range(1, 4 * n_side):
        if ring < n_side:
            n, height, shift = 4 * ring, 1 - ring**2 / (3 * n_side**2), 0.5
        elif ring <= 3 * n_side:
            n, height = 4 * n_side, 4 / 3 - 2 * ring / (3 * n_side)
            shift = 0.5 * ((ring - n_side + 1) % 2)
        else:
            south = 4 * n_side - ring
            n, height, shift = 4 * south, -1 + south**2 / (3 * n_side**2), 0.5
        z.append(np.full(n, height))
        phi.append(2 * np.pi * (np.arange(n) + shift) / n)
    return np.arccos(np.concatenate(z)), np.concatenate(phi)
