"""Hypothesis-Anchored Tracking: the causal 6-DoF pose of an uncooperative spacecraft from one camera and a CAD model.

Start reading at :mod:`hat_ros.tracker`, the method on one page. ``hat --help`` lists the commands.
"""

__version__ = "0.1.0"
