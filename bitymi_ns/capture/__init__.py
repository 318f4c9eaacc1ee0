"""Photographs or a video in, camera poses out: `poses.find_poses`, and `known_poses.triangulate` for known poses."""
