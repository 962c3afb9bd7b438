"""Poses of all frames from matches and GPS: the planar-restricted pose graph of Zhao 2020, 3.3."""

from core.pose_graph.model import GraphFrame, Mark, PoseParams, Solution
from core.pose_graph.placing import place
from core.pose_graph.solving import solve

__all__ = ["GraphFrame", "Mark", "PoseParams", "Solution", "place", "solve"]
